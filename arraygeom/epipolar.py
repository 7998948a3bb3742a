"""Two-view geometry: F, E, epipoles, lines, and segments bounded by depth.

Hartley & Zisserman, Multiple View Geometry, 2nd ed., chapter 9. Alpha is the first view, beta the second:
x_beta^T F x_alpha = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .homography import infinite_homography
from .pixels import HW, floating, map_homogeneous, product, to_homogeneous
from .pose import Pose, cross_matrix, in_float64, matvec
from .runtime.tracing import traced
from .segments import FLAT, Segments


def essential_matrix(beta_from_alpha: Pose) -> Float[Tensor, "*b 3 3"]:
    """E = [t]x R (H&Z 9.12)."""
    return product(cross_matrix(beta_from_alpha.t), beta_from_alpha.R)


def fundamental_matrix(
    K_alpha: Float[Tensor, "*b 3 3"], K_beta: Float[Tensor, "*b 3 3"], beta_from_alpha: Pose
) -> Float[Tensor, "*b 3 3"]:
    """F = K_beta^-T E K_alpha^-1, so that x_beta^T F x_alpha = 0: kornia's, in float64.

    Along (l1, -l0) of a line l points are farther away: the sign is kornia's unless K_beta mirrors.
    """
    from kornia.geometry.epipolar import fundamental_from_essential

    F = in_float64(fundamental_from_essential, essential_matrix(beta_from_alpha), K_alpha, K_beta)
    return F * torch.linalg.det(K_beta).sign()[..., None, None]


def shift_origin(F: Float[Tensor, "*b 3 3"], first_pixel: float) -> Float[Tensor, "*b 3 3"]:
    """F given in pixels whose first centre is (`first_pixel`, `first_pixel`), in ours: T^T F T.

    MATLAB counts from 1: `shift_origin(F, 1)`.
    """
    T = torch.eye(3, dtype=F.dtype, device=F.device)
    T[:2, 2] = first_pixel
    return product(product(T.T, F), T)


def epipolar_lines(F: Float[Tensor, "*b 3 3"], x: Real[Tensor, "*n 2"]) -> Float[Tensor, "*m 3"]:
    """l_beta = F x_alpha, scaled so that l . (x, y, 1) is a distance in pixels.

    At alpha's epipole, to the rounding of x's type, and where F is zero, there is no line: all zeros. Batched
    F as in `map_homogeneous`.
    """
    size = F.abs().amax((-2, -1), keepdim=True)
    line = map_homogeneous(F / torch.where(size > 0, size, 1.0), x)
    squared = line[..., 0].square() + line[..., 1].square()
    across = (F / torch.where(size > 0, size, 1.0))[..., :2, :].abs().amax(-2, keepdim=True)
    rounding = (
        4 * torch.finfo(line.dtype).eps * map_homogeneous(across.detach(), floating(x).detach().abs())[..., 0]
    )
    positive = squared > rounding.square().clamp(min=SMALLEST_SQUARE)
    scale = torch.where(positive, torch.where(positive, squared, 1.0).rsqrt(), 0.0)
    return line * scale[..., None]


SMALLEST_SQUARE = 1e-30
"""A line F x is none if its (x, y) part, squared, F's largest entry being 1, is smaller than this."""


def epipoles(F: Float[Tensor, "*b 3 3"]) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """(e_alpha, e_beta), homogeneous unit vectors with F e_alpha = 0 and F^T e_beta = 0."""
    U, _, Vh = torch.linalg.svd(F)
    return Vh[..., 2, :], U[..., :, 2]


def epipolar_distance(
    F: Float[Tensor, "*b 3 3"], x_alpha: Real[Tensor, "*n 2"], x_beta: Real[Tensor, "*n 2"]
) -> Float[Tensor, "*n"]:
    """Signed distance in pixels from x_beta to the line of x_alpha."""
    return (epipolar_lines(F, x_alpha) * to_homogeneous(floating(x_beta))).sum(-1)


