"""Luminance, chroma and the sRGB transfer function, each defined once."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from arraygeom.runtime.chunks import chunked

REC601 = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in luma, on sRGB-encoded values (ITU-R BT.601)."""
REC709 = (0.2126, 0.7152, 0.0722)
"""Weights of red, green and blue in luminance, on linear values (ITU-R BT.709)."""
OPPONENT = ((3**-0.5, 3**-0.5, 3**-0.5), (2**-0.5, 0.0, -(2**-0.5)), (6**-0.5, -2 * 6**-0.5, 6**-0.5))
"""Opponent colours of RGB: brightness and two colour differences, orthogonal and of unit length."""


def luminance(
    rgb: Float[Tensor, "*b 3 h w"], weights: tuple[float, float, float] = REC601
) -> Float[Tensor, "*b 1 h w"]:
    """Compute the weighted sum of red, green and blue, by default Rec. 601 luma of sRGB values.

    Default: .299 R + .587 G + .114 B, as in MATLAB's rgb2gray and OpenCV; `REC709` weights suit linear light.

    Returns:
        One channel (*b, 1, h, w). Channels after the third are ignored.

    Raises:
        ValueError: for fewer than three channels.
    """
    red, green, blue = (weight * plane for weight, plane in zip(weights, rgb.split(1, -3)))
    return red + green + blue


def to_luma_chroma(
    rgb: Float[Tensor, "*b 3 h w"],
) -> tuple[Float[Tensor, "*b 1 h w"], Float[Tensor, "*b 2 h w"]]:
    """Split sRGB values into luma and colour differences.

    Returns:
        Rec. 601 luma Y (*b, 1, h, w), and (R - Y, B - Y) (*b, 2, h, w), not scaled, zero for grey.

    Raises:
        ValueError: for fewer than three channels.
    """
    luma = luminance(rgb)
    return luma, torch.cat([rgb[..., 0:1, :, :], rgb[..., 2:3, :, :]], -3) - luma


def from_luma_chroma(
    luma: Float[Tensor, "*b 1 h w"], chroma: Float[Tensor, "*b 2 h w"]
) -> Float[Tensor, "*b 3 h w"]:
    """Compose RGB from luma and colour differences: the inverse of `to_luma_chroma`.

    Returns:
        RGB (*b, 3, h, w), not clipped to 0..1; its luma is `luma` for any chroma.
    """
    red_weight, green_weight, blue_weight = REC601
    red, blue = chroma[..., 0:1, :, :], chroma[..., 1:2, :, :]
    green = -(red_weight * red + blue_weight * blue) / green_weight
    return torch.cat([red, green, blue], -3) + luma


def luminance_of(image: Float[Tensor, "_ h w"]) -> Float[Tensor, "_ h w"]:
    """Return the luma (1, h, w) of an RGB image; one of other channels is returned unchanged."""
    return luminance(image) if image.shape[0] == 3 else image


def linear_from_srgb(values: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Decode sRGB values to linear light (IEC 61966-2-1), 1 at white; linear below zero."""
    toe = values <= 0.04045
    return torch.where(toe, values / 12.92, ((torch.where(toe, 0.5, values) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(light: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Encode linear light as sRGB values: the inverse of `linear_from_srgb`."""
    toe = light <= 0.04045 / 12.92
    return torch.where(toe, 12.92 * light, 1.055 * torch.where(toe, 0.5, light) ** (1 / 2.4) - 0.055)


def srgb_image(light: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Encode linear light as an ordinary image: clipped to 0..1, then sRGB-encoded."""
    return srgb_from_linear(light.clamp(0, 1))


def to_bytes(values: Float[Tensor, "*b"] | Float[NDArray, "*b"]) -> NDArray[np.uint8]:
    """Convert values 0..1 to 8-bit counts: clipped, rounded to nearest (halves to even)."""
    array = values.detach().cpu().numpy() if isinstance(values, Tensor) else values
    return np.rint(np.clip(np.asarray(array, np.float32), 0, 1) * 255).astype(np.uint8)


BRIGHT = 0.99
"""Quantile of brightness that stands for an image's brightest part."""
ORDINARY = (0.2, 1.25)
"""Range of linear light at that quantile (1 is white) within which an image needs no gain."""
WANTED = 0.8
"""Linear light that a gain brings that quantile to."""


def exposure_gain(image: Float[Tensor, "c h w"]) -> float:
    """Compute the gain that brings the brightest part of a dark or overexposed sRGB image to `WANTED`.

    The brightest part is the quantile `BRIGHT` of linear light, by RGB's luma or the mean of other channels.

    Returns:
        Factor of linear light; 1 if that quantile is within `ORDINARY` already, or black; NaN for NaN or
        infinity among the pixels, of which only some are looked at in large images.
    """
    light = linear_from_srgb(luminance_of(image).mean(0)).flatten()
    brightest = float(light[:: max(light.numel() // 100_000, 1)].quantile(BRIGHT))
    if ORDINARY[0] <= brightest <= ORDINARY[1] or brightest <= 1e-4:
        return 1.0
    return WANTED / brightest


def exposed(image: Float[Tensor, "c h w"], gain: float) -> Float[Tensor, "c h w"]:
    """Multiply an sRGB image's light by a factor, without clipping; the same tensor for a gain of 1."""
    if gain == 1:
        return image
    return chunked(lambda rows: srgb_from_linear(gain * linear_from_srgb(rows)), image)
