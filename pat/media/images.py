"""Image files.

An image in memory is a float tensor (C, H, W), 0..1, with the encoding of the file (sRGB for ordinary
images), colours in the order red, green, blue. Files are written atomically.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from arraygeom.runtime.atomic import write_atomically
from arraygeom.runtime.chunks import ROWS, spans
from arraygeom.runtime.image_bytes import (
    JPEG,
    MINISBLACK,
    MINISWHITE,
    PNG,
    PNM_OF_TEXT,
    SEPARATE,
    TIFF,
    decodable,
    first_tiff_page,
    has_further_images,
    jpeg_colours,
    tiff_colours,
)
from arraygeom.runtime.warned import warn

from .headers import HW, ImageHeader, image_header
from .profiles import in_srgb, with_srgb_profile
from .suffixes import RAW_SUFFIXES

FEW_BITS = (8, 10, 12, 14)
"""Bits of cameras that may be stored in 16 bits as they are."""
CLIPPED = 0.002
"""Share of values at the largest from which that is where a camera's counts end."""
HIGHLIGHTS = 0.98 * 2**14
"""The largest value of an image that has highlights, of 14 bits."""
CHANNELS = "give a grey (1) or RGB (3) image"
KINDS = "save it with 8 or 16 bits without sign, or as float 0..1"
DECODED = ("bool", "uint8", "uint16", "float32", "float64")
"""Types of a TIFF file's values which OpenCV reads, and which are usable."""

GREY_WITH_ALPHA = 4
"""The type of colour in a PNG file's header, its byte 25."""
MOST_PIXELS = 2**28
"""Images with more are read only where their size is expected: some 3 GiB in colour."""

_DEFLATED = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_ADOBE_DEFLATE]
_HEIF = tuple(b"ftyp" + brand for brand in (b"heic", b"heix", b"mif1", b"msf1", b"heim", b"heis"))


Images = Mapping[str, Any]
"""Images (C, H, W) by camera: a dict, or what reads them when asked for (`pat.fusion.views.ViewFiles`).

Not `Mapping[str, Tensor]`: what checks types would read one.
"""
ImageSources = Mapping[str, Any] | Sequence[str | Path]
"""An image file or tensor (C, H, W) in 0..1 of each camera by name; or files alone, which name cameras."""


def read_image(
    path: str | Path,
    *,
    name: str | None = None,
    bits: int | None = None,
    hw: HW | None = None,
    orientation: Literal["apply", "ignore"] = "apply",
) -> Float[Tensor, "c h w"]:
    """The image in a PNG, TIFF, JPEG, PNM, BMP, WebP or HEIC: grey (1, H, W) or RGB (3, H, W), float32, 0..1.

    HEIC, which needs the extra `heic`, has 8 bits here and is rotated as its own header says. Raw files of
    cameras (DNG and others), which need the extra `raw`, are developed to sRGB by LibRaw. An image of 8 bits
    with another colour profile is converted to sRGB, with a warning; its profile is ignored with
    `orientation="ignore"`, and so are those of images of 16 bits.
    8-bit values are divided by 255 and 16-bit ones by 65535, or by 2^bits - 1: a 12-bit camera that stores
    0..4095 in 16 bits needs `bits=12`. TIFF files that pack 10, 12 or 14 bits a value, and PNM files, which
    state the largest, need nothing. Float files must hold 0..1. A wholly opaque alpha channel is dropped.
    `name` (such as a camera's) goes in front of messages.

    An orientation tag (EXIF, TIFF) is applied, with a warning, as viewers and OpenCV's `imread` do; with
    `orientation="ignore"` the pixels are as stored, as raw images need it. `hw` is the expected (height,
    width), which is compared before anything is decoded.

    Raises FileNotFoundError for a missing file, ValueError for one that is not a usable image, has another
    size than expected, or is larger than `MOST_PIXELS` where no size is.
    """
    label = f"{name}: {path}" if name else f"{path}"
    planes, white = _planes(Path(path), label, hw, orientation)
    return torch.from_numpy(np.ascontiguousarray(_unit_range(planes, label, bits, white)))