class Track(NamedTuple):
    """What beta sees of alpha's rays: the homogeneous pixel `a + w b` at inverse depth w in alpha (1/m).

    `a` (*n, 3) is where the point at infinity would be; `b`, which broadcasts against it, is the same for all
    pixels of a pair of pinholes. The third coordinate is z_beta / z_alpha.
    """

    a: Float[Tensor, "*n 3"]
    b: Float[Tensor, "*m 3"]

    def at(self, w: Float[Tensor, "*n"]) -> Float[Tensor, "*n 2"]:
        """Beta's pixels at inverse depths; where a point is not in front of beta the value is only finite."""
        P = self.a + w[..., None] * self.b
        z = P[..., 2:]
        return P[..., :2] / torch.where(z > FRONT, z, 1.0)


def track(
    K_alpha: Float[Tensor, "*b 3 3"],
    K_beta: Float[Tensor, "*b 3 3"],
    beta_from_alpha: Pose,
    x: Real[Tensor, "*n 2"],
) -> Track:
    """The track in beta of each alpha pixel. Batched rigs (*b, 3, 3) take pixels (*b, ..., 2).

    Matrices are composed in their own precision, pixels computed in that of `x`.
    """
    a = map_homogeneous(infinite_homography(K_alpha, K_beta, beta_from_alpha.R), x)
    b = matvec(K_beta, beta_from_alpha.t).to(a.dtype)
    return Track(a, beside(b, a.ndim, trailing=1))


def segments_between(
    track: Track, near: Float[Tensor, "*b"], far: Float[Tensor, "*b"], beta_hw: HW
) -> Segments:
    """The part of each track between depths `near` and `far` (metres; far may be inf) inside beta's image.

    Clipped to the image's area and to the front of beta, in closed form (`clipped`).
    """
    h, w = beta_hw
    visible = clipped(track, near, far, (-0.5, -0.5, w - 0.5, h - 0.5))
    start, end = (
        _place(visible.P.unbind(-1), visible.D.unbind(-1), s, visible.valid, beta_hw)
        for s in (visible.high, visible.low)
    )
    return Segments(start, end, visible.valid)


class Clipped(NamedTuple):
    """The homogeneous points P + s D of a track, with s from `low` (towards far) to `high` (towards near)."""

    P: Float[Tensor, "*n 3"]
    D: Float[Tensor, "*m 3"]
    low: Float[Tensor, "*n"]
    high: Float[Tensor, "*n"]
    valid: Bool[Tensor, "*n"]


def clipped(
    track: Track,
    near: Float[Tensor, "*b"],
    far: Float[Tensor, "*b"],
    limits: Sequence[float | Tensor] | None,
    *,
    in_front: bool = True,
) -> Clipped:
    """The part of each track in `limits` (x low, y low, x high, y high; None: everywhere), in front of beta.

    With s going from 0 at far to 1 at near in proportion to inverse depth, every limit is linear in s with a
    slope that is one number for the whole image.
    """
    a, b = track
    w_far, w_near = (beside((1 / d.to(a.dtype)).clamp(max=HIGHEST), a.ndim - 1) for d in (far, near))
    P, D = a + w_far[..., None] * b, (w_near - w_far)[..., None] * b
    (X, Y, Z), (DX, DY, DZ) = P.unbind(-1), D.unbind(-1)
    low, high = torch.zeros_like(X), torch.ones_like(X)
    valid = torch.ones_like(X, dtype=torch.bool)
    bounds = []
    if limits is not None:
        left, top, right, bottom = limits
        bounds += [(X - left * Z, DX - left * DZ), (right * Z - X, right * DZ - DX)]
        bounds += [(Y - top * Z, DY - top * DZ), (bottom * Z - Y, bottom * DZ - DY)]
    for g, slope in (*bounds, *([(Z - FRONT, DZ)] if in_front else [])):
        low, high, valid = _limited(low, high, valid, g, slope)
    return Clipped(P, D, low, high, valid & (low <= high))


HIGHEST = 1e30
"""Inverse depths (1/m) count as no more than this: their products with a baseline in pixels stay finite."""


