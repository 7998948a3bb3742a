"""Relative pose of two cameras from F or E."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .epipolar import depth_from_track, track
from .pose import Pose, in_float64, nearest_rotation


def poses_from_essential(E: Float[Tensor, "*b 3 3"]) -> Pose:
    """Decompose E into its four poses (H&Z 9.14), |t| = 1: both rotations with t, then with -t.

    Kornia's decomposition without a singular value decomposition (Horn 1990): differentiable, where E's two
    equal singular values give SVD no gradient. Where noise makes them differ, the rotations are those nearest
    to Horn's matrices, which the SVD gives too.

    Returns:
        `beta_from_alpha`, a batch (*b, 4).

    Raises:
        ValueError: if any E of the batch is zero, of rank one (or nearly), or not finite.
    """
    from kornia.geometry.epipolar import decompose_essential_matrix_no_svd

    R1, R2, t = (
        factor.reshape(*E.shape[:-2], *factor.shape[1:]) for factor in decompose_essential_matrix_no_svd(E)
    )
    R, t = torch.stack([R1, R2, R1, R2], -3), t[..., 0]
    for _ in range(STEPS):
        R = nearest_rotation(R)
    return Pose(R, torch.stack([t, t, -t, -t], -2))


STEPS = 16
"""Steps to the nearest rotation, enough where E's singular values differ a hundredfold."""


class TwoViewPose(NamedTuple):
    """Relative pose from two views.

    Attributes:
        beta_from_alpha: pose (*b), |t| = 1.
        in_front: True for matches that this pose puts in front of both cameras.
    """

    beta_from_alpha: Pose
    in_front: Bool[Tensor, "*b n"]


def relative_pose(
    F: Float[Tensor, "*b 3 3"],
    K_alpha: Float[Tensor, "*b 3 3"],
    K_beta: Float[Tensor, "*b 3 3"],
    x: Real[Tensor, "*b n 2"],
    x_beta: Real[Tensor, "*b n 2"],
) -> TwoViewPose:
    """Return the pose of F that puts most matches in front of both pinhole cameras.

    F is used as given, noise included; E = K_beta^T F K_alpha is F itself for normalised points. Undistort
    matches through lenses first (`LensView.undistort`).

    Args:
        x: matches in alpha, pixels; with the axes *b of F.
        x_beta: matches in beta, pixels; NaN counts as not in front.

    Returns:
        The pose; the baseline has length 1. `in_front` is all False if no pose has any match in front.

    Raises:
        ValueError: for no matches, unequal numbers of them, and as `poses_from_essential`, as for F = 0.
    """
    if x.shape != x_beta.shape or not x.numel():
        raise ValueError(
            f"wanted matches (n, 2) in both images, got {tuple(x.shape)} and {tuple(x_beta.shape)}"
        )
    from kornia.geometry.epipolar import essential_from_fundamental

    poses = poses_from_essential(in_float64(essential_from_fundamental, F, K_alpha, K_beta))
    K_alpha, K_beta = (K[..., None, :, :].expand_as(poses.R) for K in (K_alpha, K_beta))
    tracks = track(K_alpha, K_beta, poses, x[..., None, :, :])
    in_front = depth_from_track(tracks, x_beta[..., None, :, :]).valid
    best = in_front.sum(-1).argmax(-1, keepdim=True)
    axis = best.ndim - 1
    R, t, in_front = (
        candidates.take_along_dim(
            best.reshape(*best.shape, *[1] * (candidates.ndim - best.ndim)), axis
        ).squeeze(axis)
        for candidates in (poses.R, poses.t, in_front)
    )
    return TwoViewPose(Pose(R, t), in_front)
