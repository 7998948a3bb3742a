"""Development of raw camera images by the rig's counts, filter pattern, exposure and encoding.

Developed images are sRGB-encoded, on alpha's scale of light: with known exposures and gains a surface has one
value in all of them. Ordinary images, of which the rig states nothing more, stay unchanged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig, Sensor
from arraygeom.runtime.chunks import chunked
from arraygeom.sensor import PATTERNS

from .colour import linear_from_srgb, luminance, srgb_from_linear


def develop(
    image: Float[Tensor, "c h w"], sensor: Sensor, *, like: Sensor | None = None
) -> Float[Tensor, "c2 h w"]:
    """Develop an image to sRGB: subtract the black level, demosaic, scale light to another camera's level.

    Args:
        image: counts over 2^bits - 1; sRGB values unless `sensor.coding` is "linear". A mosaic is its first
            channel.
        sensor: the camera that recorded it; a black level without `bits` is in counts of 16 bits, and is
            under white, which is not checked.
        like: sensor to whose scale of light (exposure, gain in green) each channel is brought; None for its
            own. Exposures count only if both are known.

    Returns:
        sRGB values, 3 channels for a filter mosaic; at least 0 after a black level was subtracted, above 1
        where light exceeds white; `image` itself where the sensor states nothing to be done. A mosaic that
        requires a gradient raises RuntimeError.
    """
    factor = _light(sensor, like or sensor)
    if sensor.black_level:
        black = sensor.black_level / (2.0 ** (sensor.bits or 16) - 1)
        image = ((image - black) / (1 - black)).clamp(min=0)
    if sensor.bayer:
        image = demosaiced(image, sensor.bayer)
    if factor == (1.0, 1.0, 1.0):
        return srgb_from_linear(image) if sensor.coding == "linear" else image
    linear = image if sensor.coding == "linear" else linear_from_srgb(image)
    scale = linear.new_tensor(factor if len(linear) == 3 else factor[1:2])
    return srgb_from_linear(linear * scale[:, None, None])


LIGHT = "luminance of light"
"""Response of developed images known to be sRGB-encoded luminance of linear light.

Ordinary grey images may be the luma of sRGB values instead, which differs for saturated colours.
"""


def developed(sensor: Sensor) -> Sensor:
    """Return the sensor of developed images: sRGB values, no counts, no filter pattern, gain 1."""
    measured = sensor.response == "mono" and sensor.coding == "linear"
    plain = dataclasses.replace(sensor, coding="srgb", bayer=None, bits=None, black_level=0.0, gain=1.0)
    return dataclasses.replace(plain, response=LIGHT) if measured else plain


def developed_rig(rig: Rig, names: Iterable[str]) -> Rig:
    """Return the rig with the named cameras' sensors replaced by those of developed images."""
    for name in names:
        rig = rig.with_camera(name, rig[name].replace(sensor=developed(rig[name].sensor)))
    return rig


def match_luminance(
    image: Float[Tensor, "3 h w"], alpha: Float[Tensor, "1 h w"], sensor: Sensor
) -> Float[Tensor, "3 h w"]:
    """Shift a fused image so that the luminance of its light is alpha's, if alpha's camera measured light.

    Where the response is `LIGHT`, all three sRGB values of a pixel are shifted equally, by four Newton steps,
    which suffice if their luma is about alpha's, as fusion makes it.

    Args:
        alpha: alpha's developed image, sRGB values.
        sensor: alpha's sensor as `developed` returns it.

    Returns:
        The shifted RGB image, not clipped; `image` itself for another response.
    """
    if sensor.response != LIGHT:
        return image
    return chunked(lambda rgb, luma: rgb + _missing(rgb, linear_from_srgb(luma)), image, alpha)


def _missing(image: Tensor, light: Tensor) -> Tensor:
    """Shift of sRGB values that gives this luminance of light, by Newton's method."""
    shift = torch.zeros_like(light)
    for _ in range(4):
        value = image + shift
        curved = 2.4 / 1.055 * ((value.clamp(min=0) + 0.055) / 1.055) ** 1.4
        slope = torch.where(value <= 0.04045, 1 / 12.92, curved)
        shift = shift - (luminance(linear_from_srgb(value)) - light) / luminance(slope)
    return shift


def demosaiced(raw: Float[Tensor, "1 h w"], pattern: str) -> Float[Tensor, "3 h w"]:
    """Interpolate a Bayer mosaic along edges (OpenCV, in 16 bits).

    Red and blue are green plus the 3x3 median of their difference from it (Freeman, US patent 4,724,395),
    which removes false-colour fringes.

    Args:
        raw: values of the mosaic, 0..1; others are clipped; channels after the first are ignored.
        pattern: colours of the first two pixels of the first row, then of the second, such as "RGGB".

    Returns:
        RGB image of the same size, type and device, clipped to 0..1.

    Raises:
        ValueError: for another pattern, such as OpenCV's of two letters, and a side under 3 pixels.
        RuntimeError: for values that require a gradient.
    """
    if pattern not in PATTERNS:
        raise ValueError(f"the filter pattern is {pattern!r}: wanted {' or '.join(PATTERNS)}")
    if min(raw.shape[-2:]) < 3:
        raise ValueError(f"a mosaic of {raw.shape[-1]}x{raw.shape[-2]} pixels: give 3 or more a side")
    code = getattr(cv2, f"COLOR_Bayer{pattern}2RGB_EA")
    counts = np.rint(raw[0].clamp(0, 1).cpu().numpy().astype(np.float64) * 65535).astype(np.uint16)
    colours = cv2.demosaicing(counts, code).astype(np.float32) / np.float32(65535)
    green = colours[..., 1]
    for i in (0, 2):
        colours[..., i] = green + cv2.medianBlur(np.ascontiguousarray(colours[..., i] - green), 3)
    return torch.from_numpy(colours.clip(0, 1)).movedim(-1, 0).contiguous().to(raw)


def light_of(sensor: Sensor, like: Sensor) -> float:
    """Return the value that `sensor` records (1 is white), in grey or green, for 1 on `like`'s scale."""
    return 1 / _light(sensor, like)[1]


def _light(sensor: Sensor, like: Sensor) -> tuple[float, float, float]:
    """Factors of linear red, green and blue; a grey image takes the second."""
    exposure = like.exposure / sensor.exposure if like.exposure and sensor.exposure else 1.0
    wanted = _gains(like)[1]
    r, g, b = (exposure * wanted / gain for gain in _gains(sensor))
    return r, g, b


def _gains(sensor: Sensor) -> tuple[float, float, float]:
    return sensor.gain if isinstance(sensor.gain, tuple) else (sensor.gain,) * 3