def _limited(
    low: Tensor, high: Tensor, valid: Tensor, g: Tensor, slope: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The range of s within [low, high] where g + s slope >= 0; `slope` holds one number for many pixels."""
    rising, falling = slope > FLAT, slope < -FLAT
    flat = ~(rising | falling)
    crossing = g * (-1 / torch.where(flat, 1.0, slope))
    every = traced()
    if every or bool(rising.any()):
        low = torch.maximum(low, torch.where(rising, crossing, 0.0))
    if every or bool(falling.any()):
        high = torch.minimum(high, torch.where(falling, crossing, 1.0))
    if every or bool(flat.any()):
        valid = valid & ((g >= 0) | ~flat)
    return low, high, valid


def _place(P: tuple[Tensor, ...], D: tuple[Tensor, ...], s: Tensor, valid: Tensor, hw: HW) -> Tensor:
    """The pixels of P + s D, kept from leaving the image by rounding; zero where not valid."""
    s = torch.where(valid, s, 0.0)
    X, Y, Z = (torch.addcmul(p, s, d) for p, d in zip(P, D))
    Z = torch.where(valid, Z, 1.0)
    limits = hw[1] - 0.5, hw[0] - 0.5
    return torch.stack([torch.where(valid, (c / Z).clamp(-0.5, m), 0.0) for c, m in zip((X, Y), limits)], -1)


def beside(v: Tensor, ndim: int, trailing: int = 0) -> Tensor:
    """A value for each rig of a batch (*b, `trailing` axes), 1-long axes for its pixels: `ndim` axes."""
    if v.ndim == trailing:
        return v
    batch = v.ndim - trailing
    return v.reshape(*v.shape[:batch], *[1] * (ndim - v.ndim), *v.shape[batch:])


FRONT = 1e-3
"""A point counts as in front of beta from this ratio of its depths in beta and alpha on.

A ray that meets beta's centre (alpha's epipole) tends to 0/0 there; at 1e-3 float32 still holds 0.1 px.
"""


class Depth(NamedTuple):
    """Depth z in alpha (metres), its standard deviation, and validity."""

    depth: Float[Tensor, "*n"]
    deviation: Float[Tensor, "*n"]
    valid: Bool[Tensor, "*n"]


def depth_from_track(
    track: Track, x: Real[Tensor, "*n 2"], deviation: Float[Tensor, "*n"] | None = None
) -> Depth:
    """Depth in alpha of the point of a track nearest to beta's pixels `x`.

    `deviation` is the standard deviation of x along the track in pixels (default 0); the depth's is
    propagated to first order, d depth = depth^2 / |dx/dw|. Invalid where the baseline gives no depth, or
    where the depth is not positive or the point not in front of beta.
    """
    a, b = track
    x = floating(x)
    finite = x.isfinite().all(-1)
    x = torch.where(finite[..., None], x, 0.0)
    # faster than axes of length 2
    (X, Y, Z), (DX, DY, DZ), (column, row) = a.unbind(-1), b.unbind(-1), x.unbind(-1)
    along_x, along_y = DX * Z - X * DZ, DY * Z - Y * DZ
    slope = (DX - column * DZ) * along_x + (DY - row * DZ) * along_y
    size = (DX.square() + DY.square()) * Z.square() + (X.square() + Y.square()) * DZ.square()
    moves = slope.abs() > FLAT * FLAT * size  # in proportion to the baseline: in any unit of length
    w = ((column * Z - X) * along_x + (row * Z - Y) * along_y) / torch.where(moves, slope, 1.0)
    z_ratio = Z + w * DZ
    valid = finite & moves & (w > 0) & (z_ratio > FRONT)
    depth = torch.where(valid, 1 / torch.where(valid, w, 1.0), 0.0)
    if deviation is None:
        return Depth(depth, torch.zeros_like(w), valid)
    length = torch.where(valid, along_x.square() + along_y.square(), 1.0).sqrt()
    pixels_per_w = torch.where(valid, slope.abs() / (length * torch.where(valid, z_ratio, 1.0)), 1.0)
    return Depth(depth, torch.where(valid, deviation / pixels_per_w, 0.0) * depth.square(), valid)
