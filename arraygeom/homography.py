"""Maps between two images of one plane (Hartley & Zisserman, chapter 13).

Points are (x, y) in pixels, the centre of the first pixel being (0, 0). The pose is beta from alpha:
X_beta = R X_alpha + t.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .pixels import map_homogeneous, to_homogeneous


class TransformedPoints(NamedTuple):
    """Points after a homography, and which of them exist."""

    x: Float[Tensor, "*n 2"]
    valid: Bool[Tensor, "*n"]


def plane_homography(
    K_alpha: Float[Tensor, "*#b 3 3"],
    K_beta: Float[Tensor, "*#b 3 3"],
    R: Float[Tensor, "*#b 3 3"],
    t: Float[Tensor, "*#b 3"],
    *,
    normal: Float[Tensor, "*#b 3"],
    d: Float[Tensor, "*#b"],
) -> Float[Tensor, "*b 3 3"]:
    """H with x_beta ~ H x_alpha for points of the plane normal^T X + d = 0 in alpha's frame.

    H = K_beta (R - t normal^T / d) K_alpha^-1 (Hartley & Zisserman, equation 13.2). The plane Z = 2 m is
    normal = (0, 0, 1), d = -2. The normal need not have unit length. Scaled as written, H (x_alpha, 1) equals
    (Z_beta / Z_alpha) (x_beta, 1), so its third entry is positive for points in front of both cameras.
    A plane through alpha's centre (d = 0) has no homography: the result is not finite.
    """
    return K_beta @ (R - t[..., :, None] * (normal / d[..., None])[..., None, :]) @ torch.linalg.inv(K_alpha)


def infinite_homography(
    K_alpha: Float[Tensor, "*#b 3 3"], K_beta: Float[Tensor, "*#b 3 3"], R: Float[Tensor, "*#b 3 3"]
) -> Float[Tensor, "*b 3 3"]:
    """H = K_beta R K_alpha^-1: where points at infinite depth go (Hartley & Zisserman, section 13.4)."""
    return K_beta @ R @ torch.linalg.inv(K_alpha)


def apply_homography(H: Float[Tensor, "*b 3 3"], x: Float[Tensor, "*n 2"]) -> TransformedPoints:
    """Map points (*n, 2); with batched H (*b), points are (*b, ..., 2).

    `valid` where the result is finite and its homogeneous scale is positive. The sign of H matters:
    `plane_homography` and `infinite_homography` give it such that the scale is positive in front of both cameras;
    a fitted H is fixed only up to sign and has to be oriented first. Where not valid, x is zero and so is its
    gradient.
    """
    X, Y, scale = map_homogeneous(H, x).unbind(-1)
    valid = (scale > SMALLEST_SCALE) & X.isfinite() & Y.isfinite()
    scale = torch.where(valid, scale, 1.0)
    transformed = [torch.where(valid, c, 0.0) / scale for c in (X, Y)]
    return TransformedPoints(torch.stack(transformed, -1), valid)


SMALLEST_SCALE = 1e-9
"""Homogeneous scales from here on count as positive: for a plane's homography, the ratio of depths."""


def fit_similarity(x: Float[Tensor, "n 2"], y: Float[Tensor, "n 2"]) -> Float[Tensor, "3 3"]:
    """The similarity (rotation, scale, shift) that takes x nearest to y, least squares; n >= 2.

    Umeyama 1991 in two dimensions, in closed form: as complex numbers y = a x + b.
    """
    x_mean, y_mean = x.mean(0), y.mean(0)
    u, v = x - x_mean, y - y_mean
    squared = u.square().sum()
    a = (u * v).sum() / squared
    b = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / squared
    linear = torch.stack([torch.stack([a, -b]), torch.stack([b, a])])
    return _affine(linear, y_mean - linear @ x_mean)


def fit_homography(x: Float[Tensor, "n 2"], y: Float[Tensor, "n 2"], *, steps: int = 10) -> Float[Tensor, "3 3"]:
    """The homography that takes x nearest to y, least squares in the pixels of y; n >= 4.

    Gauss-Newton from the affine fit, on points centred and scaled (Hartley & Zisserman, section 4.4); oriented
    so that the scale is positive at the points. Differentiable, through the steps.
    """
    A, B = _normalising(x), _normalising(y)
    u, v = x @ A[:2, :2].T + A[:2, 2], y @ B[:2, :2].T + B[:2, 2]
    u1 = to_homogeneous(u)
    H = torch.cat([torch.linalg.lstsq(u1, v).solution.T, u.new_tensor([[0.0, 0.0, 1.0]])])
    for _ in range(steps):
        w = u1 @ H[2]
        transformed = (u1 @ H[:2].T) / w[:, None]
        p = u1 / w[:, None]
        zero = torch.zeros_like(p)
        slopes = [
            torch.cat([*block, -m * p[:, :2]], -1)
            for block, m in (([p, zero], transformed[:, :1]), ([zero, p], transformed[:, 1:]))
        ]
        J, residual = torch.cat(slopes), (v - transformed).T.reshape(-1)
        step = torch.linalg.solve(J.T @ J + 1e-12 * torch.eye(8).to(J), J.T @ residual)
        H = H + torch.nn.functional.pad(step, (0, 1)).reshape(3, 3)
    return torch.linalg.inv(B) @ H @ A


def _normalising(x: Tensor) -> Tensor:
    """The similarity that centres points and scales them to unit deviation; a constant of the fit."""
    mean = x.detach().mean(0)
    deviation = (x.detach() - mean).square().mean().sqrt().clamp(min=1e-6)
    return _affine(torch.eye(2).to(x) / deviation, -mean / deviation)


def _affine(linear: Tensor, shift: Tensor) -> Tensor:
    top = torch.cat([linear, shift[:, None]], 1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 1.0]])])
