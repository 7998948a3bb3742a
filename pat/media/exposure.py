"""A sensible brightness for a fused image."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from arraygeom.chunks import chunked

from .colour import linear_from_srgb, luminance_of, srgb_from_linear

BRIGHT = 0.99
"""The share of pixels that are at most as bright as the brightest that counts."""
ORDINARY = (0.2, 1.25)
"""Linear light of that brightest pixel, 1 is white, in images that are left as they are."""
WANTED = 0.8
"""Its light in images that are not."""


def exposure_gain(image: Float[Tensor, "c h w"]) -> float:
    """The factor of linear light that brings a dark or an overexposed image to a sensible brightness; 1 for others."""
    light = linear_from_srgb(luminance_of(image).mean(0)).flatten()
    brightest = float(light[:: max(light.numel() // 100_000, 1)].quantile(BRIGHT))
    if ORDINARY[0] <= brightest <= ORDINARY[1] or brightest <= 1e-4:
        return 1.0
    return WANTED / brightest


def exposed(image: Float[Tensor, "c h w"], gain: float) -> Float[Tensor, "c h w"]:
    """The image with its linear light times a factor."""
    if gain == 1:
        return image
    return chunked(lambda rows: srgb_from_linear(gain * linear_from_srgb(rows)), image)
