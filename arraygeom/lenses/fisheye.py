"""Kannala-Brandt model: an odd polynomial of the angle off axis, and its inverse."""

from __future__ import annotations

from math import pi

import torch
from torch import Tensor

from ..roots import first_root, invert_increasing
from .common import MARGIN, SOLVED, angle_over_radius, cosine_and_sinc, once, unit, within_limit


def fisheye_project(c: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    """Project points (*n, 3) of the camera's frame, in any unit, by the Kannala-Brandt fisheye.

    Args:
        c: coefficients k1 to k4 (*b, 1.., 4), with an axis of length 1 for each further one of the points.

    Returns:
        Distorted normalised points (*n, 2), and True (*n) up to the angle off axis of `fisheye_limit`; points
        further off give a point at that angle. (0, 0, 0) and points straight behind are not valid, and give
        (0, 0). NaN stays NaN.
    """
    xy, z = X[..., :2], X[..., 2]
    u = xy.square().sum(-1)
    ratio = angle_over_radius(u, z)
    v = u * ratio.square()
    limit = once(fisheye_limit, c).to(v)
    inside, pull = within_limit(v, limit)
    p, _ = _fisheye_factor(c, torch.where(inside, v, limit))
    return xy * (ratio * pull * p)[..., None], inside & ((u > 0) | (z > 0))


def fisheye_unproject(c: Tensor, xy_d: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the unit directions of distorted normalised points (*n, 2): the inverse of `fisheye_project`.

    Solves v p(v)^2 = |xy_d|^2 for the squared angle v, smooth on the axis too.

    Args:
        c: coefficients k1 to k4 (*b, 1.., 4), as in `fisheye_project`.

    Returns:
        Directions (*n, 3) in the camera's frame, and True (*n) up to the radius that `fisheye_limit` has in
        the image; points further out give the direction at that radius. NaN is not looked for.
    """
    limit = once(fisheye_limit, c).to(xy_d)
    u_d = xy_d.square().sum(-1)
    outermost = limit * _fisheye_factor(c, limit)[0].square()
    inside, pull = within_limit(u_d, outermost)
    xy_d = xy_d * pull[..., None]
    u_d = torch.where(inside, u_d, outermost)
    start = _traced_fisheye_start if torch.compiler.is_compiling() else _fisheye_start
    v = start(c.detach(), u_d.detach(), limit)
    for _ in range(2):
        p, slope = _fisheye_factor(c, v)
        v = v - (v * p.square() - u_d) / (p * slope)
    p, _ = _fisheye_factor(c, v)
    inside = inside & ((v * p.square() - u_d).abs() <= SOLVED * torch.finfo(u_d.dtype).eps * (1 + u_d))
    cosine, sinc = cosine_and_sinc(v)
    return unit(torch.cat([xy_d * (sinc / p)[..., None], cosine[..., None]], -1)), inside


@torch.no_grad()
def _fisheye_start(c: Tensor, u_d: Tensor, limit: Tensor) -> Tensor:
    def radius(theta: Tensor) -> tuple[Tensor, Tensor]:
        p, slope = _fisheye_factor(c, theta.square())
        return theta * p, slope

    return invert_increasing(radius, u_d.sqrt(), limit.sqrt().expand_as(u_d)).square()


@torch.library.custom_op(
    "arraygeom::fisheye_start", mutates_args=(), schema="(Tensor c, Tensor u_d, Tensor limit) -> Tensor"
)
def _traced_fisheye_start(c: Tensor, u_d: Tensor, limit: Tensor) -> Tensor:
    """Start for torch.compile, which cannot follow iterations whose number depends on values."""
    return _fisheye_start(c, u_d, limit).contiguous()


@_traced_fisheye_start.register_fake
def _(c: Tensor, u_d: Tensor, limit: Tensor) -> Tensor:
    return torch.empty_like(u_d, memory_format=torch.contiguous_format)


def _fisheye_factor(c: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Ratio p = theta_d / theta and slope d theta_d / d theta of the squared angle v."""
    k1, k2, k3, k4 = c.unbind(-1)
    p = 1 + v * (k1 + v * (k2 + v * (k3 + v * k4)))
    return p, 1 + v * (3 * k1 + v * (5 * k2 + v * (7 * k3 + v * 9 * k4)))


@torch.no_grad()
def fisheye_limit(c: Tensor) -> Tensor:
    """Compute the squared angle up to which the radius rises, at most pi^2: (*b, 1..), float64 on the CPU."""
    odd = torch.tensor([3.0, 5.0, 7.0, 9.0], dtype=torch.float64)
    slope = torch.cat([torch.ones_like(c[..., :1]).to(odd), c.detach().to(odd) * odd], -1)
    return first_root(slope).clamp_max(pi**2) * (1 - MARGIN)
