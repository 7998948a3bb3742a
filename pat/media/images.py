"""Image files: reading and atomic writing.

An image in memory is a float tensor (C, H, W), 0..1, in the file's encoding (sRGB for ordinary images), with
colours in the order red, green, blue.
"""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import tifffile
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image, ImageCms
from torch import Tensor

from arraygeom import Sensor
from arraygeom.pixels import HW
from arraygeom.runtime import image_bytes
from arraygeom.runtime.atomic import write_atomically
from arraygeom.runtime.chunks import ROWS, spans
from arraygeom.runtime.extras import install_line
from arraygeom.runtime.image_bytes import ImageHeader, image_header
from arraygeom.runtime.warned import warn

from .stored_values import GREY_TIFF, stored_values
from .suffixes import RAW_SUFFIXES

FEW_BITS = (8, 10, 12, 14)
"""Bits of cameras whose counts may be stored unscaled in 16 bits."""
CLIPPED = 0.002
"""Share of values at the largest above which that is where a camera's counts end."""
HIGHLIGHTS = 0.98 * 2**14
"""Value above which a largest count suggests highlights of a 14-bit camera."""
CHANNELS = "give a grey (1) or RGB (3) image"
KINDS = "save it with 8 or 16 bits without sign, or as float 0..1"
DECODED = ("bool", "uint8", "uint16", "float32", "float64")
"""Types of values in TIFF files that OpenCV reads and that are accepted."""

GREY_WITH_ALPHA = 4
"""Colour type (byte 25 of a PNG file) of grey with alpha."""
MOST_PIXELS = 2**28
"""Pixels above which an image is read only if its size is expected: some 3 GiB in colour."""

_JPEG_PART = 65_000
"""Bytes of a colour profile that fit in one segment of a JPEG file."""
_HEIF = tuple(b"ftyp" + brand for brand in (b"heic", b"heix", b"mif1", b"msf1", b"heim", b"heis"))


Images = Mapping[str, Any]
"""Images (C, H, W) by camera: a dict, or a mapping that reads them on access (`pat.fusion.views.ViewFiles`).

Not `Mapping[str, Tensor]`: a type checker at run time would read one.
"""
ImageSources = Mapping[str, Any] | Sequence[str | Path]
"""Image files or tensors (C, H, W) in 0..1 by camera name; or a list of files, which name the cameras."""


