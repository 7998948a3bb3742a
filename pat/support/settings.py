"""The numbers that an algorithm was given: each with its kind, and where it is from, in a frozen dataclass.

*physics*: follows from what is measured or from the recording; *size*: how much is done at a time, changes no
result worth speaking of; *tuned*: chosen on images, which are named.
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
"""A field whose value follows from what is measured; `why` says from what."""
size = partial(_entry, "size")
"""A field that says how much is done at a time."""
tuned = partial(_entry, "tuned")
"""A field whose value was chosen; `why` says on what, and what it does."""


class SettingEntry(NamedTuple):
    """One entry of an algorithm's settings: its name, value, kind, and why it is so."""

    algorithm: str
    name: str
    value: Any
    kind: Kind
    why: str

    @property
    def numbers(self) -> int:
        """How many numbers the value is."""
        return len(self.value) if isinstance(self.value, tuple) else 1


def listed(settings: Any) -> Iterator[SettingEntry]:
    """The entries of an algorithm's settings, in their order. Raises ValueError for one without a kind."""
    algorithm = type(settings).__name__
    for entry in fields(settings):
        if "kind" not in entry.metadata:
            raise ValueError(f"{algorithm}.{entry.name} is not said to be physics, size or tuned")
        yield SettingEntry(algorithm, entry.name, getattr(settings, entry.name), **entry.metadata)


def all_settings(*rooms: str) -> list[SettingEntry]:
    """The entries of all settings of these packages, such as "pat.matching", in their modules' order; of
    settings that a room has more than once, what differs from the first."""
    entries: dict[SettingEntry, None] = {}
    for room in rooms:
        for module in iter_modules(import_module(room).__path__, f"{room}."):
            for value in vars(import_module(module.name)).values():
                if is_dataclass(value) and type(value).__name__.endswith("Settings"):
                    entries |= dict.fromkeys(listed(value))
    return list(entries)
