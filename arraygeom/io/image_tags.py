"""What an image file states of its camera: TIFF and EXIF tags, and XMP tags of some makers."""

from __future__ import annotations

import struct
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, NamedTuple

from ..pixels import HW

PIX4D, DJI, MICASENSE = "pix4d.com", "drone-dji", "micasense.com/MicaSense"
"""Parts of the names of XMP's namespaces; those of Pix4D's `Camera:` differ between makers."""
EXIF, GPS, WIDTH, HEIGHT = 0x8769, 0x8825, 256, 257
"""Tags of TIFF (6.0) and EXIF (2.32)."""
LARGEST_XMP = 1 << 20
"""Bytes of an XMP packet, at most: those of cameras have some tens of thousands."""
_TYPES = {1: "B", 2: "c", 3: "H", 4: "I", 5: "II", 9: "i", 10: "ii", 11: "f", 12: "d", 13: "I"}
"""Of TIFF's fields, as `struct` codes."""


class ImageTags(NamedTuple):
    """Size, TIFF and EXIF fields by number, XMP tags by namespace and name (lists joined by commas)."""

    hw: HW
    fields: dict[int, tuple[Any, ...]]
    xmp: dict[tuple[str, str], str]

    def text(self, namespace: str, name: str) -> str | None:
        """An XMP tag; None if it is not stated."""
        return self.xmp.get((namespace, name))


def image_tags(path: Path) -> ImageTags | None:
    """The tags of a TIFF or JPEG file; None for other files, damaged ones, and those without XMP."""
    content = path.read_bytes()
    xmp = _xmp(content)
    if not xmp:
        return None
    try:
        if content[:4] in (b"II*\0", b"MM\0*"):
            fields = _fields(content)
            return ImageTags((int(fields[HEIGHT][0]), int(fields[WIDTH][0])), fields, xmp)
        if content[:2] == b"\xff\xd8":
            return _jpeg(content, xmp)
    except (struct.error, IndexError, KeyError, ValueError):
        pass
    return None


def _jpeg(content: bytes, xmp: dict[tuple[str, str], str]) -> ImageTags | None:
    at, fields = 2, {}
    while at + 9 <= len(content):
        marker, length = struct.unpack_from(">HH", content, at)
        if marker == 0xFFE1 and content[at + 4 : at + 10] == b"Exif\0\0":
            fields = _fields(content[at + 10 : at + 2 + length])
        tables = (0xFFC4, 0xFFC8, 0xFFCC)
        if 0xFFC0 <= marker <= 0xFFCF and marker not in tables:  # the start of a frame
            height, width = struct.unpack_from(">HH", content, at + 5)
            return ImageTags((height, width), fields, xmp)
        at += 2 + length
    return None


def _fields(content: bytes) -> dict[int, tuple[Any, ...]]:
    """Numbers and texts of the first directory of a TIFF file, and of its EXIF and GPS directories."""
    order = "<" if content.startswith(b"II") else ">"
    fields = _directory(content, order, struct.unpack_from(order + "I", content, 4)[0])
    for inner in (EXIF, GPS):
        if inner in fields:
            fields |= _directory(content, order, int(fields[inner][0]))
    return fields


def _directory(content: bytes, order: str, start: int) -> dict[int, tuple[Any, ...]]:
    fields: dict[int, tuple[Any, ...]] = {}
    for i in range(min(struct.unpack_from(order + "H", content, start)[0], 1000)):
        at = start + 2 + 12 * i
        tag, kind, count = struct.unpack_from(order + "HHI", content, at)
        if kind not in _TYPES or count > 4096:
            continue
        form = order + count * _TYPES[kind]
        place = at + 8 if struct.calcsize(form) <= 4 else struct.unpack_from(order + "I", content, at + 8)[0]
        values = struct.unpack_from(form, content, place)
        if kind == 2:
            values = (b"".join(values).split(b"\0")[0].decode("latin-1").strip(),)
        elif kind in (5, 10):
            values = tuple(a / b if b else 0.0 for a, b in zip(values[::2], values[1::2]))
        fields[tag] = values
    return fields


def _xmp(content: bytes) -> dict[tuple[str, str], str]:
    """XMP tags of the namespaces above; empty if there are none, or the packet is damaged."""
    begin = content.find(b"<x:xmpmeta")
    end = content.find(b"</x:xmpmeta>", begin)
    if begin < 0 or not 0 < end - begin < LARGEST_XMP:
        return {}
    packet = content[begin : end + len(b"</x:xmpmeta>")]
    if b"<!DOCTYPE" in packet or b"<!ENTITY" in packet:
        return {}
    try:
        root = ET.fromstring(packet)
    except ET.ParseError:
        return {}
    tags: dict[tuple[str, str], str] = {}
    for described in root.iter("{http://www.w3.org/1999/02/22-rdf-syntax-ns#}Description"):
        parts = [(key, value) for key, value in described.attrib.items()]
        parts += [
            (child.tag, ",".join(text for part in child.itertext() if (text := part.strip())))
            for child in described
        ]
        for key, value in parts:
            uri, _, name = key.removeprefix("{").partition("}")
            namespace = next((known for known in (PIX4D, DJI, MICASENSE) if known in uri), None)
            if namespace and name:
                tags[namespace, name] = value.strip()
    return tags
