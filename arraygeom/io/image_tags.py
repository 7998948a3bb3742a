"""What an image file states of its camera: TIFF and EXIF tags, and XMP tags of some makers."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, NamedTuple

from ..extras import needs
from ..pixels import HW

PIX4D, DJI, MICASENSE = "pix4d.com", "drone-dji", "micasense.com/MicaSense"
"""Parts of the names of XMP's namespaces; those of Pix4D's `Camera:` differ between makers."""
EXIF, GPS = 0x8769, 0x8825
"""Tags of TIFF's directories with EXIF's fields (2.32)."""
LARGEST_XMP = 1 << 20
"""Bytes of an XMP packet, at most: those of cameras have some tens of thousands."""


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
    xmp = _xmp(path.read_bytes())
    if not xmp:
        return None
    with needs("calibration", "reading images' tags"):
        from PIL import Image
    try:
        with Image.open(path, formats=("TIFF", "JPEG")) as image:
            exif = image.getexif()
            stated = dict(exif) | exif.get_ifd(EXIF) | exif.get_ifd(GPS)
            values = {tag: v if isinstance(v, tuple) else (v,) for tag, v in stated.items()}
            # 0 / 0 is NaN, by which cameras say that they do not know
            fields = {tag: tuple(0.0 if v != v else v for v in each) for tag, each in values.items()}
            return ImageTags((image.height, image.width), fields, xmp)
    except Exception:  # whatever Pillow trips over in a damaged file
        return None


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
            (child.tag, ",".join(text for raw in child.itertext() if (text := raw.strip())))
            for child in described
        ]
        for key, value in parts:
            uri, _, name = key.removeprefix("{").partition("}")
            namespace = next((candidate for candidate in (PIX4D, DJI, MICASENSE) if candidate in uri), None)
            if namespace and name:
                tags[namespace, name] = value.strip()
    return tags