def read_image(
    path: str | Path,
    *,
    name: str | None = None,
    bits: int | None = None,
    hw: HW | None = None,
    orientation: Literal["apply", "ignore"] = "apply",
) -> Float[Tensor, "c h w"]:
    """Read an image file: PNG, TIFF, JPEG, PNM, BMP, WebP, HEIC (extra `heic`) or camera raw (extra `raw`).

    Counts are divided by 2^bits - 1, or else by 255 or 65535; TIFF files that pack 10, 12 or 14 bits, and PNM
    files, state their own white. Float files must hold 0..1. An opaque alpha channel is dropped. HEIC is
    reduced to 8 bits, raw files are developed to 16-bit sRGB by LibRaw, both upright for any `orientation`.
    An 8-bit image with another colour profile is converted to sRGB with a warning; other profiles, and all
    with `orientation="ignore"`, are ignored. Of several images in a file the first is read.

    Args:
        name: prefix of messages, such as a camera's name.
        bits: bits that the camera counts in, for a 12-bit camera that stores 0..4095 in 16 bits; None for the
            file's own. Ignored for float files.
        hw: expected (height, width) of the result, compared before decoding; None accepts up to
            `MOST_PIXELS`.
        orientation: "apply" turns the image by its EXIF or TIFF tag, with a warning; "ignore" keeps pixels as
            stored.

    Returns:
        Grey (1, h, w) or RGB (3, h, w), float32, 0..1.

    Raises:
        OSError: for a missing file (FileNotFoundError), or one that may not be read.
        ValueError: for a file that is no usable image (damaged, transparent, other channels or types), NaN,
            values out of range or beyond `bits`, `bits` beyond the file's, a size other than `hw` or over
            `MOST_PIXELS`, or an extra that is not installed.
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
    """Read an image file's values without scaling; files and options as in `read_image`.

    Profiles of 8-bit images, HEIC and raw files are converted as there.

    Returns:
        Values (1 or 3, h, w) in the file's own type: uint8, uint16, float32, float64, or a TIFF's signed
        integers; RGB order; TIFF and PNM files with a lower white hold the camera's counts.

    Raises:
        OSError: as `read_image`.
        ValueError: as `read_image`, but not for signed integers, NaN or values out of range.
    """
    label = f"{name}: {path}" if name else f"{path}"
    return np.ascontiguousarray(_planes(Path(path), label, hw, orientation)[0])


def _planes(
    path: Path, label: str, hw: HW | None, orientation: Literal["apply", "ignore"]
) -> tuple[NDArray, int]:
    """Values (C, H, W) as stored, upright, and the white that a TIFF or PNM file states (else 0)."""
    if not path.is_file():
        raise FileNotFoundError(f"{label}: no such image: check the path")
    content = _png_of_raw(path, label) if path.suffix.lower() in RAW_SUFFIXES else path.read_bytes()
    if content[4:12] in _HEIF:
        content = _png_of_heif(path, label, hw)
    header = image_header(content)
    if header is None:
        raise ValueError(f"{label}: is no image that can be read: give a PNG, TIFF, JPEG or PNM file")
    if header.several:
        warn(f"{label}: holds several images: the first is taken; save the others as files of their own")
    applied = _applied(header, orientation, label)
    _check_header(header.upright if applied > 1 else header.hw, hw, label)
    if (page := header.page) is not None:
        bands, grey = page.samplesperpixel, page.photometric in GREY_TIFF
        if bands not in (1, 3, 4) or (bands == 4 and grey):
            raise ValueError(f"{label}: has {bands} channels: {CHANNELS}")
    values = stored_values(content, header)
    if values is None and page is not None and page.dtype is not None and page.dtype not in DECODED:
        raise ValueError(f"{label}: has {page.dtype} values: {KINDS}")
    if values is None:
        raise ValueError(f"{label}: is damaged, or not whole: copy it again, or save it as PNG or TIFF")
    if values.shape[:2] != header.hw:
        raise ValueError(f"{label}: its header says another size than its pixels have: save it again")
    values = _opaque(_upright(values, applied), content, label, header.white)
    if orientation == "apply":
        values = in_srgb(values, content, label)
    return (values[None] if values.ndim == 2 else values[..., ::-1].transpose(2, 0, 1)), header.white


def recorded_bands(values: Any, sensor: Sensor) -> Any:
    """Reduce three equal bands to one, (1, h, w), if the rig declares the camera grey; else unchanged."""
    grey = len(values) == 3 and sensor.response not in (None, "rgb")
    return values[:1] if grey and all((values[0] == band).all() for band in values[1:]) else values


def write_image(
    path: str | Path,
    image: Float[Tensor, "c h w"],
    *,
    bits: int = 8,
    unknown: bool = False,
    profile: bool = False,
) -> None:
    """Write a grey or RGB image atomically, in the format of its suffix (.png, .tif, .jpg and others of
    OpenCV's; .exr with extra `synthesis`).

    Args:
        image: floats (1 or 3, h, w), in 0..1.
        bits: 8, or 16 (.png, .tif, .ppm): values are clipped to 0..1 and rounded; 32 (.tif, and .exr, which
            takes no other): float32 as they are.
        unknown: True allows NaN and infinity in 32-bit files.
        profile: True adds an sRGB profile to JPEG and PNG files in colour.

    Raises:
        ValueError: for an image of integers, another number of channels, values that are not finite, other
            bits, a format that cannot hold it, or an extra that is not installed.
        OSError: if it cannot be written.
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
    if profile and len(planes) == 3:
        content = with_srgb_profile(content, path.suffix.lower())
    with write_atomically(path) as temporary:
        temporary.write_bytes(content)


def has_many_bits(path: Path) -> bool:
    """Return True for a file with more than 8 bits a value, and raw files; False if unreadable."""
    if path.suffix.lower() in RAW_SUFFIXES:
        return True
    header = image_header(path.read_bytes()) if path.is_file() else None
    return header is not None and header.bits > 8


def _png_of_heif(path: Path, label: str, hw: HW | None) -> bytes:
    """Convert a HEIC or HEIF file to the bytes of a PNG, upright; its size is compared before decoding."""
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
    content = cv2.imencode(".png", image if image.ndim == 2 else image[..., [2, 1, 0]])[1].tobytes()
    profile = stored.info.get("icc_profile")
    return content if profile is None else _with_profile(content, b"of the HEIC file", profile)


def _png_of_raw(path: Path, label: str) -> bytes:
    """Develop a camera's raw file to the bytes of a PNG: 16-bit sRGB, the camera's white balance, upright."""
    rawpy = _of_extra("rawpy", "raw", f"{label}: reading raw files", ", or save it as TIFF")
    how = {"use_camera_wb": True, "no_auto_bright": True, "output_bps": 16, "gamma": (2.4, 12.92)}
    try:
        with rawpy.imread(str(path)) as raw:
            colours = raw.postprocess(**how)
    except (rawpy.LibRawError, OSError) as error:
        raise ValueError(f"{label}: not a raw file that can be read ({error}): save it as TIFF") from None
    return cv2.imencode(".png", colours[..., ::-1])[1].tobytes()


def _applied(header: ImageHeader, orientation: str, label: str) -> int:
    """Orientation to apply, 1 for none; warns of a tag in either case."""
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
    """Turn values as a viewer does for an EXIF orientation."""
    if orientation >= 5:
        values = values.swapaxes(0, 1)
    # After the transposition of 5 to 8.
    columns = slice(None, None, -1 if orientation in (2, 3, 6, 7) else 1)
    rows = slice(None, None, -1 if orientation in (3, 4, 7, 8) else 1)
    return values[rows, columns]


def decoded_photograph(path: Path, flags: int, *, least: int = 1) -> NDArray | None:
    """Decode an image file to 8 bits by OpenCV.

    Values of 9 to 15 bits in 16 come dark, except of PNM files.

    Args:
        flags: IMREAD_GRAYSCALE, IMREAD_COLOR or a reduced one, with IMREAD_IGNORE_ORIENTATION for pixels as
            stored, except of TIFF files.
        least: least pixels of a side.

    Returns:
        Values (h, w) or (h, w, 3) by the flags, uint8, blue first, turned by the file's orientation tag if
        the flags let it (WebP never); None if it is no image of `image_header`'s formats, is damaged, holds
        floats, has a side under `least`, or has more than `MOST_PIXELS`.

    Raises:
        OSError: if the file is missing or cannot be read.
    """
    content = path.read_bytes()
    header = image_header(content)
    if header is None or min(header.hw) < least or header.hw[0] * header.hw[1] > MOST_PIXELS:
        return None
    pnm = header.white and header.page is None
    values = image_bytes.decoded(content, flags | (cv2.IMREAD_ANYDEPTH if pnm else 0))
    if values is None or not pnm:
        return values
    full = 255 if content[:2] in image_bytes.PNM_OF_TEXT and values.dtype == np.uint8 else header.white
    return np.rint(np.minimum(values / full, 1) * 255).astype(np.uint8)


def _opaque(values: NDArray, content: bytes, label: str, white: int) -> NDArray:
    """Values without alpha channel; OpenCV repeats grey in three equal bands when a PNG has alpha."""
    if values.ndim == 2 or values.shape[2] == 3:
        return values
    if values.shape[2] != 4:
        raise ValueError(f"{label}: has {values.shape[2]} channels: {CHANNELS}")
    full = white or (np.iinfo(values.dtype).max if np.issubdtype(values.dtype, np.integer) else 1.0)
    if (values[..., 3] != full).any():
        raise ValueError(f"{label}: has transparent pixels: flatten it and save it without alpha channel")
    grey = content.startswith(image_bytes.PNG) and content[25] == GREY_WITH_ALPHA
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
    """Scale integers to 0..1. Raises ValueError for values beyond the stated bits."""
    stored, largest = max(white.bit_length(), 8), int(planes.max())
    if bits and bits > stored:
        raise ValueError(f"{label}: has {stored} bits a value, the rig says {bits}: correct 'bits'")
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
    """Import OpenEXR for writing to `path`; ValueError naming the extra if it is not installed."""
    return _of_extra("OpenEXR", "synthesis", f"{path}: writing EXR")


def _of_extra(module: str, extra: str, purpose: str, advice: str = "") -> Any:
    """Import an optional module. Raises ValueError with the command to install it."""
    try:
        return import_module(module)
    except ImportError:
        package = module.replace("_", "-")
        install = install_line(module, extra)
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
    """Encode an image in the format of the path's suffix; ValueError for one that cannot hold it."""
    suffix = path.suffix.lower()
    if suffix in (".jpg", ".jpeg", ".bmp", ".dib", ".gif", ".webp") and bits != 8:
        raise ValueError(f"{path}: {suffix} holds 8 bits, not {bits}: write .png or .tif")
    tiff = suffix in (".tif", ".tiff")
    if bits == 32 and not tiff:
        raise ValueError(f"{path}: 32-bit floats need a name that ends in .tif")
    values = _quantised(colours, bits)
    if tiff:  # OpenCV's have predictors and compressions that depend on its version, and not all read them
        file = io.BytesIO()
        kind = "rgb" if values.shape[2] == 3 else "minisblack"
        rows = values[..., ::-1] if values.shape[2] == 3 else values[..., 0]
        tifffile.imwrite(
            file,
            rows,
            photometric=kind,
            compression="zlib",
            compressionargs={"level": 1},  # a third of the time, and files hardly larger
            predictor=bits < 32,
            metadata=None,
        )
        return file.getvalue()
    try:
        succeeded, content = cv2.imencode(suffix, values)
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


@cache
def srgb_profile() -> bytes:
    """Return the bytes of an sRGB profile, with a fixed date (bytes 24 to 35): files are reproducible."""
    made = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    return made[:24] + struct.pack(">6H", 2000, 1, 1, 0, 0, 0) + made[36:]


def in_srgb(values: NDArray, content: bytes, label: str) -> NDArray:
    """Convert decoded values to sRGB if their file has another colour profile.

    Args:
        values: (h, w) or (h, w, 3) with blue first.
        content: bytes of the image file.
        label: prefix of warnings.

    Returns:
        Values in sRGB, of the same shape and type, with a warning; `values` itself without a profile or with
        sRGB's, and, with a warning, if they are not uint8 or the profile cannot be used.
    """
    profile = _embedded(content)
    if profile is None:
        return values
    try:
        opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        name = ImageCms.getProfileDescription(opened).strip()
        if "srgb" in name.lower() and "linear" not in name.lower():
            return values
        if values.dtype != np.uint8:
            warn(f"{label}: colour profile '{name}' is ignored, as values have 16 bits: save it in sRGB")
            return values
        converted = _converted(values, opened)
    except (ImageCms.PyCMSError, OSError, ValueError) as error:
        warn(f"{label}: its colour profile cannot be used ({error}): save it in sRGB")
        return values
    warn(f"{label}: converted from colour profile '{name}' to sRGB")
    return converted


def _embedded(content: bytes) -> bytes | None:
    """ICC profile in an image file; None without one."""
    if not any(mark in content for mark in (b"iCCP", b"ICC_PROFILE", b"ICCP", b"acsp")):
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(content)) as image:
                return image.info.get("icc_profile")
    except (OSError, SyntaxError, ValueError, TypeError, struct.error, Image.DecompressionBombError):
        return None


