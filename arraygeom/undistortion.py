"""Pictures without their lens's bending: pinhole cameras in place of those with lenses, and pictures taken across."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from .camera import Camera
from .pixels import coarse_grid, pixel_grid
from .sampling import Interpolation, Sampled, sample

WIDEST = math.radians(62)
"""How far off axis a pinhole view reaches: there it stretches outwards 4.5 times what it does in its middle."""


def pinhole_view(camera: Camera, *, widest: float = WIDEST) -> Camera:
    """The camera without its lens, large enough for all that the old picture shows up to `widest` radians off axis.

    Same place, orientation and K but for the principal point: pixels in the middle keep their size. Raises ValueError
    for a batch of cameras, and for a picture whose middle is outside its lens's range.
    """
    if camera.K.ndim > 2:
        raise ValueError("a pinhole view is made of one camera at a time: take one of the batch")
    rays, valid = camera.rays(coarse_grid(camera.hw).to(camera.K))
    near_axis = valid & (rays[..., 2] >= math.cos(widest) * rays.norm(dim=-1))
    if not near_axis.any():
        raise ValueError("no pixel of the picture is within its lens's range: check the distortion's coefficients")
    seen = rays[near_axis]
    x = (seen[:, :2] / seen[:, 2:]) @ camera.K[:2, :2].mT + camera.K[:2, 2]
    low, high = x.amin(0).floor(), x.amax(0).ceil()
    K = camera.K.clone()
    K[:2, 2] = K[:2, 2] - low
    w, h = (int(n) + 1 for n in (high - low).tolist())
    return camera.replace(K=K, hw=(h, w), distortion=None)


def pixels_between(source: Camera, target: Camera) -> tuple[Float[Tensor, "h w 2"], Tensor]:
    """For each pixel of `target` where `source`, in the same place, sees it, and whether it does. Float64."""
    source, target = source.to(torch.float64), target.to(torch.float64)
    rays, valid = target.rays(pixel_grid(target.hw, dtype=torch.float64))
    turn = source.R @ target.R.mT
    found = source.project_local(rays @ turn.mT)
    return found.x, valid & found.valid & source.contains(found.x)


def retaken(
    picture: Float[Tensor, "c h w"], source: Camera, target: Camera, *, interpolation: Interpolation = "bicubic"
) -> Sampled:
    """The picture that `target`, in the same place as `source`, would have taken: values (1, C, H, W) and validity.

    Where `source` sees nothing values are 0. The distance of the two places is not looked at.
    """
    x, seen = pixels_between(source, target)
    found = sample(picture[None], torch.where(seen[..., None], x, 0.0)[None].to(picture), interpolation=interpolation)
    return Sampled(found.values * seen, found.valid & seen)
