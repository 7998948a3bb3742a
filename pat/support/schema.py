"""Conversion of frozen dataclasses to plain documents (YAML, JSON) and back, with errors that
name the entry."""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import types
import typing
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


def to_document(value: Any, *, defaults: bool = False) -> Any:
    """Convert dataclasses to mappings, tuples to lists, paths to text, also within mappings and lists.

    Args:
        defaults: True to include fields that equal their default, at any depth; otherwise they are left out.

    Returns:
        The document, ready for YAML or JSON if its other values are: they stay as they are.
    """
    plain = partial(to_document, defaults=defaults)
    if dataclasses.is_dataclass(value):
        entries = {f: getattr(value, f.name) for f in dataclasses.fields(value)}
        return {f.name: plain(v) for f, v in entries.items() if defaults or v != _default(f)}
    if isinstance(value, tuple | list):
        return [plain(v) for v in value]
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return str(value) if isinstance(value, Path) else value


def from_document(kind: type[T], document: Any, entry: str = "") -> T:
    """Convert a document to a dataclass, or to another type that its fields may have.

    Args:
        kind: dataclass, or plain type, `Path`, `Literal`, tuple, mapping or union; not `list`.
        document: mappings, lists and plain values; text such as "1e3" is accepted for a number, 2.0 for a
            whole one, and a text alone for a tuple of any length.
        entry: name of the document's place in messages; empty for the whole.

    Returns:
        An instance of `kind`.

    Raises:
        ValueError: naming the entry, for an unknown key, a missing one, NaN, a value of another type, or one
            that a dataclass refuses.
    """
    return typing.cast(T, _read(kind, document, entry))


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file.

    Returns:
        Its content: mappings, lists and plain values; None for an empty file.

    Raises:
        FileNotFoundError: if there is no such file, or it is a folder.
        OSError: if it cannot be read.
        ValueError: with the path, as `parse_yaml`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file: check the path")
    return parse_yaml(path.read_bytes(), str(path))


