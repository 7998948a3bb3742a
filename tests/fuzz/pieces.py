"""Damage to files made of pieces: chunks of PNG, WebP, segments of JPEG, boxes of MP4, entries of TIFF."""

from __future__ import annotations

import io
import random
import struct
import zlib
from collections.abc import Callable
from functools import partial

import tifffile

Span = tuple[int, int]


def rearranged(source: random.Random, content: bytes, suffix: str) -> bytes:
    """The file with a piece lost, repeated, moved, cut, or with a number of its own changed.

    Checksums of PNG are made anew: else a decoder reads no further than the first damaged chunk.
    """
    spans = PIECES[suffix](content)
    if not spans:
        return content
    (first, last), (place, _) = source.choice(spans), source.choice(spans)
    piece, rest = content[first:last], content[:first] + content[last:]
    kind = source.randrange(5)
    if kind == 0:
        changed = rest
    elif kind == 1:
        changed = content[:place] + piece + content[place:]
    elif kind == 2:
        changed = rest[:place] + piece + rest[place:]
    else:
        own = piece[: source.randrange(len(piece) + 1)] if kind == 3 else _with_number(source, piece)
        changed = content[:first] + own + content[last:]
    return _with_checksums(changed) if suffix == ".png" else changed


def _with_number(source: random.Random, piece: bytes) -> bytes:
    """A number within a piece, small or extreme, of 1, 2 or 4 bytes."""
    number = source.choice((0, 1, 2, 3, 100, 2**15, 2**31 - 1, 2**31, 2**32 - 1))
    form = source.choice((">B", ">H", "<H", ">I", "<I"))
    packed = struct.pack(form, number % 2 ** (8 * struct.calcsize(form)))
    at = source.randrange(max(len(piece) - len(packed), 1))
    return piece[:at] + packed + piece[at + len(packed) :]


def _walked(content: bytes, start: int, form: str, extra: int) -> list[Span]:
    """Pieces that begin with a length, which does not count `extra` of their bytes."""
    spans = []
    while start + struct.calcsize(form) <= len(content) and len(spans) < 1000:
        length = struct.unpack_from(form, content, start)[0] + extra
        spans.append((start, min(start + length, len(content))))
        start += max(length, 1)
    return spans


def _tiff(content: bytes) -> list[Span]:
    try:
        start = struct.unpack_from("<I", content, 4)[0]
        count = struct.unpack_from("<H", content, start)[0]
    except struct.error:
        return []
    return [(start + 2 + 12 * i, start + 14 + 12 * i) for i in range(min(count, 100))]


def pixels_damaged(source: random.Random, content: bytes, suffix: str) -> bytes:
    """The file with four bytes of its compressed pixels changed; checksums of PNG are made anew."""
    spans = COMPRESSED[suffix](content)
    changed = bytearray(content)
    for first, last in source.choices(spans, [last - first for first, last in spans], k=4):
        changed[source.randrange(first, last)] ^= source.randrange(1, 256)
    return _with_checksums(bytes(changed)) if suffix == ".png" else bytes(changed)


def _idat(content: bytes) -> list[Span]:
    return [(a + 8, b - 4) for a, b in PIECES[".png"](content) if content[a + 4 : a + 8] == b"IDAT"]


def _scan(content: bytes) -> list[Span]:
    """The coded pixels of a JPEG file's scans, after the header of each."""
    spans, start = [], content.find(b"\xff\xda")
    while start >= 0:
        first = start + 2 + struct.unpack_from(">H", content, start + 2)[0]
        start = content.find(b"\xff\xda", first)
        last = content.rfind(b"\xff\xc4", first, start) if start >= 0 else len(content) - 2
        spans.append((first, last if last > first else start))
    return spans


def _strips(content: bytes) -> list[Span]:
    with tifffile.TiffFile(io.BytesIO(content)) as file:
        page = file.pages.first
        return [(a, a + b) for a, b in zip(page.dataoffsets, page.databytecounts)]


def _frames(content: bytes) -> list[Span]:
    """The coded pixels of a WebP file, after the head of their chunk."""
    chunks = [(a, b) for a, b in PIECES[".webp"](content) if content[a : a + 3] == b"VP8"]
    return [(a + 18, b) for a, b in chunks]


COMPRESSED: dict[str, Callable[[bytes], list[Span]]] = {
    ".png": _idat,
    ".jpg": _scan,
    ".tif": _strips,
    ".webp": _frames,
}
"""Where a file's compressed pixels are, by suffix."""


PIECES: dict[str, Callable[[bytes], list[Span]]] = {
    ".png": partial(_walked, start=8, form=">I", extra=12),
    ".webp": partial(_walked, start=12, form="<4xI", extra=8),
    ".jpg": partial(_walked, start=2, form=">2xH", extra=2),
    ".mp4": partial(_walked, start=0, form=">I", extra=0),
    ".tif": _tiff,
}


def _with_checksums(content: bytes) -> bytes:
    made = [content[:8]]
    for first, last in PIECES[".png"](content):
        body = content[first + 4 : last - 4]
        made.append(content[first : first + 4] + body + struct.pack(">I", zlib.crc32(body)))
    return b"".join(made)
