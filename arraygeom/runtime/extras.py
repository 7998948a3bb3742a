"""Modules that only some users need, and those of users."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PACKAGES = {
    "PIL": "pillow",
    "cv2": "opencv-contrib-python-headless",
    "skimage": "scikit-image",
    "yaml": "PyYAML",
}
"""Packages that are called otherwise than their modules."""


def install(module: str) -> str:
    """The command that installs the package of a module, be this project a checkout or installed."""
    return f"pip install {PACKAGES.get(module, module.replace('_', '-'))}"


@contextmanager
def needs(purpose: str) -> Iterator[None]:
    """Around an optional module's import: raises ImportError in one line that says what to install."""
    try:
        yield
    except ImportError as error:
        module = (error.name or str(error)).partition(".")[0]
        raise ImportError(f"{purpose} needs {module}: {install(module)}", name=error.name) from error


def imported(name: str, what: str) -> Any:
    """A user's "module:object", looked for from here too. Raises ValueError, which says what it was to be."""
    module, _, attribute = name.partition(":")
    try:
        sys.path.insert(0, str(Path.cwd()))
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"the {what} '{name}' cannot be imported: {error}") from None
    finally:
        sys.path.pop(0)
