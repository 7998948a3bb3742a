"""Checks of image files' bytes, for decoders that trust them.

OpenCV 4.11 to 4.13 crash on damaged animated PNGs, take missing parts of a planar TIFF for black, do not read
a text PNM without a line break at its end, and return pixels where libjpeg and libtiff report damage.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import numpy as np

PNG = b"\x89PNG\r\n\x1a\n"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
JPEG = b"\xff\xd8"
PNM_OF_TEXT = (b"P1", b"P2", b"P3")
ANIMATION = (b"acTL", b"fcTL", b"fdAT")
"""Chunks of a PNG file next to those of its first image."""
SEPARATE = 2
"""TIFF PlanarConfiguration for one plane after the other."""
MINISWHITE, MINISBLACK = 0, 1
"""Values of TIFF PhotometricInterpretation."""
YCBCR = 6
DEFLATE, PACKBITS, LZW, JPEG_IN_TIFF = (8, 32946), 32773, 5, 7
"""Values of TIFF Compression."""
REDUCED, MASK = 1, 4
"""Values of a TIFF directory's NewSubfileType."""
DAMAGED = (OSError, SyntaxError, ValueError, struct.error, LookupError, TypeError, ArithmeticError)
"""Exceptions of Pillow and tifffile for a damaged header."""


def decodable(content: bytes) -> bytes | None:
    """Check an image file's bytes, and prepare them for OpenCV.

    Returns:
        A PNG without its animation, a text PNM with a line break at its end, others unchanged; None for a PNG
        that is cut or fails its checksums, an incomplete TIFF, and compressed pixels that the decoder warns
        of.
    """
    if content.startswith(PNG):
        chunks = png_chunks(content)
        ends = [kind for kind, _, _ in chunks[-1:]] == [b"IEND"]
        if not (ends and all(_is_undamaged(content, chunk) for chunk in chunks)):
            return None
        return PNG + b"".join(content[start:end] for kind, start, end in chunks if kind not in ANIMATION)
    if (content[:4] in TIFF and not _is_whole(content)) or (content[:2] == JPEG and not _is_sound(content)):
        return None
    return content + b"\n" if content[:2] in PNM_OF_TEXT else content


def png_chunks(content: bytes) -> list[tuple[bytes, int, int]]:
    """List kind, start and end of each chunk of a PNG file, up to IEND; the last one may be cut."""
    chunks: list[tuple[bytes, int, int]] = []
    start = len(PNG)
    while start + 8 <= len(content) and not (chunks and chunks[-1][0] == b"IEND"):
        length, kind = struct.unpack_from(">I4s", content, start)
        chunks.append((kind, start, start + 12 + length))
        start += 12 + length
    return chunks


def _is_undamaged(content: bytes, chunk: tuple[bytes, int, int]) -> bool:
    """True if a chunk is not required (by its kind's first letter), or complete with the right checksum."""
    kind, start, end = chunk
    found = zlib.crc32(memoryview(content)[start + 4 : end - 4])
    return kind[:1].islower() or content[end - 4 : end] == found.to_bytes(4, "big")


def first_tiff_page(content: bytes) -> Any:
    """Parse the first directory of a TIFF file, without messages about damage.

    Returns:
        tifffile's TiffPage.

    Raises:
        ValueError: or another of `DAMAGED`, if there is none.
    """
    with _quiet_tiff(content) as file:
        return file.pages.first


def tiff_colours(content: bytes) -> Any:
    """Read the values of a TIFF file's first image, which has several bands, by tifffile.

    Returns:
        Array (h, w, c) of the file's type; None for a damaged file, and a compression that needs imagecodecs.
    """
    try:
        with _quiet_tiff(content) as file:
            page = file.pages.first
            values = page.asarray()
    except (*DAMAGED, zlib.error):
        return None
    return values.transpose(1, 2, 0) if page.planarconfig == SEPARATE else values


