"""Values of image files as the files state them, whatever OpenCV makes of them."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np

from arraygeom.runtime.image_bytes import (
    DAMAGED,
    ORIENTATION,
    PNM_OF_TEXT,
    SEPARATE,
    ImageHeader,
    decoded,
    quiet_tiff,
)

GREY_TIFF = MINISWHITE, _MINISBLACK = 0, 1
"""Values of TIFF PhotometricInterpretation."""


def stored_values(content: bytes, header: ImageHeader) -> Any:
    """Decode an image file's values as the file states them, not turned by an orientation tag.

    Corrected are OpenCV's turning of TIFF files, its loss of bands that are no colours, mixed planes beyond 8
    bits, white taken for black, values of 9 to 15 bits shifted up, and text PNM files scaled to 255.

    Args:
        content: the file's bytes.
        header: their `image_header`; a TIFF file has 1, 3 or 4 bands (not checked).

    Returns:
        Values (h, w), or (h, w, channels) with blue first and alpha last, type as stored, those of 1 to
        4 bits scaled to 255; colours of 8-bit TIFF files with alpha are times that. None for a damaged file,
        and one that OpenCV cannot decode.
    """
    page, original = header.page, content
    if page is not None and header.orientation != 1:
        tag, changed = page.tags[ORIENTATION], bytearray(content)
        struct.pack_into(page.parent.byteorder + tag.dataformat, changed, tag.valueoffset, 1)
        content = bytes(changed)
    values = decoded(content)
    if page is not None and values is not None:
        bands, grey = page.samplesperpixel, page.photometric in GREY_TIFF
        if bands > 1 and (grey or (values.dtype != np.uint8 and page.planarconfig == SEPARATE)):
            colours = _tiff_colours(original)
            values = None if colours is None else colours[..., [2, 1, 0, 3][:bands]]
        elif page.photometric == MINISWHITE and values.dtype == np.uint16:
            values = 65535 - values
        if header.white and values is not None and values.dtype == np.uint16:
            values = values >> (16 - header.bits)
    if content[:2] in PNM_OF_TEXT and header.white and values is not None and values.dtype == np.uint8:
        values = ((values.astype(np.uint16) * header.white + 254) // 255).astype(np.uint8)
    return values


def _tiff_colours(content: bytes) -> Any:
    """Values (h, w, c) of a TIFF file's first image by tifffile; None if damaged, or compressed otherwise."""
    try:
        with quiet_tiff(content) as file:
            page = file.pages.first
            values = page.asarray()
    except (*DAMAGED, zlib.error):
        return None
    return values.transpose(1, 2, 0) if page.planarconfig == SEPARATE else values
