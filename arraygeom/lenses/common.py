"""Shared parts of lens models: bounds of validity, and small functions that are smooth on the
optical axis."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

from ..pixels import floating
from ..runtime.tracing import followed

# The range of validity ends this fraction (of the squared radius) inside the turn, where the inverse is still
# good to 1e-6 px in float64.
MARGIN = 1e-6
# Nothing past this normalised radius is valid under Brown-Conrady: 89.94 degrees off axis.
WIDEST = 1e3
# A denominator of the rational model this close (in squared radius) to its zero gives radii that mean
# nothing.
POLE = 0.9
# How far beyond the limit the search for an inverse may pass (in squared radius); short of a pole.
BEYOND = 1.1
# Squared radii are at least this in divisions, for lenses that are valid nowhere.
TINY = 1e-30
# An inverse counts as found from this residual on, in units of rounding.
SOLVED = 64


def angle_over_radius(u: Tensor, z: Tensor) -> Tensor:
    """Compute the ratio of a direction's angle off axis theta (radians) to its radius r, by a series near the
    axis.

    Args:
        u: squared radius r^2 = x^2 + y^2 (*n) of directions of any length.
        z: depth along the axis (*n).

    Returns:
        theta / r (*n); on the axis 1 / z ahead, and a finite number without meaning behind.
    """
    near = (z > 0) & (u < 1e-3 * z.square())
    z_near = torch.where(near, z, 1.0)
    t = torch.where(near, u, 0.0) / z_near.square()
    series = (1 - t * (1 / 3 - t * (1 / 5 - t * (1 / 7 - t * (1 / 9 - t / 11))))) / z_near
    plain = ~near & (u > 0)
    r = torch.where(plain, u, 1.0).sqrt()
    return torch.where(near, series, torch.atan2(r, torch.where(plain, z, 1.0)) / r)


def cosine_and_sinc(v: Tensor) -> tuple[Tensor, Tensor]:
    """Compute cos(theta) and sin(theta) / theta from the squared angle v = theta^2 (*n), by series near 0."""
    near = v < 1e-3
    s, theta = torch.where(near, v, 0.0), torch.where(near, 1.0, v).sqrt()
    cosine = 1 - s * (1 / 2 - s * (1 / 24 - s * (1 / 720 - s / 40320)))
    sinc = 1 - s * (1 / 6 - s * (1 / 120 - s * (1 / 5040 - s / 362880)))
    return torch.where(near, cosine, theta.cos()), torch.where(near, sinc, theta.sin() / theta)


def within_limit(squared: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    """Compare squared radii (*n) with limits that broadcast to them.

    Returns:
        True (*n) below the limit, and the factor (*n) that moves points in to it, 1 for those below.
    """
    inside = squared < limit
    return inside, torch.where(
        inside, 1.0, (limit / torch.where(inside, 1.0, squared.clamp(min=TINY))).sqrt()
    )


def polynomial_product(a: tuple[Tensor, ...], b: tuple[Tensor, ...]) -> list[Tensor]:
    """Multiply two polynomials, given by their coefficients from the constant up."""
    terms: list[Tensor] = [torch.zeros_like(a[0])] * (len(a) + len(b) - 1)
    for i, a_i in enumerate(a):
        for j, b_j in enumerate(b):
            terms[i + j] = terms[i + j] + a_i * b_j
    return terms


@torch.no_grad()
def once(bound: Callable[[Tensor], Tensor], c: Tensor) -> Tensor:
    """Compute a bound of lenses, such as `brown_limit`, once for the copies of one lens that `expand` makes.

    The bound is cached for recent lenses on the CPU, unless torch has to see its computation.

    Args:
        bound: function from coefficients (*b, n) to bounds (*b).
        c: coefficients (*b, n).

    Returns:
        Bounds (*b), without gradient; perhaps the cached tensor itself: not to be changed in place.
    """
    if c.ndim > 1 and len(c) > 1 and c.stride(0) == 0:
        return once(bound, c[:1]).expand(c.shape[:-1])
    if followed() or torch.is_inference_mode_enabled() or c.device.type != "cpu" or not c.numel():
        return bound(c)
    return _remembered(bound, c.dtype, c.shape, c.detach().contiguous().view(torch.uint8).numpy().tobytes())


@lru_cache(maxsize=256)
def _remembered(
    bound: Callable[[Tensor], Tensor], dtype: torch.dtype, shape: torch.Size, content: bytes
) -> Tensor:
    return bound(torch.frombuffer(bytearray(content), dtype=dtype).reshape(shape))


def unit(ray: Tensor) -> Tensor:
    """Scale vectors (*n, k) to length 1; NaN for zero vectors."""
    return ray / norm(ray)[..., None]


def on_plane(X: Tensor) -> tuple[Tensor, Tensor]:
    """Compute points (*n, 2) of rays (*n, 3) on the plane z = 1, and True for rays ahead (z > 0)."""
    ahead = X[..., 2] > 0
    return X[..., :2] / torch.where(ahead, X[..., 2], 1.0)[..., None], ahead


def norm(xy: Tensor) -> Tensor:
    """Compute the lengths (*n) of vectors (*n, k)."""
    return xy.square().sum(-1).sqrt()


def finite_points(points: Tensor) -> tuple[Tensor, Tensor]:
    """Replace points (*n, k) with NaN or infinity by the origin.

    Huge float32 points are brought nearer along their direction, as their squares would be infinite.

    Returns:
        The points in float32 or float64 (integers and half precision in float32), and True (*n) for those
        that were finite.

    Raises:
        TypeError: for points that are no tensor.
    """
    points = floating(points)
    finite = points.isfinite().all(-1)
    points = torch.where(finite[..., None], points, 0.0)
    if points.dtype == torch.float64:
        return points, finite
    size = points.detach().abs().amax(-1, keepdim=True).clamp(min=HUGE)
    return points * (HUGE / size), finite


HUGE = 1e9
"""Largest float32 coordinate: its fourth power is finite, and a direction so far off axis is at 90 degrees to
rounding."""
