"""Plain data, as YAML has it, to typed dataclasses; what does not fit is named with its place.

Unknown keys are refused with the nearest known one. Numbers, names, paths, `Literal`s, tuples (lists in YAML),
mappings, unions and dataclasses within dataclasses are understood.
"""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, Union

import yaml

T = TypeVar("T")


def read_yaml(path: str | Path) -> Any:
    """What a YAML file holds. Raises FileNotFoundError, and ValueError for a file that is not YAML."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark else ""
        raise ValueError(f"{path}: not valid YAML{line}: {getattr(error, 'problem', None) or 'not text'}") from None


def build(kind: type[T], value: Any, where: str) -> T:
    """A dataclass `kind` from a mapping. Raises ValueError that begins with `where`, the place of the entry.

    >>> from arraygeom.sensor import Band
    >>> build(Band, {"centre": 550, "width": 40}, "band")
    Band(centre=550.0, width=40.0)
    >>> build(Band, {"center": 550, "width": 40}, "band")
    Traceback (most recent call last):
    ValueError: band.center: unknown key; did you mean 'centre'?
    """
    known = {f.name: f for f in dataclasses.fields(kind) if f.init}  # type: ignore[arg-type]
    if not isinstance(value, Mapping):
        raise ValueError(f"{where}: is {value!r}; wanted a mapping with {', '.join(known) or 'nothing in it'}")
    for key in value:
        if key not in known:
            raise ValueError(f"{where}.{key}: unknown key; {near(str(key), known)}")
    for name, f in known.items():
        if name not in value and f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            raise ValueError(f"{where}: has no '{name}', which is needed")
    hints = typing.get_type_hints(kind)
    made = {key: _converted(hints[key], entry, f"{where}.{key}") for key, entry in value.items()}
    try:
        return kind(**made)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {error}") from None


def near(name: str, known: Iterable[str]) -> str:
    """What to say after an unknown name: the nearest known one, or all of them."""
    found = difflib.get_close_matches(name, list(known), 1)
    return f"did you mean '{found[0]}'?" if found else f"known: {', '.join(known) or 'none'}"


def _converted(kind: Any, value: Any, where: str) -> Any:
    origin, options = typing.get_origin(kind), typing.get_args(kind)
    if origin in (Union, types.UnionType):
        return _first_that_fits(options, value, where)
    if origin is Literal:
        if value not in options:
            hint = near(value, options) if isinstance(value, str) else f"known: {', '.join(map(str, options))}"
            raise ValueError(f"{where}: is {value!r}; {hint}")
        return value
    if origin is tuple:
        return _tuple(options, value, where)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _mapping(options, value, where)
    if dataclasses.is_dataclass(kind):
        return build(typing.cast(type, kind), value, where)
    return _plain(kind, value, where)


def _first_that_fits(options: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in options:
        return None
    errors = []
    for option in options:
        try:
            return _converted(option, value, where)
        except ValueError as error:
            errors.append((dataclasses.is_dataclass(option) == isinstance(value, Mapping), str(error)))
    raise ValueError(max(errors, key=lambda e: e[0])[1])


def _tuple(options: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ValueError(f"{where}: is {value!r}; wanted a list")
    if options[-1] is Ellipsis:
        return tuple(_converted(options[0], v, f"{where}[{i}]") for i, v in enumerate(value))
    if len(value) != len(options):
        raise ValueError(f"{where}: has {len(value)} entries; wanted {len(options)}")
    return tuple(_converted(o, v, f"{where}[{i}]") for i, (o, v) in enumerate(zip(options, value)))


def _mapping(options: tuple[Any, ...], value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{where}: is {value!r}; wanted a mapping")
    return {str(key): _converted(options[1], entry, f"{where}.{key}") for key, entry in value.items()}


def _plain(kind: Any, value: Any, where: str) -> Any:
    if kind is Any:
        return value
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if kind is float and isinstance(value, str) and _is_number(value):
        return float(value)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if isinstance(value, kind) and not (kind is int and isinstance(value, bool)):
        return value
    names = {float: "a number", int: "a whole number", str: "text", bool: "true or false", Path: "a path"}
    raise ValueError(f"{where}: is {value!r}; wanted {names.get(kind, kind)}")


def _is_number(text: str) -> bool:
    """YAML takes 1e-3 for text, because it has no point."""
    try:
        float(text)
    except ValueError:
        return False
    return True
