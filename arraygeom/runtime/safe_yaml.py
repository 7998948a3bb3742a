"""YAML and JSON of unknown origin: limited nesting, YAML with limited size and aliases, no repeated keys.

The only loaders of both in the project. They build plain values only. Users of them may still run code that a
document names: a field or a generator MODULE:OBJECT, which commands import only if their own options name it
too.
"""

from __future__ import annotations

import json
import re
from typing import Any

import yaml

LARGEST_TEXT = 2**25
"""Largest number of characters. 3,000 cameras take about 1 million."""
DEEPEST = 50
"""Largest nesting of lists and mappings. The deepest format of the project has 8."""
MOST_VALUES = 2_000_000
"""Largest number of keys and values, repeated ones of aliases included. 20,000 cameras take 1.3 million."""
MOST_ALIASED = 100_000
"""Largest number of values that aliases repeat, in total, counted as if they were written out."""

_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def load_yaml(text: str) -> Any:
    """Load the document of a YAML text.

    Returns:
        Plain values: dicts, lists, texts, numbers, booleans, None, and YAML's dates, sets, pairs and bytes;
        None for an empty text or document.

    Raises:
        yaml.YAMLError: with the line where known, for text that is not YAML, several documents, tags of other
            types, repeated keys (1 and "1" are the same key, and so are 1 and true), and documents beyond
            this module's limits.
    """
    if len(text) > LARGEST_TEXT:
        raise _refused(f"has {len(text):,} characters; at most {LARGEST_TEXT:,} are read")
    try:
        _check_extent(text)
        return yaml.load(text, _SafeLoader)
    except yaml.YAMLError:
        raise
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        raise _refused(f"holds a value that cannot be read ({' '.join(str(error).split())[:200]})") from None


def load_json(text: str) -> Any:
    """Load the document of a JSON text.

    Returns:
        Plain values; NaN and Infinity are floats, as by `json`.

    Raises:
        json.JSONDecodeError: with the line, for text that is not JSON.
        ValueError: for repeated keys, an escaped lone surrogate (half a character, which cannot be printed),
            integers of thousands of digits, and too deep nesting.
    """
    try:
        document = json.loads(text, object_pairs_hook=_without_repeated_keys)
        if "\\u" in text:
            json.dumps(document, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise ValueError(
            f"holds half a character ({error.object[error.start]!a}): write it as UTF-8"
        ) from None
    except RecursionError:
        raise ValueError("is nested too deeply") from None
    return document


def _without_repeated_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for name, value in pairs:
        if name in fields:
            raise ValueError(
                f"'{name[:60]}' occurs twice; keep one".encode(errors="backslashreplace").decode()
            )
        fields[name] = value
    return fields


def text_problem(error: Exception) -> tuple[int | None, str]:
    """Return the line (from 1; None if unknown) and the problem of an error of YAML, JSON or TOML."""
    mark = getattr(error, "problem_mark", None)
    line = mark.line + 1 if mark else getattr(error, "lineno", None)
    return line, getattr(error, "problem", None) or getattr(error, "msg", None) or str(error) or "not text"


def _refused(problem: str, mark: Any = None) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, problem, mark)


def _check_extent(text: str) -> None:
    """Refuse a document that nests too deeply or grows too large by aliases, before anything is built."""
    sizes: dict[str, int] = {}
    open_nodes: list[tuple[str | None, int]] = []  # the anchor of each, and how many values came before it
    values = aliased = 0
    for event in yaml.parse(text, _Base):
        if values > MOST_VALUES:
            raise _refused(f"has more than {MOST_VALUES:,} values", event.start_mark)
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise _refused(
                    f"alias *{event.anchor} is within, or before, what it stands for", event.start_mark
                )
            values += sizes[event.anchor]
            aliased += sizes[event.anchor]
            if aliased > MOST_ALIASED:
                raise _refused(f"aliases repeat more than {MOST_ALIASED:,} values", event.start_mark)
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, values))
            values += 1
            if len(open_nodes) > DEEPEST:
                raise _refused(f"is nested more than {DEEPEST} deep", event.start_mark)
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = values - before
        elif isinstance(event, yaml.ScalarEvent):
            values += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1


class _SafeLoader(_Base):  # type: ignore[misc]
    """YAML loader in which a repeated key is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Build a mapping as PyYAML does, but refuse repeated keys; those merged in by << do not count.

        Raises:
            yaml.YAMLError: for keys that are equal or read alike (1 and "1"), or one that cannot be a key.
        """
        lines: dict[Any, int] = {}
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key, line = self.construct_object(key_node, deep=True), key_node.start_mark.line + 1
            # Other keys (lists, say) are left to the parent, which refuses what cannot be a key.
            spellings = (key, str(key)) if isinstance(key, str | int | float | None) else ()
            former = next((lines[s] for s in spellings if s in lines), None)
            if former is not None:
                problem = f"'{key}' occurs twice, in lines {former} and {line}: keep one"
                raise _refused(problem, key_node.start_mark)
            lines |= dict.fromkeys(spellings, line)
        return dict(super().construct_mapping(node, deep))


class SafeDumper(yaml.SafeDumper):
    """YAML dumper that quotes texts such as 1e3, which `load_yaml` would read as numbers."""


for _kind in (
    _SafeLoader,
    SafeDumper,
):  # YAML 1.2's numbers, as other libraries write them: PyYAML wants 1.0e-3
    _kind.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
        list("-+.0123456789"),
    )


def dump_yaml(document: Any, **layout: Any) -> str:
    """Format a document of plain values as YAML, keys in their order; `layout` as for `yaml.dump`."""
    return str(yaml.dump(document, Dumper=SafeDumper, sort_keys=False, **layout))
