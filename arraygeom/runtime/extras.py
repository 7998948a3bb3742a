"""Import of optional modules, and of users' own code."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def needs(extra: str, purpose: str) -> Iterator[None]:
    """Context manager for the import of an optional module.

    Raises:
        ImportError: in one line that names the extra to install, if the import fails.
    """
    try:
        yield
    except ImportError as error:
        module = (error.name or str(error)).partition(".")[0]
        raise ImportError(f"{purpose} needs {module}: pip install 'arraygeom-pat[{extra}]'") from error


def imported(name: str, what: str) -> Any:
    """Import a user's "module:object", also from the current folder.

    Args:
        what: what it is, for messages.

    Returns:
        The object.

    Raises:
        ValueError: if it cannot be imported.
    """
    module, _, attribute = name.partition(":")
    try:
        sys.path.insert(0, str(Path.cwd()))
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"the {what} '{name}' cannot be imported: {error}") from None
    finally:
        sys.path.pop(0)
