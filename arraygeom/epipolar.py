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
    """Compute E = [t]x R (H&Z 9.12)."""
    return product(cross_matrix(beta_from_alpha.t), beta_from_alpha.R)


def fundamental_matrix(
    K_alpha: Float[Tensor, "*b 3 3"], K_beta: Float[Tensor, "*b 3 3"], beta_from_alpha: Pose
) -> Float[Tensor, "*b 3 3"]:
    """Compute F = K_beta^-T E K_alpha^-1 in float64: x_beta^T F x_alpha = 0.

    Along (l1, -l0) of a line l = F x_alpha points are farther away: kornia's sign, unless K_beta mirrors.

    Returns:
        F in the widest type of all, not scaled; zero without a baseline.

    Raises:
        ValueError: for batch axes that do not broadcast.
        RuntimeError: for a singular K.
    """
    E = essential_matrix(beta_from_alpha)
    F = in_float64(lambda E, A, B: torch.linalg.inv(B).mT @ E @ torch.linalg.inv(A), E, K_alpha, K_beta)
    return F * torch.linalg.det(K_beta).sign()[..., None, None]


def shift_origin(F: Float[Tensor, "*b 3 3"], first_pixel: float) -> Float[Tensor, "*b 3 3"]:
    """Convert F from pixels whose first centre is (`first_pixel`, `first_pixel`) to ours: T^T F T.

    MATLAB counts from 1: `shift_origin(F, 1)`.

    Returns:
        F for pixels whose first centre is (0, 0).
    """
    T = torch.eye(3, dtype=F.dtype, device=F.device)
    T[:2, 2] = first_pixel
    return product(product(T.T, F), T)


def epipolar_lines(F: Float[Tensor, "*b 3 3"], x: Real[Tensor, "*n 2"]) -> Float[Tensor, "*m 3"]:
    """Compute the lines l_beta = F x_alpha, scaled so that l . (x, y, 1) is a distance in pixels.

    Returns:
        Lines (*m, 3); all zeros where there is none (or one at infinity): at alpha's epipole, to the rounding
        of x's type, and where F is zero. NaN for NaN pixels.

    Raises:
        ValueError: for pixels without the axes of a batched F: wanted (*b, ..., 2).
    """
    size = F.abs().amax((-2, -1), keepdim=True)
    F = F / torch.where(size > 0, size, 1.0)
    line = map_homogeneous(F, x)
    squared = line[..., 0].square() + line[..., 1].square()
    across = F[..., :2, :].abs().amax(-2, keepdim=True)
    rounding = (
        4 * torch.finfo(line.dtype).eps * map_homogeneous(across.detach(), floating(x).detach().abs())[..., 0]
    )
    positive = squared > rounding.square().clamp(min=SMALLEST_SQUARE)
    scale = torch.where(positive, torch.where(positive, squared, 1.0).rsqrt(), 0.0)
    return line * scale[..., None]


SMALLEST_SQUARE = 1e-30
"""Squared norm of a line's (x, y) part, for F of largest entry 1, below which there is no line."""


def epipoles(F: Float[Tensor, "*b 3 3"]) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """Compute the epipoles of F.

    Returns:
        (e_alpha, e_beta), homogeneous unit vectors of either sign with F e_alpha = 0 and F^T e_beta = 0, or
        least if F is not of rank two; arbitrary for F = 0. Their third entry is 0 at infinity.

    Raises:
        ValueError: for another shape.
        TypeError: for a value that is no floating-point tensor.
        RuntimeError: for NaN or infinity.
    """
    U, _, Vh = torch.linalg.svd(F)
    return Vh[..., 2, :], U[..., :, 2]


def epipolar_distance(
    F: Float[Tensor, "*b 3 3"], x_alpha: Real[Tensor, "*n 2"], x_beta: Real[Tensor, "*n 2"]
) -> Float[Tensor, "*n"]:
    """Compute the signed distance in pixels from x_beta to the line of x_alpha.

    Returns:
        Distances (*n); 0 where there is no line.
    """
    return (epipolar_lines(F, x_alpha) * to_homogeneous(floating(x_beta))).sum(-1)


class Track(NamedTuple):
    """Image of alpha's rays in beta: the homogeneous pixel `a + w b` at inverse depth w in alpha (1/m).

    The third coordinate is z_beta / z_alpha.

    Attributes:
        a: homogeneous pixel of the point at infinity.
        b: change for each unit of inverse depth; broadcasts against `a`, as it is the same for all pixels of
            a pair of pinholes.
    """

    a: Float[Tensor, "*n 3"]
    b: Float[Tensor, "*m 3"]

    def at(self, w: Float[Tensor, "*n"]) -> Float[Tensor, "*n 2"]:
        """Return beta's pixels at inverse depths; finite, without meaning for points not in front of beta."""
        P = self.a + w[..., None] * self.b
        z = P[..., 2:]
        return P[..., :2] / torch.where(z > FRONT, z, 1.0)


