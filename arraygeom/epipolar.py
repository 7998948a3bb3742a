"""Two-view geometry: F, E, epipoles, lines, and segments bounded by depth.

Hartley & Zisserman, Multiple View Geometry, 2nd ed., chapter 9. Alpha is the first view, beta the second:
x_beta^T F x_alpha = 0.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from kornia.geometry.epipolar import cross_product_matrix
from kornia.geometry.epipolar import fundamental_from_essential as _fundamental_from_essential
from torch import Tensor

from .pixels import HW, to_homogeneous
from .pose import Pose, matvec
from .segments import Segments


def essential_matrix(beta_from_alpha: Pose) -> Float[Tensor, "*b 3 3"]:
    """E = [t]x R (H&Z 9.12)."""
    return cross_product_matrix(beta_from_alpha.t) @ beta_from_alpha.R


def fundamental_matrix(
    K_alpha: Float[Tensor, "*b 3 3"], K_beta: Float[Tensor, "*b 3 3"], beta_from_alpha: Pose
) -> Float[Tensor, "*b 3 3"]:
    """F = K_beta^-T E K_alpha^-1, so that x_beta^T F x_alpha = 0."""
    return _fundamental_from_essential(essential_matrix(beta_from_alpha), K_alpha, K_beta)


def shift_origin(F: Float[Tensor, "*b 3 3"], first_pixel: float) -> Float[Tensor, "*b 3 3"]:
    """F given in pixels whose first centre is (`first_pixel`, `first_pixel`), in ours: T^T F T.

    MATLAB counts from 1: `shift_origin(F, 1)`.
    """
    T = torch.eye(3, dtype=F.dtype, device=F.device)
    T[:2, 2] = first_pixel
    return T.T @ F @ T


def epipolar_lines(F: Float[Tensor, "*b 3 3"], x: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 3"]:
    """l_beta = F x_alpha, scaled so that l . (x, y, 1) is a distance in pixels.

    At alpha's epipole there is no line: all zeros.
    """
    line = to_homogeneous(x) @ F.transpose(-1, -2)
    squared = line[..., :2].square().sum(-1, keepdim=True)
    positive = squared > 0
    return torch.where(positive, line / torch.where(positive, squared, 1.0).sqrt(), 0.0)


def epipoles(F: Float[Tensor, "*b 3 3"]) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """(e_alpha, e_beta), homogeneous unit vectors with F e_alpha = 0 and F^T e_beta = 0."""
    U, _, Vh = torch.linalg.svd(F)
    return Vh[..., 2, :], U[..., :, 2]


def epipolar_distance(
    F: Float[Tensor, "*b 3 3"], x_alpha: Float[Tensor, "*n 2"], x_beta: Float[Tensor, "*n 2"]
) -> Float[Tensor, "*n"]:
    """Signed distance in pixels from x_beta to the line of x_alpha."""
    return (epipolar_lines(F, x_alpha) * to_homogeneous(x_beta)).sum(-1)


class Track(NamedTuple):
    """What beta sees of alpha's rays: the homogeneous pixel `a + w b` at inverse depth w in alpha (1/m).

    `a` (*n, 3) is where the point at infinity would be; `b` (3) is the same for all pixels of a pair of
    pinholes. The third coordinate is z_beta / z_alpha.
    """

    a: Float[Tensor, "*n 3"]
    b: Float[Tensor, "*b 3"]

    def at(self, w: Float[Tensor, "*n"]) -> Float[Tensor, "*n 2"]:
        """Beta's pixels at inverse depths; where the point is not in front of beta the value is finite only."""
        P = self.a + w[..., None] * self.b
        z = P[..., 2:]
        return P[..., :2] / torch.where(z > 0, z, 1.0)


