"""Headers, checks and decoding of image files' bytes, for decoders that trust them.

OpenCV 4.11 to 4.13 crash on damaged animated PNGs, take missing parts of a planar TIFF for black, do not read
a text PNM without a line break at its end, and return pixels where libjpeg and libtiff report damage.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np

PNG = b"\x89PNG\r\n\x1a\n"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
JPEG = b"\xff\xd8"
PNM_OF_TEXT = (b"P1", b"P2", b"P3")
ANIMATION = (b"acTL", b"fcTL", b"fdAT")
"""Chunks of a PNG file next to those of its first image."""
SEPARATE = 2
"""TIFF PlanarConfiguration for one plane after the other."""
YCBCR = 6
"""Value of TIFF PhotometricInterpretation."""
DEFLATE, PACKBITS, LZW, JPEG_IN_TIFF = (8, 32946), 32773, 5, 7
"""Values of TIFF Compression."""
REDUCED, MASK = 1, 4
"""Values of a TIFF directory's NewSubfileType."""
ORIENTATION = 274
"""Number of the orientation tag."""
UNCHANGED = -1
"""OpenCV's IMREAD_UNCHANGED."""
DAMAGED = (OSError, SyntaxError, ValueError, struct.error, LookupError, TypeError, ArithmeticError)
"""Exceptions of Pillow and tifffile for a damaged header."""


class ImageHeader(NamedTuple):
    """Header of an image file.

    Attributes:
        hw: stored (height, width), before the orientation is applied.
        orientation: EXIF orientation tag, 1 to 8; 1 where there is none, or one that is none of these.
        bits: bits of a value in TIFF (the most of its bands), PNG (of an index too) and PNM (8 at least, of
            a bitmap too); 0 for others.
        white: largest value of a grey or colour PNM, or a TIFF with 9 to 15 bits a value; 0 for others.
        page: tifffile's TiffPage of a TIFF file's first image; None for other files.
        several: True for a TIFF file whose second image has the first one's size and is no reduced copy or
            mask of it.
    """

    hw: tuple[int, int]
    orientation: int = 1
    bits: int = 0
    white: int = 0
    page: Any = None
    several: bool = False

    @property
    def upright(self) -> tuple[int, int]:
        """(height, width) after the orientation is applied."""
        return self.hw[::-1] if self.orientation >= 5 else self.hw


def image_header(content: bytes) -> ImageHeader | None:
    """Parse the header of a PNG, TIFF, JPEG, PNM, BMP or WebP file from its bytes.

    Returns:
        The header; None for another format and for a damaged header (pixels are not looked at).
    """
    from PIL import BmpImagePlugin, JpegImagePlugin, WebPImagePlugin

    # `Image.open` would refuse large images that are expected here
    kinds: dict[bytes, Any] = {
        JPEG: JpegImagePlugin.JpegImageFile,
        b"RI": WebPImagePlugin.WebPImageFile,
        b"BM": BmpImagePlugin.BmpImageFile,
    }
    try:
        if content.startswith(PNG):  # by hand: Pillow decodes the whole image to find a tag behind it
            width, height = struct.unpack_from(">II", content, 16)
            tags = [
                content[start + 8 : end - 4] for kind, start, end in png_chunks(content) if kind == b"eXIf"
            ]
            return ImageHeader((height, width), _exif_orientation(tags[-1] if tags else b""), content[24])
        if content[:4] in TIFF:
            return _tiff(content)
        if content[:2] not in kinds:
            return _pnm(content)
        image = kinds[content[:2]](BytesIO(content))
    except DAMAGED:
        return None
    return ImageHeader(image.size[::-1], _exif_orientation(image.info.get("exif", b"")))


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
    several = False
    with quiet_tiff(content) as file:
        page = file.pages.first
        hw = int(page.imagelength), int(page.imagewidth)
        with suppress(*DAMAGED):
            second = file.pages[1]
            same = hw == (second.imagelength, second.imagewidth)
            several = bool(same and not second.subfiletype & (REDUCED | MASK))
    bits, tag = int(np.max(page.bitspersample)), page.tags.get(ORIENTATION)
    white = 2**bits - 1 if 8 < bits < 16 else 0
    return (
        ImageHeader(hw, _known(tag.value) if tag else 1, bits, white, page, several) if min(hw) > 0 else None
    )


def _exif_orientation(exif: bytes) -> int:
    """Orientation in an EXIF block; 1 if the block is damaged."""
    from PIL import Image

    tags = Image.Exif()
    try:
        tags.load(exif)
        return _known(tags.get(ORIENTATION, 1))
    except DAMAGED:
        return 1


def _known(orientation: object) -> int:
    return int(orientation) if isinstance(orientation, int) and 1 <= orientation <= 8 else 1


def decoded(content: bytes, flags: int = UNCHANGED) -> Any:
    """Decode an image file's bytes by OpenCV without its messages.

    Args:
        flags: OpenCV's IMREAD flags; with `UNCHANGED` kornia decodes grey and RGB JPEGs, to the same values.

    Returns:
        Values (h, w), or (h, w, channels) with blue first and alpha last, type as OpenCV gives it for the
        flags, strides as may be (negative); None for a damaged file, and one that OpenCV cannot decode.
    """
    import cv2

    if content[:2] == JPEG and flags == UNCHANGED:
        with suppress(Exception):  # damaged, which `decodable` says
            if (colours := _jpeg_colours(content)) is not None:
                return colours[..., 0] if colours.shape[2] == 1 else colours[..., ::-1]
    logging = cv2 if hasattr(cv2, "setLogLevel") else getattr(cv2.utils, "logging")  # noqa: B009  # OpenCV 5
    level, checked = logging.setLogLevel(0), decodable(content)
    try:
        return None if checked is None else cv2.imdecode(np.frombuffer(checked, np.uint8), flags)
    except cv2.error:
        return None
    finally:
        logging.setLogLevel(level)


def decodable(content: bytes) -> bytes | None:
    """Check an image file's bytes, and prepare them for OpenCV.

    Returns:
        A PNG without its animation, a text PNM with one more line break at its end, others (of unknown
        format too) unchanged; None for a PNG that is cut or fails its checksums, an incomplete TIFF, and a
        TIFF or JPEG whose compressed pixels are damaged (TIFF: by Deflate, PackBits, LZW or JPEG).
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


@contextmanager
def quiet_tiff(content: bytes) -> Iterator[Any]:
    """Context manager of a TIFF file's bytes as tifffile's `TiffFile`, without its log messages.

    Raises:
        Exception: one of `DAMAGED`, for a damaged file.
    """
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
        with quiet_tiff(content) as file:
            page = file.pages.first
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
        _jpeg_colours(content)
    except Exception:  # the decoder raises nothing narrower
        return False
    return True


def _jpeg_colours(content: bytes) -> Any:
    """Decode a JPEG to uint8 (h, w, 1 or 3), red first, with OpenCV's values; None for other colours (CMYK).

    Raises Exception where libjpeg warns; OpenCV would print the warning, and return the pixels that it has.
    """
    from kornia_rs import io
    from PIL.JpegImagePlugin import JpegImageFile

    mode = {"L": "mono", "RGB": "rgb"}.get(JpegImageFile(BytesIO(content)).mode)
    return None if mode is None else np.asarray(io.decode_image_jpegturbo(content, mode))
