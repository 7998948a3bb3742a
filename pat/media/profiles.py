"""ICC colour profiles: images are converted to sRGB when read, and labelled as sRGB when written."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from functools import cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from arraygeom.runtime.warned import warn

_JPEG_PART = 65_000
"""Bytes of a profile that fit in one segment of a JPEG file."""


@cache
def srgb_profile() -> bytes:
    """Return the bytes of an ICC profile of sRGB, with a fixed date (bytes 24 to 35) so that files are
    reproducible."""
    made = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    return made[:24] + struct.pack(">6H", 2000, 1, 1, 0, 0, 0) + made[36:]


def in_srgb(values: NDArray, content: bytes, label: str) -> NDArray:
    """Convert decoded values to sRGB if their file has another colour profile.

    Args:
        values: (h, w) or (h, w, 3) with blue first.
        content: bytes of the image file.
        label: prefix of warnings.

    Returns:
        Values in sRGB, of the same shape and type. Values of 16 bits, and values with a profile that cannot
        be used, are returned unchanged with a warning.
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
    """Add an sRGB profile to the bytes of an image file in colour: in a grey one it is not valid.

    Args:
        content: bytes of the file.
        suffix: suffix of its name in small letters, such as ".png".

    Returns:
        The bytes of a PNG or JPEG file with the profile; of other files unchanged.
    """
    if suffix == ".png":
        body = b"iCCP" + b"sRGB\0\0" + zlib.compress(srgb_profile())
        chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
        return content[:33] + chunk + content[33:]
    if suffix in (".jpg", ".jpeg"):
        segment = b"ICC_PROFILE\0\1\1" + srgb_profile()
        assert len(segment) < _JPEG_PART
        return content[:2] + b"\xff\xe2" + struct.pack(">H", len(segment) + 2) + segment + content[2:]
    return content
