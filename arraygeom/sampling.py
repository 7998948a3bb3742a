"""Sampling an image at positions, with validity."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor
from torch.nn.functional import grid_sample

from .pixels import HW, floating, within

Interpolation = Literal["bilinear", "nearest", "bicubic"]


class Sampled(NamedTuple):
    """Values (B, C, *n) and whether each position (B, *n) was on the image's area."""

    values: Float[Tensor, "b c *n"]
    valid: Bool[Tensor, " b *n"]


def to_grid(x: Real[Tensor, "*n 2"], hw: HW) -> Float[Tensor, "*n 2"]:
    """Pixels to the coordinates of `grid_sample(align_corners=False)`, where -1 and 1 are the area's edges.

    >>> to_grid(torch.tensor([-0.5, 9.5]), (10, 20)).tolist()
    [-1.0, 1.0]
    """
    h, w = hw
    x = floating(x)
    return (2 * x + 1) / x.new_tensor([w, h]) - 1


def on_image(x: Real[Tensor, "*n 2"], hw: HW) -> Bool[Tensor, "*n"]:
    """Whether positions lie on the image's area, [-0.5, W - 0.5] x [-0.5, H - 0.5], to 1e-3 pixels."""
    return within(x, hw, SLACK)


SLACK = 1e-3
"""Rounding allowed to positions on the area's edge, pixels."""


def sample(
    image: Float[Tensor, "b c h w"],
    x: Real[Tensor, "k *n 2"],
    *,
    interpolation: Interpolation = "bilinear",
    extended: bool = False,
) -> Sampled:
    """Images (B, C, H, W) at positions x (B, *n, 2), or (1, *n, 2) for the same positions in each, in pixels.

    On the outer half pixel of the area the nearest pixels count; "nearest" takes the pixel on whose area a
    position lies, halves upwards. Outside it values are 0 and valid is False; or, if
    `extended`, they are those of the nearest pixel, which are valid.
    """
    batch, hw = len(image), (image.shape[-2], image.shape[-1])
    dtype = torch.promote_types(image.dtype, floating(x).dtype)
    x = floating(x).expand(batch, *x.shape[1:])
    if extended:
        x = torch.minimum(x.clamp(min=0), x.new_tensor([hw[1] - 1, hw[0] - 1]))
    valid = on_image(x, hw)
    if interpolation == "nearest":  # halves go up, as in attention: grid_sample's go either way
        x = torch.minimum((x + 0.5).floor().clamp(min=0), x.new_tensor([hw[1] - 1, hw[0] - 1]))
    grid = to_grid(torch.where(valid[..., None], x, 0.0), hw).reshape(batch, 1, -1, 2)
    try:
        values = grid_sample(
            image.to(dtype), grid.to(dtype), mode=interpolation, padding_mode="border", align_corners=False
        )
    except NotImplementedError:
        raise NotImplementedError(
            "sample has no forward mode (jvp, jacfwd, hessian): use grad, vjp or jacrev"
        ) from None
    values = values.reshape(batch, image.shape[1], *x.shape[1:-1])
    return Sampled(torch.where(valid[:, None], values, 0.0).to(image.dtype), valid)
