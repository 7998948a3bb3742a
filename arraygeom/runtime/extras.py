"""Import of optional modules, and of users' own code."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any


def install_line(module: str, extra: str) -> str:
    """Return the shell line that installs an optional module, with a checkout and without.

    It names the module's own package: arraygeom-pat is on no index.
    """
    packages = {"cv2": "opencv-contrib-python-headless"}
    package = packages.get(module, module.replace("_", "-"))
    return f"pip install {package}, or in a checkout: pip install '.[{extra}]'"


@contextmanager
def needs(extra: str, purpose: str) -> Iterator[None]:
    """Context manager for a block that imports an optional module.

    Args:
        extra: extra of this package that has the module.
        purpose: purpose of the import, which begins the message, such as "writing video".

    Raises:
        ImportError: in one line that names the module and how to install it, for any ImportError inside.
    """
    try:
        yield
    except ImportError as error:
        module = (error.name or str(error)).partition(".")[0]
        raise ImportError(f"{purpose} needs {module}: {install_line(module, extra)}") from error


def imported(name: str, what: str) -> Any:
    """Import a user's "module:object", or a module, also from the current folder; the module's code runs.

    Args:
        name: dotted name of a module, and after a colon of an object in it.
        what: kind of object, for messages, such as "field".

    Returns:
        The object, or the module where no object is named.

    Raises:
        ValueError: for a module or object that does not exist, a relative name, or a module that fails with
            ImportError, AttributeError, TypeError or ValueError; other errors of the module pass.
    """
    module, _, attribute = name.partition(":")
    try:
        sys.path.insert(0, str(Path.cwd()))
        found = importlib.import_module(module)
        return getattr(found, attribute) if attribute or ":" in name else found
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"the {what} '{name}' cannot be imported: {error}") from None
    finally:
        sys.path.pop(0)


PLUGINS = "arraygeom.plugins"
"""The group of entry points whose modules register cameras, fields and rig formats of one's own."""


def load_plugins(names: Iterable[str] = ()) -> None:
    """Import installed plugins (entry points of the group `PLUGINS`), and modules by name.

    Importing registers: a camera by being defined with a name, a field in `arraygeom.fields.FIELDS`, a rig
    format in `arraygeom.io.READERS` (and `WRITERS`). Raises ValueError for one that cannot be imported.
    """
    for name in [*(point.value for point in entry_points(group=PLUGINS)), *names]:
        imported(name, "plugin")
