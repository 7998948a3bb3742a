"""Sampling of images at positions, with validity."""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor
from torch.nn.functional import grid_sample

from .pixels import HW, floating, within
from .runtime.threads import in_parallel
from .runtime.tracing import followed

Interpolation = Literal["bilinear", "nearest", "bicubic"]


class Sampled(NamedTuple):
    """Values of images at positions.

    Attributes:
        values: sampled values (b, c, *n); 0 where not valid, unless the function extends them.
        valid: mask (b, *n), True for positions on the image's area that meet the function's conditions.
    """

    values: Float[Tensor, "b c *n"]
    valid: Bool[Tensor, " b *n"]


def to_grid(x: Real[Tensor, "*n 2"], hw: HW) -> Float[Tensor, "*n 2"]:
    """Convert pixels to the coordinates of `grid_sample(align_corners=False)`: -1 and 1 are the area's edges.

    >>> to_grid(torch.tensor([-0.5, 9.5]), (10, 20)).tolist()
    [-1.0, 1.0]
    """
    h, w = hw
    x = floating(x)
    return (2 * x + 1) / x.new_tensor([w, h]) - 1


def on_image(x: Real[Tensor, "*n 2"], hw: HW) -> Bool[Tensor, "*n"]:
    """Return True for positions on the image's area, [-0.5, W - 0.5] x [-0.5, H - 0.5], to 1e-3 pixels."""
    return within(x, hw, SLACK)


SLACK = 1e-3
"""Rounding allowed for positions on the area's edge, pixels."""
PIECE = 2**15
"""Positions that a thread looks up at a time."""


def sample(
    image: Float[Tensor, "b c h w"],
    x: Real[Tensor, "k *n 2"],
    *,
    interpolation: Interpolation = "bilinear",
    extended: bool = False,
) -> Sampled:
    """Sample images at positions.

    On the outer half pixel of the area the nearest pixels count; "nearest" takes the pixel whose area
    contains the position, halves upwards; "bicubic" may overshoot.

    Args:
        image: (B, C, H, W).
        x: pixels (B, *n, 2), or (1, *n, 2) for the same positions in each image.
        extended: True to give positions outside the area the value of the nearest pixel, as valid.

    Returns:
        Values (B, C, *n) in the images' type, and validity; outside (by more than `SLACK`) values are 0 and
        not valid unless `extended`, at NaN always. Differentiable in image and, unless "nearest", positions.

    Raises:
        ValueError: for pixels or images of other shapes, images of whole numbers or without a pixel, or
            another interpolation.
        TypeError: for values that are no tensors.
        NotImplementedError: in forward mode (jvp, jacfwd, hessian).
    """
    if image.ndim != 4 or not image.numel() or not image.is_floating_point() or x.ndim < 2:
        raise ValueError(
            f"wanted images (B, C, H, W) of floating-point numbers and pixels (B, ..., 2), got {image.dtype} "
            f"{tuple(image.shape)} and {tuple(x.shape)}"
        )
    if len(x) not in (1, len(image)):
        raise ValueError(f"wanted pixels for 1 or {len(image)} images, got them for {len(x)}")
    if interpolation not in get_args(Interpolation):
        raise ValueError(
            f"interpolation is {interpolation!r}; wanted one of {', '.join(get_args(Interpolation))}"
        )
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
        values = _looked_up(image.to(dtype), grid.to(dtype), interpolation)
    except NotImplementedError:
        raise NotImplementedError(
            "sample has no forward mode (jvp, jacfwd, hessian): use grad, vjp or jacrev"
        ) from None
    values = values.reshape(batch, image.shape[1], *x.shape[1:-1])
    return Sampled(torch.where(valid[:, None], values, 0.0).to(image.dtype), valid)


def _looked_up(
    image: Float[Tensor, "b c h w"], grid: Float[Tensor, "b 1 n 2"], interpolation: Interpolation
) -> Float[Tensor, "b c 1 n"]:
    """Look up by torch; many positions without gradients on all threads: torch takes one an image."""
    look_up = partial(grid_sample, mode=interpolation, padding_mode="border", align_corners=False)
    gradients = torch.is_grad_enabled() and (image.requires_grad or grid.requires_grad)
    if gradients or followed() or image.device.type != "cpu" or grid.shape[2] < 2 * PIECE:
        return look_up(image, grid)
    out = image.new_empty(*image.shape[:2], 1, grid.shape[2])

    def piece(first: int) -> None:
        here = slice(first, first + PIECE)
        out[..., here] = look_up(image, grid[:, :, here])

    in_parallel([partial(piece, first) for first in range(0, grid.shape[2], PIECE)])
    return out
