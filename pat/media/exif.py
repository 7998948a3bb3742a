"""What EXIF says of the camera: the focal length in pixels."""

from __future__ import annotations

import math
from pathlib import Path

from PIL import Image, UnidentifiedImageError

_EXIF, _FOCAL, _FOCAL_35MM, _WIDTH = 0x8769, 0x920A, 0xA405, 0xA002
_PLANE_RESOLUTION, _PLANE_UNIT = 0xA20E, 0xA210
_DIAGONAL_35MM = 43.267
"""Of 36 x 24 mm."""
_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
"""Units of the sensor's resolution: inch, cm, mm, micrometre."""


def focal_length(path: str | Path) -> float | None:
    """The focal length in pixels of an image file, by its EXIF tags; None if they do not say.

    By the sensor's resolution or, without that, by the focal length's equivalent on 35 mm film.
    """
    try:
        with Image.open(path) as image:
            width, height = image.size
            tags = image.getexif().get_ifd(_EXIF)
        return _by_sensor(tags, width) or _by_film(tags, width, height)
    except (OSError, UnidentifiedImageError, TypeError, ValueError, ZeroDivisionError, Image.DecompressionBombError):
        return None


def _by_sensor(tags: dict[int, object], width: int) -> float | None:
    focal, resolution = (_number(tags.get(tag)) for tag in (_FOCAL, _PLANE_RESOLUTION))
    unit = _MM.get(int(_number(tags.get(_PLANE_UNIT)) or 2))
    if not (focal and resolution and unit):
        return None
    return focal * resolution / unit * width / (_number(tags.get(_WIDTH)) or width)


def _by_film(tags: dict[int, object], width: int, height: int) -> float | None:
    equivalent = _number(tags.get(_FOCAL_35MM))
    return equivalent * math.hypot(width, height) / _DIAGONAL_35MM if equivalent else None


def _number(value: object) -> float | None:
    number = float(value) if value is not None else 0.0  # type: ignore[arg-type]
    return number if math.isfinite(number) and number > 0 else None
