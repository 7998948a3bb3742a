"""Import of optional modules, and of users' own code."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any


def install_line(module: str, extra: str) -> str:
    """Return the shell line that installs an optional module, or in a checkout this package's extra."""
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
        ValueError: for a module or object that does not exist, a name that is a path, or a module that fails.
    """
    module, _, attribute = name.partition(":")
    try:
        sys.path.insert(0, str(Path.cwd()))
        found = importlib.import_module(module)
        return getattr(found, attribute) if attribute or ":" in name else found
    except Exception as error:
        is_path = "/" in module or module.endswith(".py")
        hint = f": give the name of a module, as {Path(module).stem}" * is_path
        raise ValueError(f"the {what} '{name}' cannot be imported: {error_line(error)}{hint}") from error
    finally:
        sys.path.pop(0)


def error_line(error: BaseException) -> str:
    """Return an error's first line, after its kind where the line may not say enough, as KeyError's."""
    plain = isinstance(error, ImportError | AttributeError | OSError | TypeError | ValueError) and str(error)
    kind = [] if plain else [type(error).__name__]
    return ": ".join([*kind, *str(error).splitlines()[:1]])


class Registry(dict[str, Any]):
    """Dictionary by name in which users register their own, and replace none but their own (by `[name] =`).

    Args:
        what: kind of the entries, for messages, such as "field".
        methods: methods that each entry has.
        entries: entries of the package.

    Raises:
        ValueError: when an entry is set that lacks a method, or under the name of another class or module.
    """

    def __init__(self, what: str, methods: tuple[str, ...], entries: Mapping[str, Any]) -> None:
        super().__init__(entries)
        self.what, self.methods = what, methods

    def __setitem__(self, name: str, entry: Any) -> None:
        missing = [method for method in self.methods if not callable(getattr(entry, method, None))]
        if missing:
            raise ValueError(f"the {self.what} '{name}' ({entry!r}) has no method {missing[0]}")
        if name in self and _origin(self[name]) != _origin(entry):
            raise ValueError(f"a {self.what} named '{name}' exists: give yours another name")
        super().__setitem__(name, entry)


def _origin(entry: Any) -> tuple[str, str]:
    if isinstance(entry, ModuleType):
        return "module", entry.__name__
    kind = entry if hasattr(entry, "__qualname__") else type(entry)
    return kind.__module__, kind.__qualname__


PLUGINS = "arraygeom.plugins"
"""The group of entry points whose modules register cameras, fields and rig formats of one's own."""


def load_plugins(names: Iterable[str] = ()) -> None:
    """Import installed plugins (entry points of the group `PLUGINS`), and modules by name.

    Importing registers: a camera by being defined with a name, a field in `arraygeom.fields.FIELDS`, a rig
    format in `arraygeom.io.READERS` (and `WRITERS`). Raises ValueError for one that cannot be imported.
    """
    for name in [*(point.value for point in entry_points(group=PLUGINS)), *names]:
        imported(name, "plugin")
