"""From F or E back to the pose between two cameras."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .epipolar import depth_from_track, track
from .pose import Pose, in_float64, nearest_rotation


def poses_from_essential(E: Float[Tensor, "*b 3 3"]) -> Pose:
    """The four poses (*b, 4) that E allows (H&Z 9.14), |t| = 1: both rotations with t, then with -t.

    Kornia's decomposition without a singular value decomposition (Horn 1990): differentiable, where E's two
    equal singular values give SVD no gradient. Where noise makes them differ, the rotations are those nearest
    to Horn's matrices, which are those of the SVD.
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
"""To the nearest rotation, enough where E's singular values differ a hundredfold."""


class TwoViewPose(NamedTuple):
    """`beta_from_alpha` with |t| = 1, and which matches it has in front of both cameras."""

    beta_from_alpha: Pose
    in_front: Bool[Tensor, "*b n"]


def relative_pose(
    F: Float[Tensor, "*b 3 3"],
    K_alpha: Float[Tensor, "*b 3 3"],
    K_beta: Float[Tensor, "*b 3 3"],
    x: Real[Tensor, "*b n 2"],
    x_beta: Real[Tensor, "*b n 2"],
) -> TwoViewPose:
    """The pose that F of two pinholes allows and that has most of the matches in front of both cameras.

    Scale is not known: the baseline has length 1. F is as it is given, noise included; E = K_beta^T F K_alpha
    is F itself for normalised points. Matches through lenses are to be undistorted first
    (`LensView.undistort`).
    """
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
