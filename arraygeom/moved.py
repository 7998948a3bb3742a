"""Modules under the names that they had before: they work for one release, and a warning names the new ones."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any


class OldModule(ModuleType):
    """A module by its old name. It can be called where it has the name of a function that it had, too."""

    def __init__(self, name: str, new: str, renamed: Mapping[str, str]):
        super().__init__(name, f"{name} is now {new}.")
        self._new, self._renamed = new, renamed

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return moved_name(self.__name__, name, self._renamed.get(name, f"{self._new}.{name}"), silent=True)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the function of the same name."""
        return getattr(self, self.__name__.rpartition(".")[2])(*args, **kwargs)


class OldModules(MetaPathFinder, Loader):
    """Finds modules by their old names: put it at the end of `sys.meta_path`.

    `table`: the new name of each module. `renamed`: new addresses, such as "a.b.function", of names "old.name" that
    are not in the new module under the same name.
    """

    def __init__(self, table: Mapping[str, str], renamed: Mapping[str, str]):
        self.table, self.renamed = table, renamed

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """The specification of a module that has moved."""
        return ModuleSpec(fullname, self) if fullname in self.table else None

    def create_module(self, spec: ModuleSpec) -> OldModule:
        """A stand-in for the new module."""
        before = f"{spec.name}."
        renamed = {old.removeprefix(before): new for old, new in self.renamed.items() if old.startswith(before)}
        return OldModule(spec.name, self.table[spec.name], renamed)

    def exec_module(self, module: ModuleType) -> None:
        """Warn."""
        warnings.warn(f"{module.__name__} is now {self.table[module.__name__]}", DeprecationWarning, stacklevel=2)


def moved_name(module: str, name: str, address: str | None, *, silent: bool = False) -> Any:
    """What is now at an address, for the `__getattr__` of the module that had it. Raises AttributeError for None."""
    if address is None:
        raise AttributeError(f"module '{module}' has no attribute '{name}'")
    if not silent:
        warnings.warn(f"{module}.{name} is now {address}", DeprecationWarning, stacklevel=3)
    where, _, new = address.rpartition(".")
    return getattr(import_module(where), new)
