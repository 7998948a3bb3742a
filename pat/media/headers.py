"""Headers of image files, read before anything is decoded: size, orientation, focal length."""

from __future__ import annotations

import math
import re
import struct
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.WebPImagePlugin import WebPImageFile

from arraygeom.runtime.image_bytes import DAMAGED, PNG, TIFF, first_tiff_page, png_chunks

HW = tuple[int, int]

_ORIENTATION = 274
_EXIF, _FOCAL, _FOCAL_35MM, _WIDTH, _HEIGHT = 0x8769, 0x920A, 0xA405, 0xA002, 0xA003
_PLANE_RESOLUTION, _PLANE_UNIT = 0xA20E, 0xA210
_DIAGONAL_35MM = 43.267
"""Diagonal of 36 x 24 mm, in mm."""
_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""Millimetres of the EXIF units of a sensor's resolution: inch, cm, mm, micrometre."""
_FILES: dict[bytes, Any] = {b"\xff\xd8": JpegImageFile, b"RI": WebPImageFile, b"BM": BmpImageFile}
"""Pillow's readers by a file's first bytes. `Image.open` would refuse large images that are expected here."""


class ImageHeader(NamedTuple):
    """Header of an image file.

    Attributes:
        hw: stored (height, width).
        orientation: EXIF orientation tag, 1 to 8; 1 where there is none.
        bits: bits of a value in TIFF, PNG and PNM files; 0 for others.
        tag: byte offset and struct format of a TIFF file's orientation; None for other files and without one.
        white: largest value that a PNM file states; 0 for others.
    """

    hw: HW
    orientation: int = 1
    bits: int = 0
    tag: tuple[int, str] | None = None
    white: int = 0

    @property
    def upright(self) -> HW:
        """(height, width) after the orientation is applied."""
        return self.hw[::-1] if self.orientation >= 5 else self.hw


def image_header(content: bytes) -> ImageHeader | None:
    """Parse the header of a PNG, TIFF, JPEG, PNM, BMP or WebP file from its bytes.

    Returns:
        The header; None for another format and for a damaged file.
    """
    try:
        if content.startswith(PNG):
            return _png(content)
        if content[:4] in TIFF:
            return _tiff(content)
        if content[:2] not in _FILES:
            return _pnm(content)
        image = _FILES[content[:2]](BytesIO(content))
    except DAMAGED:
        return None
    return ImageHeader(image.size[::-1], _exif_orientation(image.info.get("exif", b"")))


def _png(content: bytes) -> ImageHeader:
    """Parse a PNG header by hand: Pillow decodes the whole image to find a tag behind it."""
    width, height = struct.unpack_from(">II", content, 16)
    tags = [content[start + 8 : end - 4] for kind, start, end in png_chunks(content) if kind == b"eXIf"]
    return ImageHeader((height, width), _exif_orientation(tags[-1] if tags else b""), content[24])


def _pnm(content: bytes) -> ImageHeader | None:
    """Parse a PNM header by hand: Pillow does not report the largest value."""
    gap = rb"(?:\s|#[^\n]*\n)+"
    largest = gap + rb"(\d{1,5})" if content[1:2] in b"2356" else rb"()"
    form = rb"P[1-6]" + gap + rb"(\d{1,9})" + gap + rb"(\d{1,9})" + largest + rb"\s"
    header = re.match(form, content[:4096])
    if header is None:
        return None
    white = int(header[3] or 0)
    return ImageHeader((int(header[2]), int(header[1])), bits=max(white.bit_length(), 8), white=white)


def _tiff(content: bytes) -> ImageHeader | None:
    page = first_tiff_page(content)
    tag, bits = page.tags.get(_ORIENTATION), int(np.max(page.bitspersample))
    place = (tag.valueoffset, page.parent.byteorder + tag.dataformat) if tag else None
    hw = int(page.imagelength), int(page.imagewidth)
    return ImageHeader(hw, _known(tag.value) if tag else 1, bits, place) if min(hw) > 0 else None


def _exif_orientation(exif: bytes) -> int:
    """Orientation in an EXIF block; 1 if the block is damaged."""
    tags = Image.Exif()
    try:
        tags.load(exif)
        return _known(tags.get(_ORIENTATION, 1))
    except DAMAGED:
        return 1


def _known(orientation: object) -> int:
    return int(orientation) if isinstance(orientation, int) and 1 <= orientation <= 8 else 1


def focal_length(path: str | Path, hw: HW) -> float | None:
    """Read a photograph's focal length from its EXIF tags.

    Args:
        hw: size of the image that the focal length is wanted for; the file's first image may be a thumbnail.

    Returns:
        Focal length in pixels, from the sensor's resolution or else the 35 mm equivalent; None if the tags do
        not state it or the file cannot be read.
    """
    try:
        with Image.open(path) as image:
            tags = image.getexif().get_ifd(_EXIF)
        focal, resolution = (_number(tags.get(tag)) for tag in (_FOCAL, _PLANE_RESOLUTION))
        unit = _MM.get(int(_number(tags.get(_PLANE_UNIT)) or 2))
        if focal and resolution and unit:
            longer = max(_number(tags.get(tag)) or 0.0 for tag in (_WIDTH, _HEIGHT)) or max(hw)
            return focal * resolution / unit * max(hw) / longer
        film = _number(tags.get(_FOCAL_35MM))
        return film * math.hypot(*hw) / _DIAGONAL_35MM if film else None
    except (*DAMAGED, Image.DecompressionBombError):
        return None


def _number(value: object) -> float | None:
    number = float(value) if value is not None else 0.0  # type: ignore[arg-type]
    return number if math.isfinite(number) and number > 0 else None
