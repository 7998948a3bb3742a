"""From images back to depth: two views along a field, N views by triangulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .camera import Camera
from .epipolar import Depth, depth_from_track, track
from .pixels import floating, product
from .rig import Pair


class Triangulated(NamedTuple):
    """World points (*n, 3) in metres, their covariance (*n, 3, 3) in m^2 for matches good to 1 px, and validity.

    For matches good to s pixels the covariance is s^2 times as large.
    """

    X: Float[Tensor, "*n 3"]
    covariance: Float[Tensor, "*n 3 3"]
    valid: Bool[Tensor, "*n"]


def triangulate(
    cameras: Sequence[Camera],
    x: Real[Tensor, "v *n 2"],
    *,
    seen: Bool[Tensor, "v *n"] | None = None,
    refinements: int = 3,
) -> Triangulated:
    """Points from their pixels in two views or more, through any lens.

    Linear least squares on the distances from the point to the rays, repeated with each ray weighted by
    (focal length / distance)^2, which turns metres into pixels: close to the least reprojection error (the
    midpoint method and its reweighting; compare Hartley & Zisserman, section 12.2). A view that does not see a
    point is left out where `seen` is False. Valid where two views or more see the point in front of them
    and their rays meet at an angle: to 1 px, the point's depth is known to better than itself.
    """
    if len(cameras) != len(x) or len(cameras) < 2:
        raise ValueError(f"wanted pixels (views, ..., 2) of {len(cameras)} >= 2 cameras, got {tuple(x.shape)}")
    x = floating(x)
    centres, rays, usable, focal = _rays(cameras, x)
    if seen is not None:
        usable = usable & seen
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    across = eye - rays[..., :, None] * rays[..., None, :]
    weight = usable.to(x.dtype) * focal.square()
    X, information, solvable = _meet(across, centres, weight)
    for _ in range(refinements):
        squared = (X - centres).square().sum(-1).clamp(min=1e-12)
        weight = torch.where(usable, focal.square() / squared, 0.0)
        X, information, solvable = _meet(across, centres, weight)
    covariance = torch.linalg.inv(torch.where(solvable[..., None, None], information, eye))
    along = ((X - centres) * rays).sum(-1)
    in_front = ((along > 0) | ~usable).all(0) & (usable.sum(0) >= 2)
    distance = torch.where(usable, along, torch.inf).amin(0)
    known = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) < distance.square()
    valid = solvable & in_front & known
    return Triangulated(torch.where(valid[..., None], X, 0.0), covariance, valid)


def depth_of(
    pair: Pair, x: Real[Tensor, "*n 2"], x_beta: Real[Tensor, "*n 2"], deviation: Float[Tensor, "*n"] | None = None
) -> Depth:
    """Depth in alpha of what its pixels x see at beta's pixels `x_beta`; through lenses too.

    `deviation` is the standard deviation of x_beta along the segment, in pixels; that of the depth is propagated
    to first order. Raises ValueError for uncalibrated pairs.
    """
    alpha, beta = pair.cameras
    x, x_beta = floating(x), floating(x_beta)
    if alpha.distortion is None and beta.distortion is None:
        return depth_from_track(track(alpha.K, beta.K, pair.beta_from_alpha, x), x_beta, deviation)
    pose = pair.beta_from_alpha
    normalised, seen = zip(*(_normalised(c.to(x.dtype), p) for c, p in ((alpha, x), (beta, x_beta))))
    eye = torch.eye(3).to(pose.R).expand_as(pose.R)
    found = depth_from_track(track(eye, eye, pose, normalised[0]), normalised[1])
    valid = found.valid & seen[0] & seen[1]
    depth = torch.where(valid, found.depth, 0.0)
    sigma = torch.zeros_like(depth) if deviation is None else deviation
    return Depth(depth, torch.where(valid, sigma * _metres_per_pixel(pair, x, depth, valid), 0.0), valid)


def _metres_per_pixel(pair: Pair, x: Tensor, depth: Tensor, valid: Tensor) -> Tensor:
    """How much depth a pixel of beta is worth there, by central differences of a thousandth of the depth."""
    alpha, beta = pair.cameras
    safe = torch.where(valid, depth, 1.0).to(alpha.K.dtype)
    ends = [beta.project(alpha.unproject(x.to(safe), safe * (1 + s))).x for s in (5e-4, -5e-4)]
    pixels = (ends[0] - ends[1]).square().sum(-1).clamp(min=1e-24).sqrt()
    return torch.where(valid, 1e-3 * safe / pixels, 0.0).to(depth)


def _normalised(camera: Camera, x: Tensor) -> tuple[Tensor, Tensor]:
    """Where the ray of a pixel meets z = 1, and whether it does."""
    rays, seen = camera.rays(x)
    seen = seen & (rays[..., 2] > 0)
    return rays[..., :2] / torch.where(seen, rays[..., 2], 1.0)[..., None], seen


def _rays(cameras: Sequence[Camera], x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centres and unit directions in the world, which pixels have one, and focal lengths, each (v, *n[, 3])."""
    ones = [1] * (x.ndim - 2)
    rays, usable = zip(*(c.to(x.dtype).rays(p) for c, p in zip(cameras, x)))
    directions = torch.stack(
        [product(r / r.norm(dim=-1, keepdim=True), c.R.to(x.dtype)) for r, c in zip(rays, cameras)]
    )
    centres = torch.stack([c.centre for c in cameras]).to(x.dtype).reshape(len(x), *ones, 3)
    focal = torch.stack([c.K[:2, :2].det().abs().sqrt() for c in cameras]).to(x.dtype).reshape(len(x), *ones)
    return centres, directions, torch.stack(usable), focal


def _meet(across: Tensor, centres: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(point nearest to all rays, information matrix, solvable): sum w (I - d d^T) (X - c) = 0."""
    weighted = weight[..., None, None] * across
    information = weighted.sum(0)
    scale = information.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    normal = information / torch.where(scale > 0, scale, 1.0)
    solvable = torch.linalg.det(normal) > 1e3 * torch.finfo(normal.dtype).eps ** 2
    target = product(weighted, centres[..., None]).sum(0) / torch.where(scale > 0, scale, 1.0)
    eye = torch.eye(3, dtype=across.dtype, device=across.device)
    safe = torch.where(solvable[..., None, None], normal, eye)
    return torch.linalg.solve(safe, target)[..., 0], information, solvable
