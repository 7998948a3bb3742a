"""The photometric error of the fusion as a function of the rig.

C3 attention samples each alpha pixel's segment in beta and returns the weighted value: the error is its
difference from alpha's own value. Attention determines the position along the segment; the position across it
depends on the rig alone. Bilinear sampling propagates the gradient to the segments' ends and so to the rig.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad, unfold

from arraygeom import Positions, Rig, Segments, pixel_grid
from arraygeom.fields import recorded_field

Attend = Callable[[Tensor, Tensor, Tensor, Segments | Positions], Any]
"""Attention from queries to keys and values along a field, `pat.attention.attend_with_statistics`: of its
result, `value` (1, D, h, w) is the weighted value, and `peak` (1, h, w) the largest weight."""
LARGEST = 480
"""Longer side in pixels to which images are reduced."""
PIXELS = 6000
"""Approximate number of alpha pixels used, on a grid."""
SHARPNESS = 20.0
"""The inner product of two equal descriptors."""
WINDOW = 9
"""Side in pixels of the windows by whose mean and deviation values are normalised, for invariance to exposure
and filters."""
EVEN = 0.02
"""Deviation, of images in 0..1, below which a window has only noise."""


class PhotometricImage(NamedTuple):
    """A reduced image, ready for attention.

    Attributes:
        keys: features (1, D, h, w) by which pixels are compared.
        values: differences from the local mean (1, 1, h, w), in local standard deviations.
        grid: pixels (r, c, 2), as (x, y) of the reduced image, at which errors are computed.
    """

    keys: Tensor
    values: Tensor
    grid: Tensor

    @classmethod
    def from_image(cls, image: Float[Tensor, "_ _ _"]) -> PhotometricImage:
        """Reduce an image (C, H, W) in 0..1, with patches as features."""
        grey = _reduced(image)
        h, w = grey.shape[-2:]
        step = max(1, round((h * w / PIXELS) ** 0.5))
        return cls(patches(grey), structure(grey), pixel_grid((h, w))[step // 2 :: step, step // 2 :: step])


def photometric_errors(
    rig: Rig, views: Mapping[str, PhotometricImage], names: tuple[str, str], attend: Attend
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Compute the error of attention's value against alpha's, at the pixels of the grid.

    Differentiable in the rig. Errors are weighted by the square root of attention's largest weight, its
    confidence.

    Args:
        rig: rig of the images at full size.
        views: reduced images by camera.
        names: names of alpha and beta.
        attend: attention operator (`pat.attention.attend_with_statistics`).

    Returns:
        The errors (r, c), in local standard deviations, 0 where invalid; and the mask of valid pixels.
    """
    alpha, beta = names
    for name in names:
        h, w = views[name].keys.shape[-2:]
        rig = rig.resize(name, (h, w))
    pair, x = rig.pair(*names).to(torch.float32), views[alpha].grid
    locations = recorded_field(pair, samples=64, nodes=16)(pair, x)
    columns, rows = x[0, :, 0].long(), x[:, 0, 1].long()
    query, value = (image[:, :, rows][..., columns] for image in (views[alpha].keys, views[alpha].values))
    attended = attend(query, views[beta].keys, views[beta].values, locations)
    valid = locations.mask.any(-1) if isinstance(locations, Positions) else locations.valid
    confidence = attended.peak[0].detach().sqrt()
    return torch.where(valid, confidence * (attended.value - value)[0, 0], 0.0), valid


def patches(grey: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "1 25 h w"]:
    """Compute normalised patches of 5 x 5 pixels without mean: their inner product is their scaled
    correlation."""
    h, w = grey.shape[-2:]
    around = unfold(pad(grey, (2, 2, 2, 2), mode="replicate"), 5).view(1, 25, h, w)
    around = around - around.mean(1, keepdim=True)
    length = around.square().sum(1, keepdim=True).add(25 * EVEN**2).sqrt()
    return around / length * SHARPNESS**0.5


def structure(grey: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "1 1 h w"]:
    """Compute each pixel's difference from the local mean, in local standard deviations."""
    mean, square = (_local_mean(p) for p in (grey, grey.square()))
    return (grey - mean) / (square - mean.square()).clamp(min=0).add(EVEN**2).sqrt()


def _local_mean(grey: Tensor) -> Tensor:
    r = WINDOW // 2
    return avg_pool2d(pad(grey, (r, r, r, r), mode="replicate"), WINDOW, 1)


def _reduced(image: Tensor) -> Tensor:
    from kornia.color import rgb_to_grayscale  # here, as it takes .3 s to import

    grey = (rgb_to_grayscale(image) if image.shape[0] == 3 else image.mean(0, keepdim=True))[None].float()
    h, w = grey.shape[-2:]
    factor = LARGEST / max(h, w)
    if factor >= 1:
        return grey
    return interpolate(grey, size=(round(h * factor), round(w * factor)), mode="bilinear", antialias=True)