def parse_yaml(text: str | bytes, name: str) -> Any:
    """Parse a YAML text, as UTF-8 if in bytes.

    Returns:
        Its content: mappings, lists and plain values; None for an empty text.

    Raises:
        ValueError: with `name`, and the line where known, for text that is not YAML or not UTF-8, several
            documents, repeated keys, and what `safe_yaml` limits (size, nesting, aliases).
    """
    import yaml

    from arraygeom.runtime.safe_yaml import load_yaml, text_problem

    try:
        return load_yaml(text if isinstance(text, str) else text.decode("utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        line, problem = text_problem(error)
        position = f" at line {line}" if line else ""
        raise ValueError(f"{name}: not valid YAML{position}: {problem}") from None


def entries_of(path: Path) -> dict[str, Any]:
    """Read the entries of a JSON file.

    Returns:
        Its mapping; empty if the file is missing, damaged, or holds no mapping.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _default(field: dataclasses.Field[Any]) -> Any:
    """The default of a field; MISSING for a required one."""
    made = field.default_factory
    return field.default if made is dataclasses.MISSING else made()


def _read(kind: Any, value: Any, entry: str) -> Any:
    """Convert a value of a document to a type."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _read_dataclass(kind, value, entry)
    if origin is typing.Literal:
        if value not in arguments:
            raise ValueError(f"{entry}: is {_short(value)}{near(value, arguments)}")
        return value
    if origin is tuple:
        return _read_tuple(arguments, value, entry)
    if origin in (dict, Mapping):
        return {k: _read(arguments[1], v, _below(entry, k)) for k, v in _mapping(value, entry).items()}
    if origin in (typing.Union, types.UnionType):
        return _read_union(arguments, value, entry)
    return _read_plain(kind, value, entry)


def _short(value: object) -> str:
    from arraygeom.runtime.text import short  # imports torch, which the help of a command does without

    return short(value)


def _read_dataclass(kind: Any, value: Any, entry: str) -> Any:
    """Convert a mapping to a dataclass. Raises ValueError naming keys that are missing or unknown."""
    fields = {f.name: f for f in dataclasses.fields(kind) if f.init}
    for key in _mapping(value, entry or kind.__name__):
        if key not in fields:
            raise ValueError(f"{_below(entry, key)}: unknown key{near(key, fields)}")
    for name, field in fields.items():
        if name not in value and _default(field) is dataclasses.MISSING:
            raise ValueError(f"{_below(entry, name)}: missing")
    types_ = typing.get_type_hints(kind)
    made = {k: _read(types_[k], v, _below(entry, k)) for k, v in value.items()}
    try:
        return kind(**made)
    except ValueError as error:
        raise ValueError(f"{entry}: {error}" if entry else str(error)) from None


def _read_tuple(arguments: tuple[Any, ...], value: Any, entry: str) -> tuple[Any, ...]:
    if isinstance(value, str) and arguments[1:] == (...,):
        value = [value]
    if not isinstance(value, list | tuple):
        raise ValueError(f"{entry}: is {_short(value)}; wanted a list")
    kinds = (arguments[0],) * len(value) if arguments[1:] == (...,) else arguments
    if len(kinds) != len(value):
        raise ValueError(f"{entry}: has {len(value)} entries; wanted {len(kinds)}")
    return tuple(_read(k, v, f"{entry}[{i}]") for i, (k, v) in enumerate(zip(kinds, value)))


def _mapping(value: Any, entry: str) -> dict[Any, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{entry}: is {_short(value)}; wanted a mapping")
    return value


def _read_union(arguments: tuple[Any, ...], value: Any, entry: str) -> Any:
    """Convert to the first fitting one of several types, or raise the error of one of the same form."""
    if value is None and type(None) in arguments:
        return None
    errors = []
    for kind in (k for k in arguments if k is not type(None)):
        try:
            return _read(kind, value, entry)
        except ValueError as error:
            errors.append((isinstance(value, dict) == dataclasses.is_dataclass(kind), str(error)))
    raise ValueError(max(errors, key=lambda e: e[0])[1])


def _read_plain(kind: Any, value: Any, entry: str) -> Any:
    """Convert to a number, text or path, or raise ValueError naming the entry."""
    if kind is Any:
        return value
    if kind in (int, float) and isinstance(value, str):
        with suppress(ValueError):
            value = float(value)
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        if math.isnan(value):
            raise ValueError(f"{entry}: is NaN; wanted a number")
        return float(value)
    if kind is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    if kind is int and isinstance(value, int) and abs(value) >= 2**63:
        raise ValueError(f"{entry}: is {_short(value)}; wanted a whole number of 63 bits")
    if kind is Path and isinstance(value, str):
        return Path(value).expanduser()
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ValueError(f"{entry}: is {_short(value)}; wanted {_PLAIN.get(kind, kind.__name__)}")
    return value


_PLAIN = {float: "a number", int: "a whole number", str: "text", bool: "true or false", Path: "a path"}


def _below(entry: str, key: object) -> str:
    return f"{entry}.{key}" if entry else str(key)


def check_fields(config: Any, names: str, least: float, most: float = math.inf, above: bool = False) -> None:
    """Check that numbers of a dataclass are in a range, both bounds included.

    Args:
        config: instance of the dataclass.
        names: names of the fields, which hold numbers, with spaces between.
        least: lower bound.
        most: upper bound; by default infinity passes.
        above: True to exclude `least`.

    Raises:
        ValueError: naming the first field that is outside, or NaN.
    """
    for name in names.split():
        value = getattr(config, name)
        if not least <= value <= most or (above and value == least):
            wanted = f"{'more than' if above else 'at least'} {least:g}"
            wanted = wanted if most == math.inf else f"from {least:g} to {most:g}"
            raise ValueError(f"{name} must be {wanted}, got {value:g}")


def near(name: object, choices: Iterable[object]) -> str:
    """Return the ending of a message about an unknown name: the most similar choice, or all choices.

    >>> near("nois", ["noise", "clip"])
    "; did you mean 'noise'?"
    """
    names = [str(k) for k in choices]
    close = difflib.get_close_matches(str(name), names, 1)
    return f"; did you mean '{close[0]}'?" if close else f"; known here: {', '.join(names)}"
