"""Damage to files: bytes, lines, numbers and structure, all from a seed."""

from __future__ import annotations

import json
import random
import re
import struct
from collections.abc import Callable
from typing import Any

import yaml

from .pieces import PIECES, rearranged

LOADER, DUMPER = (getattr(yaml, f"C{name}", getattr(yaml, name)) for name in ("SafeLoader", "SafeDumper"))
NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?![\w.])")
EXTREMES = (
    b"0|-1|1|nan|.nan|NaN|inf|-.inf|Infinity|1e308|-1e308|1e-308|1e400|99999999999999999999|2147483648"
    b'|4294967296|65536|1e76|0x10|1_000|1e9|3.5|-0||null|true|abc|"1"|[]|{}|[1]|[[1, 2], 3]|{a: 1}'
    b"|~|2001-01-01|*a"
).split(b"|")
VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 1e308, -1e308, 1e-308, float("nan"), float("inf"), 10**20, 2**31),
    *(1e76, 1e9, 3.5, "", "a", "1", "\0", "é" * 20, "x" * 5000, [], {}, [1], [[]], [1, "a"], {"a": 1}),
    *([None], [[1, 2], [3]], [0] * 2000),
)
BINARY = (0, 1, 0x7F, 0x80, 0xFF)
WORDS = (0, 1, -1, 2**31 - 1, -(2**31), 10**6, 2**24)

Mutation = Callable[[random.Random, bytes], bytes]


def mutated(content: bytes, source: random.Random, *, text: bool, suffix: str = "") -> bytes:
    """The file's content with one to four kinds of damage, drawn from `source`."""
    kinds: list[Mutation] = list(TEXT if text else BYTES)
    if text and suffix in (".yaml", ".yml", ".json"):
        kinds += [lambda s, c: structure(s, c, suffix)] * len(kinds)
    if suffix == ".json":
        kinds += [repeat_keys, half_character]
    if suffix == ".safetensors":
        kinds += [absurd_header] * len(kinds)
    if suffix in PIECES:
        kinds += [lambda s, c: rearranged(s, c, suffix)] * len(kinds)
    for _ in range(source.choice([1, 1, 1, 2, 4])):
        content = source.choice(kinds)(source, content)
    return content


def absurd_header(source: random.Random, content: bytes) -> bytes:
    """Weights whose header claims a length, a shape, offsets or a type that no file has."""
    length = struct.unpack_from("<Q", content)[0] if len(content) > 8 else 0
    header = content[8 : 8 + length]
    if source.randrange(3) == 0 or not NUMBER.search(header):
        claimed = source.choice((0, 1, 2**31, 2**40, 2**63, 2**64 - 1, len(content)))
        return struct.pack("<Q", claimed) + content[8:]
    found = source.choice(list(NUMBER.finditer(header)))
    number = source.choice(
        (b"0", b"-1", b"4294967296", b"18446744073709551615", b"1e30", b"true", b'"F99"', b"[2,[3]]")
    )
    changed = header[: found.start()] + number + header[found.end() :]
    return struct.pack("<Q", len(changed)) + changed + content[8 + length :]


def truncate(source: random.Random, content: bytes) -> bytes:
    return content[: source.randrange(len(content) + 1)]


