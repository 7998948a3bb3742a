"""Bytes of image files, checked before a decoder that trusts them sees them.

OpenCV 4.11 to 4.13 crash on damaged animated PNGs and take what is missing of a planar TIFF for black.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

PNG = b"\x89PNG\r\n\x1a\n"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
ANIMATION = (b"acTL", b"fcTL", b"fdAT")
"""Chunks of a PNG file beside those of its first image."""
MOST_ENTRIES = 1000
"""Of a TIFF directory; files of cameras have some 50."""

_FORMATS = {1: "B", 3: "H", 4: "I", 16: "Q"}
"""Codes of TIFF's unsigned types."""
_PLACES = ((273, 279), (324, 325))
"""Tags of the offsets of strips and of tiles, and of their byte counts."""


class TiffEntry(NamedTuple):
    """Unsigned integers of a TIFF directory: the first, where in the file it is, their struct format and number."""

    value: int
    place: int
    form: str
    values: int


def decodable(content: bytes) -> bytes | None:
    """The bytes to give to OpenCV: a PNG without its animation, a TIFF if it is whole, others as they are.

    None for a TIFF that lacks some of its pixels.
    """
    if content.startswith(PNG):
        return _still(content)
    if content[:4] in TIFF and not _is_whole(content):
        return None
    return content


def png_chunks(content: bytes) -> list[tuple[bytes, int, int]]:
    """Kind, start and end of each chunk of a PNG file, whose last may be cut."""
    chunks, start = [], len(PNG)
    while start + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, start)
        chunks.append((kind, start, start + 12 + length))
        start += 12 + length
    return chunks


def tiff_entries(content: bytes) -> dict[int, TiffEntry]:
    """The first directory of a TIFF file by tag, unsigned integers only. Raises struct.error where it is cut."""
    order = "<" if content.startswith(b"II") else ">"
    big = struct.unpack_from(order + "H", content, 2)[0] == 43
    word, count, head, length = ("Q", "Q", 8, 20) if big else ("I", "H", 4, 12)
    start = struct.unpack_from(order + word, content, head)[0]
    entries = {}
    for i in range(min(struct.unpack_from(order + count, content, start)[0], MOST_ENTRIES)):
        at = start + struct.calcsize("=" + count) + i * length
        tag, kind, values = struct.unpack_from(order + "HH" + word, content, at)
        if kind not in _FORMATS or values < 1:
            continue
        form, place = order + _FORMATS[kind], at + 4 + struct.calcsize("=" + word)
        if values * struct.calcsize(form) > struct.calcsize("=" + word):
            place = struct.unpack_from(order + word, content, place)[0]
        entries[tag] = TiffEntry(struct.unpack_from(form, content, place)[0], place, form, values)
    return entries


def _still(content: bytes) -> bytes:
    chunks = png_chunks(content)
    return PNG + b"".join(content[start:end] for kind, start, end in chunks if kind not in ANIMATION)


def _is_whole(content: bytes) -> bool:
    """Whether all strips or tiles of a TIFF file's first image lie within the file."""
    try:
        entries = tiff_entries(content)
        for offsets, counts in _PLACES:
            if offsets in entries and counts in entries:
                ends = _values(content, entries[offsets]) + _values(content, entries[counts])
                if len(ends) and ends.max() > len(content):
                    return False
    except (struct.error, OverflowError, ValueError):
        return False
    return True


def _values(content: bytes, entry: TiffEntry) -> np.ndarray:
    """As float64, in which sums of 64 bits do not wrap. Raises ValueError where the file ends before the last."""
    return np.frombuffer(content, np.dtype(entry.form), entry.values, entry.place).astype(np.float64)