def track(
    K_alpha: Float[Tensor, "*b 3 3"],
    K_beta: Float[Tensor, "*b 3 3"],
    beta_from_alpha: Pose,
    x: Real[Tensor, "*n 2"],
) -> Track:
    """Compute the track in beta of each alpha pixel of a pinhole pair.

    Args:
        beta_from_alpha: pose of alpha's frame in beta's.
        x: pixels of alpha; (*b, ..., 2) for a batch.

    Returns:
        The tracks (*n), in the precision of `x`.

    Raises:
        ValueError: for pixels without the axes of a batch.
        RuntimeError: for a singular K_alpha.
    """
    a = map_homogeneous(infinite_homography(K_alpha, K_beta, beta_from_alpha.R), x)
    b = matvec(K_beta, beta_from_alpha.t).to(a.dtype)
    return Track(a, beside(b, a.ndim, trailing=1))


def segments_between(
    track: Track, near: Float[Tensor, "*b"], far: Float[Tensor, "*b"], beta_hw: HW
) -> Segments:
    """Compute the part of each track between two depths and inside beta's image, in closed form (`clipped`).

    Args:
        track: tracks in pixels of beta.
        near: depth in alpha, metres, above 0; not checked.
        far: depth in alpha, metres, at least `near`; may be infinite.
        beta_hw: height and width of beta.

    Returns:
        Segments (*n) from near to far, pixels of beta, also clipped to the front of beta (`FRONT`); zero and
        invalid where nothing is left.
    """
    h, w = beta_hw
    visible = clipped(track, near, far, (-0.5, -0.5, w - 0.5, h - 0.5))
    start, end = (
        _place(visible.P.unbind(-1), visible.D.unbind(-1), s, visible.valid, beta_hw)
        for s in (visible.high, visible.low)
    )
    return Segments(start, end, visible.valid)


class Clipped(NamedTuple):
    """Part of a track: the homogeneous points P + s D, in the track's unit, with s from `low` to `high`.

    Attributes:
        P: points at s = 0 (far).
        D: their change to s = 1 (near).
        low: least s, at least 0.
        high: largest s, at most 1.
        valid: False where nothing is left; `low` and `high` then mean nothing.
    """

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
    """Clip each track to depths, to limits in the image and to the front of beta.

    Args:
        near: depth in alpha, metres; s = 1.
        far: depth in alpha, metres, may be infinite; s = 0. In between s is linear in inverse depth.
        limits: x low, y low, x high, y high, in the unit of the track's points; None for no limits.
        in_front: False to keep points behind beta.

    Returns:
        The clipped tracks.
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
"""Largest inverse depth (1/m): products with a baseline in pixels stay finite."""


def _limited(
    low: Tensor, high: Tensor, valid: Tensor, g: Tensor, slope: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Limit the range [low, high] of s to where g + s slope >= 0; a `slope` is of many pixels."""
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
    """Pixels of P + s D, kept inside the image despite rounding; zero where not valid."""
    s = torch.where(valid, s, 0.0)
    X, Y, Z = (torch.addcmul(p, s, d) for p, d in zip(P, D))
    Z = torch.where(valid, Z, 1.0)
    limits = hw[1] - 0.5, hw[0] - 0.5
    return torch.stack([torch.where(valid, (c / Z).clamp(-0.5, m), 0.0) for c, m in zip((X, Y), limits)], -1)


def beside(v: Tensor, ndim: int, trailing: int = 0) -> Tensor:
    """Add axes of length 1 for pixels to a value of each rig (*b, `trailing` axes), up to `ndim` axes."""
    if v.ndim == trailing:
        return v
    batch = v.ndim - trailing
    return v.reshape(*v.shape[:batch], *[1] * (ndim - v.ndim), *v.shape[batch:])


FRONT = 1e-3
"""Ratio of a point's depths in beta and alpha above which it counts as in front of beta.

A ray that meets beta's centre (alpha's epipole) tends to 0/0 there; at 1e-3 float32 still holds 0.1 px.
"""


class Depth(NamedTuple):
    """Depth of alpha's pixels, metres (the unit of the cameras' poses).

    Attributes:
        depth: z in alpha's frame (from `ray_depth` perhaps the distance along the ray); 0 where not valid.
        deviation: its standard deviation; 0 where not valid, and if that of the pixels was not given.
        valid: True where there is a depth.
    """

    depth: Float[Tensor, "*n"]
    deviation: Float[Tensor, "*n"]
    valid: Bool[Tensor, "*n"]


def depth_from_track(
    track: Track, x: Real[Tensor, "*n 2"], deviation: Float[Tensor, "*n"] | None = None
) -> Depth:
    """Compute the depth in alpha of the point of a track nearest to beta's pixels `x`.

    Args:
        track: track of each alpha pixel.
        x: the pixel of beta for each.
        deviation: standard deviation of x along the track, pixels; None for 0. It is propagated to first
            order, d depth = depth^2 / |dx/dw|.

    Returns:
        Depth with its deviation; invalid where the baseline gives none, it would not be positive and finite,
        the point is not in front of beta (`FRONT`), or x is not finite.
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
