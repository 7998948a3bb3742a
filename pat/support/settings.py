"""Settings of the algorithms: numbers in frozen dataclasses, each with its kind and its reason.

*physics*: follows from a measurement or from the recording; *size*: amount of work at a time, or a number of
which half or twice as much does as well; *tuned*: chosen on images, which are named. `make sensitivity`
halves and doubles them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import field, fields, is_dataclass
from functools import partial
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, Literal, NamedTuple

Kind = Literal["physics", "size", "tuned"]


def _entry(kind: Kind, value: Any, why: str) -> Any:
    return field(default=value, metadata={"kind": kind, "why": why})


physics = partial(_entry, "physics")
"""Field whose value follows from a measurement; `why` names it."""
size = partial(_entry, "size")
"""Field for the amount of work at a time, or a number that hardly matters."""
tuned = partial(_entry, "tuned")
"""Field whose value was tuned; `why` says on what, and what it does."""


class SettingEntry(NamedTuple):
    """One entry of an algorithm's settings.

    Attributes:
        algorithm: name of the settings' class.
        name: name of the field.
        value: value of the field.
        kind: "physics", "size" (of memory or work) or "tuned" (on data).
        why: meaning of the field, and the source of its value.
    """

    algorithm: str
    name: str
    value: Any
    kind: Kind
    why: str

    @property
    def numbers(self) -> int:
        """Number of values in the entry: the length of a tuple, else 1."""
        return len(self.value) if isinstance(self.value, tuple) else 1


def listed(settings: Any) -> Iterator[SettingEntry]:
    """Yield the entries of an algorithm's settings, in the order of their fields.

    Args:
        settings: instance of a dataclass whose fields were made by `physics`, `size` or `tuned`.

    Raises:
        ValueError: at the first field that was not.
    """
    algorithm = type(settings).__name__
    for entry in fields(settings):
        if "kind" not in entry.metadata:
            raise ValueError(f"{algorithm}.{entry.name} is not said to be physics, size or tuned")
        yield SettingEntry(algorithm, entry.name, getattr(settings, entry.name), **entry.metadata)


def all_settings(*rooms: str) -> list[SettingEntry]:
    """Collect the entries of all settings in packages such as "pat.matching".

    Settings are instances, at the top level of a package's modules, of dataclasses named "...Settings"; each
    module is imported for it. Modules of subpackages are not looked at.

    Returns:
        The entries by package, by name of the module, as `listed`; equal ones appear once.

    Raises:
        ImportError: for a package or module that cannot be imported; AttributeError for a lone module.
        ValueError: as `listed`.
    """
    entries: dict[SettingEntry, None] = {}
    for room in rooms:
        for module in iter_modules(import_module(room).__path__, f"{room}."):
            for value in vars(import_module(module.name)).values():
                if is_dataclass(value) and type(value).__name__.endswith("Settings"):
                    entries |= dict.fromkeys(listed(value))
    return list(entries)