def has_further_images(content: bytes) -> bool:
    """Return True for a TIFF file with more images of the first one's size that are no copies or
    masks of it."""
    try:
        with _quiet_tiff(content) as file:
            first, second = file.pages.first, file.pages[1]
            first_size, second_size = ((page.imagelength, page.imagewidth) for page in (first, second))
            return bool(first_size == second_size and not second.subfiletype & (REDUCED | MASK))
    except DAMAGED:
        return False


@contextmanager
def _quiet_tiff(content: bytes) -> Iterator[Any]:
    from tifffile import TiffFile, logger

    log = logger()
    log.disabled, before = True, log.disabled
    try:
        with TiffFile(BytesIO(content)) as file:
            yield file
    finally:
        log.disabled = before


def _is_whole(content: bytes) -> bool:
    """True if all strips or tiles of a TIFF file's first image lie within the file and decompress."""
    try:
        page = first_tiff_page(content)
    except DAMAGED:
        return False
    # Not `page.dataoffsets`, which leaves out what it does not expect.
    starts, lengths = (page.tags.valueof(a) or page.tags.valueof(b) for a, b in ((273, 324), (279, 325)))
    lengths = lengths or page.databytecounts
    return (
        bool(starts)
        and len(starts) == len(lengths)
        and all(a + b <= len(content) for a, b in zip(starts, lengths))
        and all(
            _decompresses(page, content[a : a + b], i) for i, (a, b) in enumerate(zip(starts, lengths)) if b
        )
    )


def _decompresses(page: Any, segment: bytes, i: int) -> bool:
    """True if a TIFF page's i-th strip or tile decompresses without a warning, to its full length."""
    lengths = _lengths(page, i)
    if page.compression in (*DEFLATE, PACKBITS):
        from tifffile import TIFF as decoders

        try:
            length = len(decoders.DECOMPRESSORS[page.compression](segment))
        except (*DAMAGED, zlib.error):
            return False
        return length in lengths or (page.compression in DEFLATE and length >= min(lengths))
    if page.compression == LZW:
        from .lzw import lzw_length

        unusual = segment[:2] == b"\0\1" or page.fillorder != 1  # as before TIFF 6; bits reversed
        return bool(unusual or lzw_length(np.frombuffer(segment, np.uint8)) in lengths)
    tables = page.jpegtables[:-2] if page.jpegtables else JPEG
    return page.compression != JPEG_IN_TIFF or _is_sound(tables + segment[2:])


def _lengths(page: Any, i: int) -> Collection[int]:
    """Possible numbers of decompressed bytes of a page's i-th strip or tile; a last strip may be padded."""
    if page.photometric == YCBCR:
        return range(1, 2**63)
    rows, width, height = page.rowsperstrip, page.imagewidth, page.imagelength
    if page.is_tiled:
        rows, width, height = page.tilelength, page.tilewidth, page.tilelength * (i + 1)
    strips = -(-height // rows)
    samples = 1 if page.planarconfig == SEPARATE else page.samplesperpixel
    bits = page.bitspersample
    bits = max(bits) if isinstance(bits, tuple | list) else bits
    row = -(-width * samples * bits // 8)
    return {min(rows, height - i % strips * rows) * row, rows * row}


def _is_sound(content: bytes) -> bool:
    """True if libjpeg decodes a JPEG without a warning, or it has other colours."""
    try:
        jpeg_colours(content)
    except Exception:  # the decoder raises nothing narrower
        return False
    return True


def jpeg_colours(content: bytes) -> Any:
    """Decode the bytes of a JPEG file by libjpeg-turbo, to the same values as OpenCV.

    Returns:
        Array (h, w, 1 or 3), uint8, red first; None for other colours than RGB and grey, such as CMYK.

    Raises:
        Exception: where libjpeg warns; OpenCV would print the warning, and return the pixels that it has.
    """
    from kornia_rs import io
    from PIL.JpegImagePlugin import JpegImageFile

    mode = {"L": "mono", "RGB": "rgb"}.get(JpegImageFile(BytesIO(content)).mode)
    return None if mode is None else np.asarray(io.decode_image_jpegturbo(content, mode))