def read_recorded(
    path: str | Path,
    *,
    name: str | None = None,
    hw: HW | None = None,
    orientation: Literal["apply", "ignore"] = "apply",
) -> NDArray[Any]:
    """Values (C, H, W) of an image file in its own type and counts; else, and in errors, as `read_image`.

    Those of a TIFF or PNM file that states a lower white are as its camera counted them.
    """
    label = f"{name}: {path}" if name else f"{path}"
    return np.ascontiguousarray(_planes(Path(path), label, hw, orientation)[0])


def _planes(
    path: Path, label: str, hw: HW | None, orientation: Literal["apply", "ignore"]
) -> tuple[NDArray, int]:
    """The values (C, H, W) as stored, upright, and the white that a TIFF or PNM file states (else 0)."""
    if not path.is_file():
        raise FileNotFoundError(f"{label}: no such image: check the path")
    content = _png_of_raw(path, label) if path.suffix.lower() in RAW_SUFFIXES else path.read_bytes()
    if content[4:12] in _HEIF:
        content = _png_of_heif(path, label, hw)
    header = image_header(content)
    if header is None:
        raise ValueError(f"{label}: not an image that can be read: give a whole PNG, TIFF, JPEG or PNM file")
    if content[:4] in TIFF and has_further_images(content):
        warn(f"{label}: holds several images: the first is taken; save the others as files of their own")
    applied = _applied(header, orientation, label)
    _check_header(header.upright if applied > 1 else header.hw, hw, label)
    values, white = _decode(content, header, label)
    values = _opaque(_upright(values, applied), content, label, white)
    if orientation == "apply":
        values = in_srgb(values, content, label)
    return (values[None] if values.ndim == 2 else values[..., ::-1].transpose(2, 0, 1)), white


def write_image(
    path: str | Path,
    image: Float[Tensor, "c h w"],
    *,
    bits: int = 8,
    unknown: bool = False,
    profile: bool = False,
) -> None:
    """Write a grey or RGB image atomically, in the format its name ends in (.png, .tif, .jpg, .exr).

    8 and 16 bits are rounded, after values are clipped to 0..1; 32 bits (.tif and .exr only) keep floats as
    they are. With `profile`, PNG and JPEG files in colour say by an ICC profile that they are sRGB.
    An .exr file needs the extra `synthesis`.

    Raises ValueError for an image of whole numbers, with another number of channels or with values that are
    not finite (allowed with `unknown`, for maps of 32 bits in which some pixels are not known), and for a
    format that cannot hold it.
    """
    path = Path(path)
    if not image.is_floating_point():
        kind = str(image.dtype).removeprefix("torch.")
        raise ValueError(f"{path}: the image to write is {kind}: give floats in 0..1")
    exact = torch.promote_types(image.dtype, torch.float32)  # NumPy has no bfloat16
    planes = image.detach().cpu().to(exact).numpy()
    if planes.shape[0] not in (1, 3):
        raise ValueError(f"{path}: an image has 1 or 3 channels, got {len(planes)}: write them one by one")
    if not (unknown and bits == 32) and not np.isfinite(planes).all():
        raise ValueError(f"{path}: the image to write has NaN or infinite values")
    if path.suffix.lower() == ".exr":
        return _write_exr(path, planes, bits)
    content = _encode(path, np.ascontiguousarray(planes[::-1].transpose(1, 2, 0)), bits)
    content = with_srgb_profile(content, path.suffix.lower()) if profile else content
    with write_atomically(path) as temporary:
        temporary.write_bytes(content)


def has_many_bits(path: Path) -> bool:
    """Whether an image file has more than 8 bits a value."""
    if path.suffix.lower() in RAW_SUFFIXES:
        return True
    header = image_header(path.read_bytes()) if path.is_file() else None
    return header is not None and header.bits > 8


def _png_of_heif(path: Path, label: str, hw: HW | None) -> bytes:
    """The image of a HEIC or HEIF file, upright, as a PNG file; its size is compared before it is decoded."""
    pillow_heif = _of_extra("pillow_heif", "heic", f"{label}: reading HEIC", ", or save it as PNG")
    problem = f"{label}: not a HEIC image that can be read (%s): save it as PNG"
    try:
        stored = pillow_heif.open_heif(path, convert_hdr_to_8bit=True)
    except (OSError, ValueError) as error:
        raise ValueError(problem % error) from None
    _check_header(stored.size[::-1], hw, label)
    try:
        image = np.asarray(stored)
    except (OSError, ValueError) as error:
        raise ValueError(problem % error) from None
    return cv2.imencode(".png", image if image.ndim == 2 else image[..., [2, 1, 0]])[1].tobytes()


