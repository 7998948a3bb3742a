"""Cameras as other libraries' tensors: gsplat, OpenGL, PyTorch3D. Every shift of pixels and axes is here."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..pixels import HW
from ..pose import Pose

HALF = 0.5
"""Their pixels' centres are at halves, ours at whole numbers."""
FLIP = {"opengl": (1.0, -1.0, -1.0), "pytorch3d": (-1.0, -1.0, 1.0)}
"""Signs of our axes (x right, y down, z forward) in theirs."""


class GSplatCamera(NamedTuple):
    """Cameras as arguments of `gsplat.rasterization`, which also takes `Camera.hw`'s width and height.

    It needs an axis of cameras: `viewmats[None]` and `Ks[None]` of a single one.

    Attributes:
        viewmats: camera from world, axes and lengths as ours, with the batch axes of the pose.
        Ks: intrinsics, with the first pixel's centre at (0.5, 0.5), with K's axes.
    """

    viewmats: Float[Tensor, "*b 4 4"]
    Ks: Float[Tensor, "*b 3 3"]


class OpenGLCamera(NamedTuple):
    """Matrices of OpenGL: x right, y up, z backward; multiplied from the left.

    Attributes:
        view: camera from world, lengths as the camera's, with the batch axes of the pose.
        projection: clip coordinates (z -1 at near, 1 at far) from camera, y up, with K's batch axes.
    """

    view: Float[Tensor, "*b 4 4"]
    projection: Float[Tensor, "*b 4 4"]


class PyTorch3DCamera(NamedTuple):
    """Arguments of `pytorch3d.renderer.PerspectiveCameras` with `in_ndc=False`: x left, y up, rows times R.

    Attributes:
        R: rotation, X_camera = X_world R + T, with the batch axes of the pose, as T; the rest have K's.
        T: translation, lengths as the camera's.
        focal_length: (fx, fy), pixels.
        principal_point: (cx, cy), with the first pixel's centre at (0.5, 0.5).
        image_size: (height, width), pixels, as floats.
    """

    R: Float[Tensor, "*b 3 3"]
    T: Float[Tensor, "*b 3"]
    focal_length: Float[Tensor, "*b 2"]
    principal_point: Float[Tensor, "*b 2"]
    image_size: Float[Tensor, "*b 2"]


def to_gsplat(camera: Camera) -> GSplatCamera:
    """Convert a pinhole camera, or a batch; differentiable.

    Raises:
        ValueError: for a lens.
    """
    return GSplatCamera(_pinhole(camera).cam_from_world.matrix, _shifted(camera.K, HALF))


def from_gsplat(viewmats: Float[Tensor, "*b 4 4"], Ks: Float[Tensor, "*b 3 3"], hw: HW) -> Camera:
    """Convert back; the inverse of `to_gsplat`."""
    return Camera(K=_shifted(Ks, -HALF), cam_from_world=Pose.from_matrix(viewmats), hw=hw)


def to_opengl(camera: Camera, near: float, far: float) -> OpenGLCamera:
    """Convert a pinhole camera, or a batch, with clipping planes at `near` and `far`, in the unit of the
    camera's translation; differentiable in the camera.

    Raises:
        ValueError: for a lens, and planes that are not 0 < near < far < infinity.
    """
    if not 0 < near < far < math.inf:
        raise ValueError(f"clipping planes must be 0 < near < far < infinity, got {near} and {far}")
    (h, w), K = camera.hw, _pinhole(camera).K
    scale = K.new_tensor([2 / w, 2 / h])
    projection = K.new_zeros(*K.shape[:-2], 4, 4)
    projection[..., :2, :2] = scale[:, None] * K[..., :2, :2] * K.new_tensor([[1.0, -1], [-1, 1]])
    centre = scale * (K[..., :2, 2] + HALF) - 1
    projection[..., :2, 2] = -centre * K.new_tensor([1.0, -1])
    projection[..., 2, 2], projection[..., 2, 3] = (
        -(far + near) / (far - near),
        -2 * far * near / (far - near),
    )
    projection[..., 3, 2] = -1
    return OpenGLCamera(_flipped(camera.cam_from_world, "opengl").matrix, projection)


def from_opengl(view: Float[Tensor, "*b 4 4"], projection: Float[Tensor, "*b 4 4"], hw: HW) -> Camera:
    """Convert back, without the clipping planes; the inverse of `to_opengl`."""
    h, w = hw
    half = projection.new_tensor([w / 2, h / 2])
    K = projection.new_zeros(*projection.shape[:-2], 3, 3)
    K[..., :2, :2] = half[:, None] * projection[..., :2, :2] * K.new_tensor([[1.0, -1], [-1, 1]])
    K[..., :2, 2] = half * (1 - projection[..., :2, 2] * K.new_tensor([1.0, -1])) - HALF
    K[..., 2, 2] = 1
    return Camera(K=K, cam_from_world=_flipped(Pose.from_matrix(view), "opengl"), hw=hw)


def to_pytorch3d(camera: Camera) -> PyTorch3DCamera:
    """Convert a pinhole camera without skew, or a batch; differentiable.

    Raises:
        ValueError: for a lens, and a skewed or rotated K (a mirrored one is not refused).
    """
    K = _pinhole(camera).K
    if bool((K[..., 0, 1] != 0).any() | (K[..., 1, 0] != 0).any()):
        raise ValueError("PyTorch3D's cameras have fx, fy, cx and cy, and this K is skewed or rotated")
    pose = _flipped(camera.cam_from_world, "pytorch3d")
    size = K.new_tensor(camera.hw).expand(*K.shape[:-2], 2)
    focal = K.diagonal(dim1=-2, dim2=-1)[..., :2]
    return PyTorch3DCamera(pose.R.mT, pose.t, focal, K[..., :2, 2] + HALF, size)


def from_pytorch3d(given: PyTorch3DCamera) -> Camera:
    """Convert back; the inverse of `to_pytorch3d`."""
    K = torch.diag_embed(torch.nn.functional.pad(given.focal_length, (0, 1), value=1.0))
    K[..., :2, 2] = given.principal_point - HALF
    h, w = (int(n) for n in given.image_size.reshape(-1, 2)[0])
    return Camera(K=K, cam_from_world=_flipped(Pose(given.R.mT, given.T), "pytorch3d"), hw=(h, w))


def _pinhole(camera: Camera) -> Camera:
    if camera.distortion is not None:
        raise ValueError("other libraries' tensors have no lens: take `pinhole_view`, and resample the image")
    return camera


def _shifted(K: Tensor, by: float) -> Tensor:
    return K + torch.nn.functional.pad(K.new_full((2, 1), by), (2, 0, 0, 1))


def _flipped(pose: Pose, kind: str) -> Pose:
    signs = pose.R.new_tensor(FLIP[kind])
    return Pose(signs[:, None] * pose.R, signs * pose.t)