def track(
    K_alpha: Float[Tensor, "*b 3 3"],
    K_beta: Float[Tensor, "*b 3 3"],
    beta_from_alpha: Pose,
    x: Float[Tensor, "*n 2"],
) -> Track:
    """The track in beta of each alpha pixel. Batched rigs (*b, 3, 3) take pixels (*b, n, 2).

    Matrices are composed in their own precision, pixels computed in that of `x`.
    """
    A = K_beta @ beta_from_alpha.R @ torch.linalg.inv(K_alpha)
    b = matvec(K_beta, beta_from_alpha.t)
    if b.ndim > 1:
        b = b[..., None, :]
    return Track(to_homogeneous(x) @ A.to(x.dtype).transpose(-1, -2), b.to(x.dtype))


def segments_between(track: Track, near: Float[Tensor, "*b"], far: Float[Tensor, "*b"], beta_hw: HW) -> Segments:
    """The part of each track between the depths `near` and `far` (metres; far may be inf) inside beta's picture.

    Clipped to the picture's area and to the front of beta, in closed form: along a track every limit is
    linear in inverse depth.
    """
    w_far, w_near = (1 / d.to(track.a.dtype) for d in (far, near))
    if w_far.ndim:
        w_far, w_near = w_far[..., None], w_near[..., None]
    return clip_track(track, w_near, w_far, beta_hw)


def clip_track(track: Track, w_start: Float[Tensor, "*m"], w_end: Float[Tensor, "*k"], beta_hw: HW) -> Segments:
    """The part of each track between two parameters, w_end <= w_start, that lies inside beta's picture."""
    a, b = track
    h, w = beta_hw
    low, high = w_end, w_start
    possible = torch.ones_like(a[..., 0], dtype=torch.bool)
    for g, slope in (
        (a[..., 0] + 0.5 * a[..., 2], b[..., 0] + 0.5 * b[..., 2]),
        ((w - 0.5) * a[..., 2] - a[..., 0], (w - 0.5) * b[..., 2] - b[..., 0]),
        (a[..., 1] + 0.5 * a[..., 2], b[..., 1] + 0.5 * b[..., 2]),
        ((h - 0.5) * a[..., 2] - a[..., 1], (h - 0.5) * b[..., 2] - b[..., 1]),
        (a[..., 2] - FRONT, b[..., 2]),
    ):
        crossing = -g / torch.where(slope == 0, 1.0, slope)
        low = torch.where(slope > 0, torch.maximum(low, crossing), low)
        high = torch.where(slope < 0, torch.minimum(high, crossing), high)
        inside = (slope != 0) | (g >= 0)
        possible = possible & inside
    valid = possible & (low <= high)
    high, low = (torch.where(valid, v, 0.0) for v in (high, low))
    start, end = (torch.where(valid[..., None], track.at(v), 0.0) for v in (high, low))
    return Segments(start, end, valid)


FRONT = 1e-6
"""A point counts as in front of beta from this ratio of its depths in beta and alpha on."""


class Depth(NamedTuple):
    """Depth z in alpha (metres), its standard deviation, and validity."""

    depth: Float[Tensor, "*n"]
    deviation: Float[Tensor, "*n"]
    valid: Bool[Tensor, "*n"]


def depth_from_track(track: Track, x: Float[Tensor, "*n 2"], deviation: Float[Tensor, "*n"] | None = None) -> Depth:
    """Depth in alpha at which a track passes nearest to beta's pixels `x`, least squares (H&Z 12.2).

    `deviation` is the standard deviation of x along the track in pixels (default 0); the depth's is
    propagated to first order. Invalid where the baseline gives no depth or the depth is not positive.
    """
    a, b = track
    c = a[..., :2] - x * a[..., 2:]
    e = b[..., :2] - x * b[..., 2:]
    squared = e.square().sum(-1)
    w = -(c * e).sum(-1) / torch.where(squared > 0, squared, 1.0)
    valid = (squared > 0) & (w > 0)
    z_ratio = a[..., 2] + w * b[..., 2]
    depth = torch.where(valid, 1 / torch.where(valid, w, 1.0), 0.0)
    pixels_per_w = squared.clamp(min=torch.finfo(w.dtype).tiny).sqrt() / z_ratio.abs().clamp(min=FRONT)
    sigma = torch.zeros_like(w) if deviation is None else deviation
    return Depth(depth, torch.where(valid, sigma / pixels_per_w * depth.square(), 0.0), valid)
