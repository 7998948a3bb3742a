"""Dataclasses to plain values, as YAML has them, and back, with errors that name the entry."""

from __future__ import annotations

import dataclasses
import difflib
import types
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")
Chooser = Callable[[Any, str], Any]
"""Makes the value of an entry that may be one of several dataclasses, from its plain value and its name."""


def to_plain(value: Any) -> Any:
    """Dataclasses as mappings, tuples as lists, paths as text."""
    if dataclasses.is_dataclass(value):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, (tuple, list)):
        return [to_plain(v) for v in value]
    return str(value) if isinstance(value, Path) else value


def from_plain(kind: type[T], values: Any, where: str = "", *, union: Chooser | None = None) -> T:
    """The dataclass `kind` of a mapping; entries left out keep their defaults.

    `where` goes in front of names in errors. Raises ValueError for an unknown entry, naming the nearest, and for
    a value of another type.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{where.rstrip('.: ')}: wanted entries (name: value), got {values!r}")
    hints = get_type_hints(kind)
    names = [f.name for f in dataclasses.fields(kind)]  # type: ignore[arg-type]
    for name in values:
        if name not in names:
            near = nearest(str(name), names)
            hint = f"did you mean '{near}'?" if near else f"there are: {', '.join(names)}"
            raise ValueError(f"{where}{name}: unknown entry; {hint}")
    try:
        return kind(**{k: convert(hints[k], v, where + k, union=union) for k, v in values.items()})
    except ValueError as error:
        text = str(error)
        raise ValueError(text if where and text.startswith(where) else where + text) from None


def convert(kind: Any, value: Any, where: str, *, union: Chooser | None = None) -> Any:
    """A plain value as the annotation `kind` says. Raises ValueError naming `where`."""
    if dataclasses.is_dataclass(kind):
        return from_plain(kind, value, f"{where}.", union=union)  # type: ignore[arg-type]
    origin = get_origin(kind)
    if origin is Literal:
        return _chosen(value, get_args(kind), where)
    if origin in (Union, types.UnionType):
        return _either(kind, value, where, union)
    if origin is tuple:
        return _several(get_args(kind), value, where)
    return _simple(kind, value, where)


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The known name most like this one, if any is."""
    return next(iter(difflib.get_close_matches(name, list(known), 1, 0.5)), None)


def _chosen(value: Any, allowed: tuple[Any, ...], where: str) -> Any:
    if value in allowed:
        return value
    raise ValueError(f"{where}: is {value!r}; wanted one of {', '.join(map(str, allowed))}")


def _either(kind: Any, value: Any, where: str, union: Chooser | None) -> Any:
    options = [k for k in get_args(kind) if k is not type(None)]
    if value is None and len(options) < len(get_args(kind)):
        return None
    if len(options) == 1:
        return convert(options[0], value, where)
    if union is None:
        raise TypeError(f"{where}: nothing says which of {options} it is")
    return union(value, where)


def _several(kinds: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    values = list(value) if isinstance(value, (list, tuple)) else [value]
    if kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(values)
    if len(values) != len(kinds):
        raise ValueError(f"{where}: has {len(values)} values, wanted {len(kinds)}")
    return tuple(convert(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(kinds, values)))


def _simple(kind: Any, value: Any, where: str) -> Any:
    """YAML 1.1 reads 8e-4 as text, so numbers in text count as numbers."""
    wanted = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}[kind]
    wrong = ValueError(f"{where}: is {value!r}; wanted {wanted}")
    if kind in (bool, str) or value is None or isinstance(value, (bool, Mapping, list)):
        if type(value) is kind:
            return value
        raise wrong
    if kind is Path and not isinstance(value, str):
        raise wrong
    try:
        made = Path(value).expanduser() if kind is Path else float(value)
    except ValueError:
        raise wrong from None
    if kind is int and not (isinstance(made, float) and made.is_integer()):
        raise wrong
    return int(made) if kind is int else made  # type: ignore[arg-type]
