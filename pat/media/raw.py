"""Raw camera images -> images to fuse, by the rig's counts, filter pattern, exposure and encoding.

Images to fuse are sRGB-encoded, on alpha's scale of light: where exposures and gains are known, a surface has
one value in all of them. Ordinary images, which the rig describes no further, are unchanged.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig, Sensor
from arraygeom.runtime.chunks import chunked

from .colour import linear_from_srgb, luminance, srgb_from_linear


def develop(
    image: Float[Tensor, "c h w"], sensor: Sensor, *, like: Sensor | None = None
) -> Float[Tensor, "c2 h w"]:
    """The image sRGB-encoded: black level subtracted, demosaiced, light on `like`'s scale.

    `image` holds counts over 2^bits - 1. Values are at least 0, and exceed 1 where the light is
    above white on `like`'s scale. Exposures are used only where both are known.
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


def recorded_bands(values: Any, sensor: Sensor) -> Any:
    """Values (C, H, W) of a file; one band of three equal ones of a camera that is in grey by the rig."""
    grey = len(values) == 3 and sensor.response not in (None, "rgb")
    return values[:1] if grey and all((values[0] == band).all() for band in values[1:]) else values


LIGHT = "luminance of light"
"""The response of developed images known to be the sRGB-encoded luminance of linear light.

Ordinary grey images may be the luma of sRGB values instead, which differs where colours are saturated."""


def developed(sensor: Sensor) -> Sensor:
    """The sensor of developed images: sRGB values, no counts, no filter pattern."""
    measured = sensor.response == "mono" and sensor.coding == "linear"
    plain = dataclasses.replace(sensor, coding="srgb", bayer=None, bits=None, black_level=0.0, gain=1.0)
    return dataclasses.replace(plain, response=LIGHT) if measured else plain


def developed_rig(rig: Rig, names: Iterable[str]) -> Rig:
    """The rig of the developed images of these cameras."""
    for name in names:
        rig = rig.with_camera(name, rig[name].replace(sensor=developed(rig[name].sensor)))
    return rig


def match_luminance(
    image: Float[Tensor, "3 h w"], alpha: Float[Tensor, "1 h w"], sensor: Sensor
) -> Float[Tensor, "3 h w"]:
    """The fused image with alpha's luminance of light, if alpha's camera measured that (`LIGHT`).

    Fusion gives an image whose sRGB values have alpha's as their luma. Here all three are shifted by the same
    amount until the luminance of their light is alpha's: by 0.045 for saturated purple of middle brightness.
    """
    if sensor.response != LIGHT:
        return image
    return chunked(lambda rgb, luma: rgb + _missing(rgb, linear_from_srgb(luma)), image, alpha)


def _missing(image: Tensor, light: Tensor) -> Tensor:
    """The shift of sRGB values giving this luminance of light; Newton on a convex function, from above."""
    shift = torch.zeros_like(light)
    for _ in range(4):
        value = image + shift
        curved = 2.4 / 1.055 * ((value.clamp(min=0) + 0.055) / 1.055) ** 1.4
        slope = torch.where(value <= 0.04045, 1 / 12.92, curved)
        shift = shift - (luminance(linear_from_srgb(value)) - light) / luminance(slope)
    return shift


def demosaiced(raw: Float[Tensor, "1 h w"], pattern: str) -> Float[Tensor, "3 h w"]:
    """Colours of a raw image behind a colour filter mosaic, interpolated along edges (OpenCV, in 16 bits).

    Red and blue are green plus the median of their differences from it over 3x3 pixels (Freeman, US patent
    4,724,395): false-colour fringes at fine detail would otherwise be propagated to alpha.
    """
    code = getattr(cv2, f"COLOR_Bayer{pattern}2RGB_EA")
    counts = np.rint(raw[0].clamp(0, 1).cpu().numpy().astype(np.float64) * 65535).astype(np.uint16)
    colours = cv2.demosaicing(counts, code).astype(np.float32) / np.float32(65535)
    green = colours[..., 1]
    for i in (0, 2):
        colours[..., i] = green + cv2.medianBlur(np.ascontiguousarray(colours[..., i] - green), 3)
    return torch.from_numpy(colours.clip(0, 1)).movedim(-1, 0).contiguous().to(raw)


def light_of(sensor: Sensor, like: Sensor) -> float:
    """The value (1 is white) that `sensor` records, grey or green, of light that is 1 on `like`'s scale."""
    return 1 / _light(sensor, like)[1]


def _light(sensor: Sensor, like: Sensor) -> tuple[float, float, float]:
    """Factors of linear red, green and blue; a grey image takes the middle one."""
    exposure = like.exposure / sensor.exposure if like.exposure and sensor.exposure else 1.0
    wanted = _gains(like)[1]
    r, g, b = (exposure * wanted / gain for gain in _gains(sensor))
    return r, g, b


def _gains(sensor: Sensor) -> tuple[float, float, float]:
    return sensor.gain if isinstance(sensor.gain, tuple) else (sensor.gain,) * 3