def _converted(values: NDArray, profile: ImageCms.ImageCmsProfile) -> NDArray:
    grey = values.ndim == 2
    image = Image.fromarray(values if grey else np.ascontiguousarray(values[..., ::-1]))
    srgb = ImageCms.createProfile("sRGB")
    intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
    colours = np.asarray(ImageCms.profileToProfile(image, profile, srgb, intent, outputMode="RGB"))
    return colours[..., 1].copy() if grey else colours[..., ::-1]


def with_srgb_profile(content: bytes, suffix: str) -> bytes:
    """Add an sRGB profile to the bytes of an image file.

    Args:
        content: bytes of a file in colour and without a profile; neither is checked.
        suffix: suffix of its name in small letters, such as ".png".

    Returns:
        The bytes of a PNG or JPEG file with the profile; of other files unchanged.
    """
    if suffix == ".png":
        return _with_profile(content, b"sRGB", srgb_profile())
    if suffix in (".jpg", ".jpeg"):
        segment = b"ICC_PROFILE\0\1\1" + srgb_profile()
        assert len(segment) < _JPEG_PART
        return content[:2] + b"\xff\xe2" + struct.pack(">H", len(segment) + 2) + segment + content[2:]
    return content


def _with_profile(png: bytes, name: bytes, profile: bytes) -> bytes:
    """Return the bytes of a PNG file with a colour profile."""
    body = b"iCCP" + name + b"\0\0" + zlib.compress(profile)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return png[:33] + chunk + png[33:]