def _png_of_raw(path: Path, label: str) -> bytes:
    """A camera's raw file as PNG: developed to sRGB in 16 bits with the camera's white balance, upright."""
    rawpy = _of_extra("rawpy", "raw", f"{label}: reading raw files", ", or save it as TIFF")
    how = {"use_camera_wb": True, "no_auto_bright": True, "output_bps": 16, "gamma": (2.4, 12.92)}
    try:
        with rawpy.imread(str(path)) as raw:
            colours = raw.postprocess(**how)
    except (rawpy.LibRawError, OSError) as error:
        raise ValueError(f"{label}: not a raw file that can be read ({error}): save it as TIFF") from None
    return cv2.imencode(".png", colours[..., ::-1])[1].tobytes()


def _applied(header: ImageHeader, orientation: str, label: str) -> int:
    """The orientation to apply, 1 for none; a tag is reported either way."""
    if header.orientation == 1:
        return 1
    if orientation == "ignore":
        warn(f"{label}: orientation tag {header.orientation} is ignored: pixels are as stored")
        return 1
    h, w = header.upright
    warn(
        f"{label}: orientation tag {header.orientation} is applied, which makes it {w}x{h}; "
        "remove the tag if a calibration is of the pixels as stored"
    )
    return header.orientation


def _check_header(got: HW, wanted: HW | None, label: str) -> None:
    if wanted is None and got[0] * got[1] > MOST_PIXELS:
        most = f"{MOST_PIXELS / 1e6:.0f} million pixels"
        raise ValueError(f"{label}: is {got[1]}x{got[0]}, more than {most}: reduce it")
    if wanted is not None and got != wanted:
        (h, w), (wanted_h, wanted_w) = got, wanted
        text = f"{label}: is {w}x{h}, the rig says {wanted_w}x{wanted_h}"
        raise ValueError(f"{text}: resize the rig, or give the right image")


def _upright(values: NDArray, orientation: int) -> NDArray:
    """The image that a viewer shows for an EXIF orientation."""
    if orientation >= 5:
        values = values.swapaxes(0, 1)
    # After the transposition of 5 to 8.
    columns = slice(None, None, -1 if orientation in (2, 3, 6, 7) else 1)
    rows = slice(None, None, -1 if orientation in (3, 4, 7, 8) else 1)
    return values[rows, columns]