def flip(source: random.Random, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(source.choice([1, 2, 8, 64])):
        if changed:
            changed[source.randrange(len(changed))] = source.choice((*BINARY, source.randrange(256)))
    return bytes(changed)


def overwrite_word(source: random.Random, content: bytes) -> bytes:
    """A 4-byte or 8-byte integer or a double of an extreme value somewhere, the file's length unchanged."""
    real = source.choice((0.0, 1e308, float("nan"), float("inf"), -1.0))
    word = source.choice(WORDS)
    packed = source.choice(
        [struct.pack("<i", word), struct.pack(">i", word), struct.pack("<q", word), struct.pack("<d", real)]
    )
    at = source.randrange(max(len(content) - len(packed), 1))
    return content[:at] + packed + content[at + len(packed) :]


def insert(source: random.Random, content: bytes) -> bytes:
    at = source.randrange(len(content) + 1)
    piece = source.choice(
        [bytes(source.randrange(256) for _ in range(8)), b"\0", b"\0" * 4096, content[at : at + 200] * 3]
    )
    return content[:at] + piece + content[at:]


def remove(source: random.Random, content: bytes) -> bytes:
    at = source.randrange(len(content) + 1)
    return content[:at] + content[at + source.choice([1, 4, 20, 200]) :]


def number(source: random.Random, content: bytes) -> bytes:
    """A number replaced by something extreme, or by text."""
    found = list(NUMBER.finditer(content))
    if not found:
        return content
    chosen = source.choice(found)
    return content[: chosen.start()] + source.choice(EXTREMES) + content[chosen.end() :]


def lines(source: random.Random, content: bytes) -> bytes:
    """A line lost, repeated, moved, or indented otherwise."""
    parts = content.splitlines(keepends=True)
    if not parts:
        return content
    i, j = source.randrange(len(parts)), source.randrange(len(parts))
    kind = source.randrange(5)
    if kind == 0:
        del parts[i]
    elif kind == 1:
        parts.insert(j, parts[i])
    elif kind == 2:
        parts[i], parts[j] = parts[j], parts[i]
    elif kind == 3:
        parts[i] = source.choice([b" ", b"\t", b"    "]) + parts[i]
    else:
        parts[i] = parts[i].lstrip()
    return b"".join(parts)


def token(source: random.Random, content: bytes) -> bytes:
    """A word, bracket, quote or colon lost or repeated."""
    found = list(re.finditer(rb"\w+|[\[\]{}:,\"'<>/=-]", content))
    if not found:
        return content
    chosen = source.choice(found)
    again = source.choice([b"", chosen[0] * 2, source.choice(found)[0]])
    return content[: chosen.start()] + again + content[chosen.end() :]


def recode(source: random.Random, content: bytes) -> bytes:
    kind = source.randrange(4)
    if kind == 0:
        return b"\xef\xbb\xbf" + content
    if kind == 1:
        return content.replace(b"\n", b"\r\n")
    text = content.decode("utf-8", errors="replace")
    return text.encode("utf-16") if kind == 2 else text.replace("\n", "\u2028").encode()


def deepen(source: random.Random, content: bytes) -> bytes:
    """Nesting, anchors and aliases, or a long list in place of a number."""
    found = list(NUMBER.finditer(content))
    at = source.choice(found) if found else None
    bomb = b"a: &a [1,1,1,1,1,1,1,1,1]\n" + b"".join(
        b"%c: &%c [%s]\n" % (c + 1, c + 1, b",".join([b"*%c" % c] * 9)) for c in range(ord("a"), ord("i"))
    )
    depth = source.choice([60, 3000])
    pieces = [
        b"[" * depth + b"]" * depth,
        b"{a: " * depth + b"}" * depth,
        b"[" + b"0," * 100_000 + b"0]",
        b"9" * 5000,
    ]
    if source.randrange(4) == 0:
        return bomb + content if source.randrange(2) else content + b"\n" + bomb
    piece = source.choice(pieces)
    return content + piece if at is None else content[: at.start()] + piece + content[at.end() :]


def repeat_keys(source: random.Random, content: bytes) -> bytes:
    """A key of a JSON document twice, or some thousand keys twice each."""
    keys = list(re.finditer(rb'"[^"]*"\s*:', content))
    if not keys:
        return content
    chosen = source.choice(keys)
    some = b"".join(b'"%d": 0, ' % i for i in range(source.choice([1, 30_000])))
    return (
        content[: chosen.start()] + source.choice([chosen[0] + b" 0, ", some * 2]) + content[chosen.start() :]
    )


def half_character(source: random.Random, content: bytes) -> bytes:
    """A lone surrogate in a text of a JSON document."""
    quotes = [i for i, byte in enumerate(content) if byte == ord('"')]
    at = source.choice(quotes) if quotes else len(content)
    return content[: at + 1] + source.choice([b"\\ud800", b"\\udfff", b"\\ud83d\\ud83d"]) + content[at + 1 :]


def structure(source: random.Random, content: bytes, suffix: str) -> bytes:
    """One node of a JSON or YAML document replaced, removed, renamed or repeated; else a number changed."""
    if b"&" in content:  # aliases may stand for more than can be walked through
        return number(source, content)
    try:
        plain = content.replace(b"%YAML:1.0", b"")
        document = json.loads(content) if suffix == ".json" else yaml.load(plain, LOADER)
        nodes = list(_nodes(document))
    except Exception:
        return number(source, content)
    if not nodes:
        return number(source, content)
    parent, key = source.choice(nodes)
    kind = source.randrange(5)
    if kind <= 2:
        parent[key] = source.choice(VALUES)
    elif kind == 3:
        del parent[key]
    else:
        value = parent[key]
        parent[key] = [value, value] if source.randrange(2) else {"a": value}
    if suffix == ".json":
        return json.dumps(document, default=str).encode()
    return yaml.dump(document, Dumper=DUMPER, default_flow_style=None).encode()


def _nodes(document: Any) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    if isinstance(document, dict | list):
        for key in list(document) if isinstance(document, dict) else range(len(document)):
            found += [(document, key), *_nodes(document[key])]
    return found


TEXT: tuple[Mutation, ...] = (
    *(truncate, flip, insert, remove, number, number, number, lines, token, token, recode, deepen),
)
BYTES: tuple[Mutation, ...] = (truncate, flip, flip, overwrite_word, overwrite_word, insert, remove)
