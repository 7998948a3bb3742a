"""Maps between two pictures of one plane (Hartley & Zisserman, chapter 13).

Points are (x, y) in pixels, the centre of the first pixel being (0, 0). The pose is beta from alpha:
X_beta = R X_alpha + t.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor


class MappedPoints(NamedTuple):
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


def apply_homography(H: Float[Tensor, "*b 3 3"], x: Float[Tensor, "*n 2"]) -> MappedPoints:
    """Map points (*n, 2); with batched H (*b), points are (*b, n, 2).

    `valid` where the result is finite and its homogeneous scale is positive. The sign of H matters: `plane_homography` and `infinite_homography` give it such that the scale is
    positive in front of both cameras; a fitted H is fixed only up to sign and has to be oriented first. Where
    not valid, x is zero and so is its gradient.
    """
    homogeneous = x @ H[..., :, :2].mT + H[..., None, :, 2]
    scale = homogeneous[..., 2:]
    positive = scale > torch.finfo(scale.dtype).tiny
    mapped = homogeneous[..., :2] / torch.where(positive, scale, 1.0)
    valid = positive[..., 0] & mapped.isfinite().all(-1)
    return MappedPoints(torch.where(valid[..., None], mapped, 0.0), valid)