def _decode(content: bytes, header: ImageHeader, label: str) -> tuple[NDArray, int]:
    """Values as stored, and the largest possible one where a TIFF or PNM file states it; else 0.

    OpenCV shifts those of TIFF files up to 16 bits, and scales those of 8 bits in PNM files of text to 255.
    """
    values = decoded(_without_orientation(content, header))
    page = first_tiff_page(content) if content[:4] in TIFF else None
    if page is not None:
        values = _as_tiff_states(values, page, content, label)
    if values is None and page is not None and page.dtype is not None and page.dtype not in DECODED:
        raise ValueError(f"{label}: has {page.dtype} values: {KINDS}")
    if values is None:
        raise ValueError(f"{label}: not an image that can be read: give a whole PNG, TIFF or JPEG file")
    if values.shape[:2] != header.hw:
        raise ValueError(f"{label}: its header says another size than its pixels have: save it again")
    if page is not None and values.dtype == np.uint16 and header.bits < 16:
        return values >> (16 - header.bits), 2**header.bits - 1
    if content[:2] in PNM_OF_TEXT and values.dtype == np.uint8:
        values = ((values.astype(np.uint16) * header.white + 254) // 255).astype(np.uint8)
    return values, header.white


def _as_tiff_states(values: NDArray | None, page: Any, content: bytes, label: str) -> NDArray | None:
    """Values as a TIFF file's tags state them, where OpenCV does not heed these.

    It gives the first of several bands that are no colours, and mixes planes and takes white for black in
    images of more than 8 bits.
    """
    bands, grey = page.samplesperpixel, page.photometric in (MINISWHITE, MINISBLACK)
    if bands not in (1, 3, 4) or (bands == 4 and grey):
        raise ValueError(f"{label}: has {bands} channels: {CHANNELS}")
    if values is None:
        return None
    deep = values.dtype != np.uint8
    if bands > 1 and (grey or (deep and page.planarconfig == SEPARATE)):
        colours = tiff_colours(content)
        return None if colours is None else colours[..., [2, 1, 0, 3][:bands]]
    return 65535 - values if page.photometric == MINISWHITE and values.dtype == np.uint16 else values


def _without_orientation(content: bytes, header: ImageHeader) -> bytes:
    """A TIFF file's bytes with orientation 1: OpenCV applies that of TIFF files alone, whatever is asked."""
    if header.tag is None or header.orientation == 1:
        return content
    place, form = header.tag
    changed = bytearray(content)
    struct.pack_into(form, changed, place, 1)
    return bytes(changed)


def _log_level(level: int) -> int:
    """Set OpenCV's log level; returns the former one. OpenCV 5 has the function in another module."""
    logging = cv2 if hasattr(cv2, "setLogLevel") else getattr(cv2.utils, "logging")  # noqa: B009
    return int(logging.setLogLevel(level))


def decoded(content: bytes, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray | None:
    """What OpenCV makes of a file's bytes, without its own messages; None for a damaged file."""
    if content[:2] == JPEG and flags == cv2.IMREAD_UNCHANGED:
        with suppress(Exception):  # damaged, which `decodable` says
            if (colours := jpeg_colours(content)) is not None:
                return colours[..., 0] if colours.shape[2] == 1 else colours[..., ::-1]
    level, checked = _log_level(0), decodable(content)
    try:
        return None if checked is None else cv2.imdecode(np.frombuffer(checked, np.uint8), flags)
    except cv2.error:
        return None
    finally:
        _log_level(level)


def decoded_photograph(path: Path, flags: int, *, least: int = 1) -> NDArray | None:
    """What OpenCV makes of an image file, 8 bits; None if it is none, has a side under `least` or too many
    pixels."""
    content = path.read_bytes()
    header = image_header(content)
    if header is None or min(header.hw) < least or header.hw[0] * header.hw[1] > MOST_PIXELS:
        return None
    values = decoded(content, flags | (cv2.IMREAD_ANYDEPTH if header.white else 0))
    if values is None or not header.white:
        return values
    full = 255 if content[:2] in PNM_OF_TEXT and values.dtype == np.uint8 else header.white
    return np.rint(np.minimum(values / full, 1) * 255).astype(np.uint8)


def _opaque(values: NDArray, content: bytes, label: str, white: int) -> NDArray:
    """Values without an alpha channel, which OpenCV gives to three equal bands where a PNG file is grey."""
    if values.ndim == 2 or values.shape[2] == 3:
        return values
    if values.shape[2] != 4:
        raise ValueError(f"{label}: has {values.shape[2]} channels: {CHANNELS}")
    full = white or (np.iinfo(values.dtype).max if np.issubdtype(values.dtype, np.integer) else 1.0)
    if (values[..., 3] != full).any():
        raise ValueError(f"{label}: has transparent pixels: flatten it and save it without alpha channel")
    grey = content.startswith(PNG) and content[25] == GREY_WITH_ALPHA
    return values[..., 0] if grey else values[..., :3]


def _unit_range(planes: NDArray, label: str, bits: int | None, white: int) -> NDArray[np.float32]:
    if planes.dtype in (np.uint8, np.uint16):
        return _counts(planes, label, bits, white or np.iinfo(planes.dtype).max)
    if not np.issubdtype(planes.dtype, np.floating):
        raise ValueError(f"{label}: has {planes.dtype} values: {KINDS}")
    if not np.isfinite(planes).all():
        raise ValueError(f"{label}: has NaN or infinite values: replace them before fusing")
    low, high = float(planes.min()), float(planes.max())
    if low < 0 or high > 1:
        raise ValueError(f"{label}: has float values from {low:g} to {high:g}: scale them to 0..1")
    return planes.astype(np.float32)


def _counts(planes: NDArray, label: str, bits: int | None, white: int) -> NDArray[np.float32]:
    """Whole numbers as 0..1. Raises ValueError for values beyond the bits that are stated."""
    stored, largest = max(white.bit_length(), 8), int(planes.max())
    if bits and bits > stored:
        raise ValueError(
            f"{label}: has {stored} bits a value, the rig says {bits}: correct 'bits', or give the raw file"
        )
    if largest > white:
        raise ValueError(f"{label}: has values up to {largest}, its header says {white}: save it again")
    few = 0 < largest < 2**12 or HIGHLIGHTS <= largest < 2**14
    if white == 2**16 - 1 and not bits and few:
        needed = next(n for n in FEW_BITS if largest < 2**n)
        black = "nearly black" if needed < 14 else "dark, with the highlights of a camera of 14 bits"
        warn(
            f"{label}: has 16 bits a value, and none above {largest}, so it is {black}: "
            f"if its camera counts to {2**needed - 1}, state `bits: {needed}` in the rig file, "
            f"or save it with its values times {65535 // (2**needed - 1)}"
        )
    white = 2**bits - 1 if bits else white
    fewer = next((n for n in FEW_BITS if bits and n < bits and largest == 2**n - 1), None)
    if fewer and (planes == largest).mean() > CLIPPED:
        warn(f"{label}: is cut off at {largest}, where {fewer} bits end; the rig says {bits}: correct 'bits'")
    if largest > white:
        raise ValueError(
            f"{label}: has values up to {largest}, the rig says {bits} bits (up to {white}): correct 'bits' "
            "(16 if the camera shifts its values up)"
        )
    return planes.astype(np.float32) / np.float32(white)


def exr_writer(path: Path) -> Any:
    """The package OpenEXR, to write to `path`. Raises ValueError where it is not installed."""
    return _of_extra("OpenEXR", "synthesis", f"{path}: writing EXR")


def _of_extra(module: str, extra: str, purpose: str, advice: str = "") -> Any:
    """An optional module. Raises ValueError, which says what to install, or to do, where there is none."""
    try:
        return import_module(module)
    except ImportError:
        package = module.replace("_", "-")
        install = f"pip install 'arraygeom-pat[{extra}]'"
        raise ValueError(f"{purpose} needs the package {package}: {install}{advice}") from None


def _write_exr(path: Path, planes: NDArray, bits: int) -> None:
    if bits != 32:
        raise ValueError(f"{path}: EXR holds 32-bit floats here, not {bits} bits: write .png or .tif")
    OpenEXR = exr_writer(path)
    names = {1: "Y", 3: "RGB"}[len(planes)]
    channels = {name: np.ascontiguousarray(plane, np.float32) for name, plane in zip(names, planes)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with write_atomically(path) as temporary:
        OpenEXR.File(header, channels).write(str(temporary))


def _encode(path: Path, colours: NDArray, bits: int) -> bytes:
    """An image file's bytes, by the path's suffix. Raises ValueError for one that cannot hold it."""
    suffix = path.suffix.lower()
    if suffix in (".jpg", ".jpeg") and bits != 8:
        raise ValueError(f"{path}: JPEG holds 8 bits, not {bits}: write .png or .tif")
    tiff = suffix in (".tif", ".tiff")
    if bits == 32 and not tiff:
        raise ValueError(f"{path}: 32-bit floats need a name that ends in .tif")
    try:
        # OpenCV writes float colours as LogLuv else, of 3 digits, and LZW, which tifffile cannot read.
        succeeded, content = cv2.imencode(suffix, _quantised(colours, bits), _DEFLATED if tiff else [])
    except cv2.error:
        succeeded = False
    if not succeeded:
        raise ValueError(f"{path}: cannot write an image named so: end the name in .png, .tif or .jpg")
    return content.tobytes()


def _quantised(colours: NDArray, bits: int) -> NDArray:
    if bits == 32:
        return colours.astype(np.float32)
    if bits not in (8, 16):
        raise ValueError(f"bits must be 8, 16 or 32 (float), got {bits}")
    counts = np.empty(colours.shape, np.uint8 if bits == 8 else np.uint16)
    for first, last in spans(len(colours), ROWS):
        rows = np.clip(colours[first:last], 0, 1).astype(np.float64)
        counts[first:last] = np.rint(rows * (2**bits - 1))
    return counts
