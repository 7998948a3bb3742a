"""What the head of an image file states: its size before anything is decoded, and its orientation tag."""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

from arraygeom.image_bytes import PNG, TIFF, png_chunks, tiff_entries

HW = tuple[int, int]

_WIDTH, _HEIGHT, _BITS, _ORIENTATION = 256, 257, 258, 274


class ImageHeader(NamedTuple):
    """(height, width) as stored, the orientation tag (1 to 8; 1 without one), and the bits a value of a TIFF, PNG or
    PNM file (else 0).

    `tag` is where a TIFF file has its orientation: byte offset and struct format; None without one, and in other files.
    """

    hw: HW
    orientation: int = 1
    bits: int = 0
    tag: tuple[int, str] | None = None

    @property
    def upright(self) -> HW:
        """(height, width) with the orientation applied."""
        return self.hw[::-1] if self.orientation >= 5 else self.hw


def image_header(content: bytes) -> ImageHeader | None:
    """The header of a PNG, TIFF, JPEG, PNM, BMP or WebP file; None for other and for damaged files."""
    try:
        if content.startswith(PNG):
            return _png(content)
        if content.startswith(b"\xff\xd8"):
            return _jpeg(content)
        if content[:4] in TIFF:
            return _tiff(content)
        if content.startswith(b"RIFF") and content[8:12] == b"WEBP":
            return _webp(content)
        return _bmp(content) if content.startswith(b"BM") else _pnm(content)
    except (struct.error, IndexError, KeyError, ValueError):
        return None


def _png(content: bytes) -> ImageHeader:
    width, height = struct.unpack_from(">II", content, 16)
    orientation = 1
    for kind, start, end in png_chunks(content):
        if kind == b"eXIf":
            orientation = _exif_orientation(content[start + 8 : end - 4])
    return ImageHeader((height, width), orientation, content[24])


def _jpeg(content: bytes) -> ImageHeader | None:
    at, orientation = 2, 1
    while at + 4 <= len(content):
        marker, length = struct.unpack_from(">HH", content, at)
        if marker == 0xFFFF:
            at += 1
            continue
        if marker == 0xFFE1 and content[at + 4 : at + 10] == b"Exif\0\0":
            orientation = _exif_orientation(content[at + 10 : at + 2 + length])
        # Start of a frame; C4, C8 and CC are tables.
        if 0xFFC0 <= marker <= 0xFFCF and marker not in (0xFFC4, 0xFFC8, 0xFFCC):
            return ImageHeader(struct.unpack_from(">HH", content, at + 5), orientation)
        at += 2 + length
    return None


def _webp(content: bytes) -> ImageHeader | None:
    at, orientation, size = 12, 1, None
    while at + 8 <= len(content):
        kind, length = struct.unpack_from("<4sI", content, at)
        data = content[at + 8 : at + 8 + length]
        if kind == b"VP8X":
            size = 1 + int.from_bytes(data[7:10], "little"), 1 + int.from_bytes(data[4:7], "little")
        elif kind == b"VP8 " and size is None:
            width, height = struct.unpack_from("<HH", data, 6)
            size = height & 0x3FFF, width & 0x3FFF
        elif kind == b"VP8L" and size is None:
            packed = struct.unpack_from("<I", data, 1)[0]
            size = 1 + (packed >> 14 & 0x3FFF), 1 + (packed & 0x3FFF)
        elif kind == b"EXIF":
            orientation = _exif_orientation(data.removeprefix(b"Exif\0\0"))
        at += 8 + length + length % 2
    return ImageHeader(size, orientation) if size else None


def _bmp(content: bytes) -> ImageHeader:
    old = struct.unpack_from("<I", content, 14)[0] == 12
    width, height = struct.unpack_from("<HH" if old else "<ii", content, 18)
    return ImageHeader((abs(height), width))


def _pnm(content: bytes) -> ImageHeader | None:
    gap = rb"(?:\s|#[^\n]*\n)+"
    found = re.match(rb"P[1-6]" + gap + rb"(\d{1,9})" + gap + rb"(\d{1,9})\s(?:\s*(\d{1,5})\s)?", content[:4096])
    return ImageHeader((int(found[2]), int(found[1])), bits=16 if int(found[3] or 0) > 255 else 8) if found else None


def _tiff(content: bytes) -> ImageHeader:
    entries = tiff_entries(content)
    tag = entries.get(_ORIENTATION)
    bits = entries[_BITS].value if _BITS in entries else 1
    size = entries[_HEIGHT].value, entries[_WIDTH].value
    return ImageHeader(size, _known(tag.value) if tag else 1, bits, (tag.place, tag.form) if tag else None)


def _exif_orientation(exif: bytes) -> int:
    """Of an Exif block, which is a TIFF file without an image; 1 if it is damaged."""
    try:
        return _known(tiff_entries(exif).get(_ORIENTATION, (1,))[0])
    except (struct.error, IndexError, ValueError):
        return 1


def _known(orientation: int) -> int:
    return orientation if 1 <= orientation <= 8 else 1
