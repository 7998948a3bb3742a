"""Rectification of a pair: homographies after which a point has the same row in both images."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from .camera import Camera, intrinsics
from .homography import infinite_homography
from .pair import Pair
from .pixels import HW, product
from .pose import Pose, cross_matrix, matvec, rotation_from_vector, rotation_vector
from .runtime.tracing import needs_numbers

if TYPE_CHECKING:
    from kornia.geometry.camera import StereoCamera


class Rectification(NamedTuple):
    """Rectification of a pair.

    Attributes:
        R_alpha: rotation from alpha's frame to its rectified frame.
        R_beta: rotation from beta's frame to its rectified frame.
        H_alpha: map from alpha's old pixels to new ones.
        H_beta: map from beta's old pixels to new ones.
        pair: rectified cameras: same K, size and orientation, baseline along x, beta on either side; no link.
            Its depth range has the old numbers, now along the rotated axis: widen it where that matters.
    """

    R_alpha: Float[Tensor, "3 3"]
    R_beta: Float[Tensor, "3 3"]
    H_alpha: Float[Tensor, "3 3"]
    H_beta: Float[Tensor, "3 3"]
    pair: Pair


def rectify(pair: Pair, *, K: Float[Tensor, "3 3"] | None = None, hw: HW | None = None) -> Rectification:
    """Compute the rectifying homographies of a pinhole pair (Bouguet's: each camera is rotated half way).

    R_alpha and R_beta are as OpenCV's `stereoRectify` gives them for a horizontal pair; a vertical one is
    rotated by 90 degrees, so that lines are rows here too. By calibration: a link does not count.

    Args:
        K: intrinsics of the new images; None for the smaller focal length, with the centres of the old images
            about the middle of the new.
        hw: size of the new images; None for alpha's.

    Returns:
        The rectification, differentiable in everything.

    Raises:
        ValueError: for lenses, batches, no baseline, one so near an optical axis (motion forwards) that new
            images would lie beside the old ones, an invalid K or hw, and as `Pair.beta_from_alpha`.
        NotImplementedError: within `torch.func.vmap`.
    """
    alpha, beta = pair.cameras
    if pair.has_lens:
        raise ValueError("rectification by homographies needs pinhole cameras: undistort the images first")
    if alpha.batch_shape or beta.batch_shape:
        raise ValueError("rectification works on one pair at a time: take one of the batch")
    pose = pair.beta_from_alpha
    needs_numbers("whether a pair can be rectified", alpha.K, beta.K, pose.R, pose.t)
    if not pose.t.norm() > 0:
        raise ValueError("two co-located cameras cannot be rectified: there is no baseline")
    R_alpha, R_beta = rectifying_rotations(pose)
    for camera, R in ((alpha, R_alpha), (beta, R_beta)):
        ray = _middle_ray(camera, R)
        if not ray[2] > NEAREST_COSINE * ray.norm():
            raise ValueError(
                "the baseline is nearly along an optical axis (motion forwards): "
                "no homography turns lines into rows; use the pair as it is, with Epipolar or Curved"
            )
    hw = hw or alpha.hw
    K = middle_intrinsics((alpha, beta), (R_alpha, R_beta), hw) if K is None else K
    new_alpha, new_beta = (
        Camera(K=K, cam_from_world=Pose(product(R, c.R), matvec(R, c.t)), hw=hw, sensor=c.sensor)
        for c, R in ((alpha, R_alpha), (beta, R_beta))
    )
    H_alpha, H_beta = (infinite_homography(c.K, K, R) for c, R in ((alpha, R_alpha), (beta, R_beta)))
    rectified = dataclasses.replace(pair, alpha=new_alpha, beta=new_beta, link=None)
    return Rectification(R_alpha, R_beta, H_alpha, H_beta, rectified)


def rectifying_rotations(beta_from_alpha: Pose) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3 3"]]:
    """Compute the rotations that bring both frames half way to one another and the baseline along x.

    The baseline is turned to +x or -x, whichever is nearer. Not for a batch.

    Returns:
        (R_alpha, R_beta), each from that camera's frame to the rectified one; NaN without a baseline.
    """
    half = rotation_from_vector(0.5 * rotation_vector(beta_from_alpha.R))
    t = matvec(half.T, beta_from_alpha.t)
    direction = t / t.norm()
    x = torch.where(t[0] > 0, 1.0, -1.0) * t.new_tensor([1.0, 0, 0])
    to_x = rotation_to(direction, x)
    return product(to_x, half), product(to_x, half.T)


def rotation_to(a: Float[Tensor, "3"], b: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the shortest rotation from unit vector a to unit vector b, less than 180 degrees away."""
    v = torch.linalg.cross(a, b)
    W = cross_matrix(v)
    return torch.eye(3).to(v) + W + product(W, W) / (1 + (a * b).sum())


def middle_intrinsics(
    cameras: tuple[Camera, Camera], rotations: tuple[Float[Tensor, "3 3"], Float[Tensor, "3 3"]], hw: HW
) -> Float[Tensor, "3 3"]:
    """Make the K that both rectified cameras share.

    Args:
        cameras: alpha and beta before rectification.
        rotations: rotation of each to its rectified frame.
        hw: size of the rectified images.

    Returns:
        K with the smaller focal length sqrt(fx fy); it takes the old images' middles, on average, to the new.
    """
    focal = torch.stack([(c.K[:2, :2].det().abs()).sqrt() for c in cameras]).min()
    rays = [_middle_ray(camera, R) for camera, R in zip(cameras, rotations)]
    normalised = torch.stack([ray[:2] / ray[2] for ray in rays])
    centre = intrinsics(1.0, hw).to(focal)[:2, 2] - focal * normalised.mean(0)
    return intrinsics(focal, hw, centre).to(focal)


NEAREST_COSINE = 0.1
"""Least cosine of the angle between an old image's middle and the new optical axis: 84 degrees."""


def _middle_ray(camera: Camera, R: Tensor) -> Tensor:
    """Ray of the image's middle in the rotated frame."""
    h, w = camera.hw
    return matvec(R, camera.rays(camera.K.new_tensor([(w - 1) / 2, (h - 1) / 2]))[0])


def to_stereo_camera(pair: Pair) -> StereoCamera:
    """Convert a rectified pair, alpha on the left, as `arraygeom.rectify` makes it (`.pair`), to kornia's.

    Returns:
        The stereo camera, a batch (of one for a single pair); it has no sizes, world poses or depth range.

    Raises:
        ValueError: for a pair that is not calibrated, has lenses or is not rectified, or whose beta is not to
            the right of alpha.
    """
    from kornia.geometry.camera import StereoCamera

    alpha, beta = pair.cameras
    pose, batch = pair.beta_from_alpha, pair.batch_shape
    K, t = alpha.K.expand(*batch, 3, 3).reshape(-1, 3, 3), pose.t.expand(*batch, 3).reshape(-1, 3)
    turned, other = (pose.R - torch.eye(3).to(pose.R)).abs().max(), (beta.K - alpha.K).abs().max()
    aside = (t[:, 1:].abs().amax(-1) > -ROUNDED * t[:, 0]).any()
    if pair.has_lens or bool(aside | (turned > ROUNDED) | (other > ROUNDED * K.max())):
        raise ValueError("kornia's StereoCamera is a rectified pair, beta on the right: rectify(pair).pair")
    right = K[..., :1] * t[:, :1, None]
    return StereoCamera(torch.cat([K, torch.zeros_like(right)], -1), torch.cat([K, right], -1))


ROUNDED = 1e-5
"""Difference of two numbers, relative, that rounding in float32 explains."""
