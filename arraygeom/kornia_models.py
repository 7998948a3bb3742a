"""Conversion to and from kornia's camera models (without pose), batches of pinholes and stereo cameras."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from .distortion import BROWN_CONRADY, KANNALA_BRANDT, Distortion
from .lenses import Orthographic
from .lenses.model import LensModel
from .pixels import HW, broadcast_shapes
from .pose import Pose

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera, StereoCamera
    from kornia.sensors.camera import CameraModel

BROWN_TERMS = 8
"""Number of kornia's Brown-Conrady coefficients: k1 k2 p1 p2 k3 k4 k5 k6."""


def to_kornia_model(K: Float[Tensor, "*b 3 3"], hw: HW, lens: LensModel | None) -> CameraModel:
    """Make kornia's camera model with these intrinsics and lens.

    Args:
        K: intrinsics, of one camera or a batch.
        hw: height and width of the image.
        lens: the lens; None for a pinhole.

    Returns:
        The model, with parameters (n) or (B, n): several batch axes become one.

    Raises:
        ValueError: for a skewed or rotated K, lenses, or prism or tilt terms, that kornia does not have, and
            batch axes that do not broadcast.
    """
    from kornia.image import ImageSize
    from kornia.sensors.camera import CameraModel, CameraModelType

    if bool((K[..., 0, 1] != 0).any() | (K[..., 1, 0] != 0).any()):
        raise ValueError("kornia's camera models have fx, fy, cx and cy, and this K is skewed or rotated")
    numbers = K.new_zeros(0)
    if lens is None:
        kind = CameraModelType.PINHOLE
    elif isinstance(lens, Orthographic):
        kind = CameraModelType.ORTHOGRAPHIC
    elif lens.model == KANNALA_BRANDT:
        kind, numbers = CameraModelType.KANNALA_BRANDT_K3, lens.coefficients
    elif lens.model == BROWN_CONRADY:
        kind, numbers = CameraModelType.BROWN_CONRADY, _eight(lens)
    else:
        raise ValueError(
            f"kornia has no {lens.model} model: "
            "it has pinholes, brown-conrady, kannala-brandt and orthographic"
        )
    focal_and_centre = torch.stack([K[..., 0, 0], K[..., 1, 1], K[..., 0, 2], K[..., 1, 2]], -1)
    batch = broadcast_shapes(K.shape[:-2], numbers.shape[:-1])
    params = torch.cat([tensor.expand(*batch, -1) for tensor in (focal_and_centre, numbers.to(K))], -1)
    return CameraModel(ImageSize(*hw), kind, params.flatten(0, -2) if params.ndim > 2 else params)


def _eight(lens: LensModel) -> Tensor:
    c = lens.coefficients
    if bool(c[..., BROWN_TERMS:].any()):
        raise ValueError(
            "kornia's Brown-Conrady model has k1 k2 p1 p2 k3 to k6, and this lens also prism or tilt terms"
        )
    return pad(c[..., :BROWN_TERMS], (0, max(0, BROWN_TERMS - c.shape[-1])))


def from_kornia_model(model: CameraModel) -> tuple[Float[Tensor, "*b 3 3"], HW, LensModel | None]:
    """Extract intrinsics and lens from a camera model of kornia, one or a batch.

    Returns:
        K, the image's (height, width), and the lens; None for kornia's pinhole, whose "distortion" is affine.
    """
    from kornia.sensors.camera.distortion_model import BrownConradyTransform, KannalaBrandtK3Transform
    from kornia.sensors.camera.projection_model import OrthographicProjection

    numbers = model.params[..., 4:]
    lens: LensModel | None = None
    if isinstance(model.projection, OrthographicProjection):
        lens = Orthographic()
    elif isinstance(model.distortion, BrownConradyTransform):
        lens = Distortion(BROWN_CONRADY, numbers)
    elif isinstance(model.distortion, KannalaBrandtK3Transform):
        lens = Distortion(KANNALA_BRANDT, numbers)
    return model.matrix(), (int(model.height), int(model.width)), lens


def to_pinhole(K: Float[Tensor, "*b 3 3"], cam_from_world: Pose, hw: HW) -> PinholeCamera:
    """Make kornia's `PinholeCamera`, a batch of one or more."""
    from kornia.geometry.camera import PinholeCamera

    shape = broadcast_shapes(K.shape[:-2], cam_from_world.batch_shape)
    intrinsics = pad(K.expand(*shape, 3, 3).reshape(-1, 3, 3), (0, 1, 0, 1))
    intrinsics[:, 3, 3] = 1
    h, w = (K.new_full((len(intrinsics),), n) for n in hw)
    return PinholeCamera(intrinsics, cam_from_world.matrix.expand(*shape, 4, 4).reshape(-1, 4, 4), h, w)


def pinholes_by_name(
    cameras: Mapping[str, PinholeCamera] | PinholeCamera | StereoCamera, hw: HW | None = None
) -> Mapping[str, PinholeCamera]:
    """Name kornia's cameras; the cameras of a batch are "camera0" and so on, of a pair "left" and "right".

    Args:
        cameras: pinholes by name, returned as given; a batch of pinholes; or a `StereoCamera`.
        hw: height and width of the images of a `StereoCamera`, whose left camera is at the world's origin;
            else unused.

    Returns:
        Cameras by name, in order: batches of 1 of a batch, as long as the pair's of a `StereoCamera`.

    Raises:
        ValueError: for a `StereoCamera` without `hw`.
        TypeError: for anything else, also in a mapping.
    """
    from kornia.geometry.camera import PinholeCamera, StereoCamera

    if isinstance(cameras, Mapping):
        for name, camera in cameras.items():
            if not isinstance(camera, PinholeCamera):
                raise TypeError(f"camera '{name}' is a {type(camera).__name__}: give a kornia PinholeCamera")
        return cameras
    if isinstance(cameras, PinholeCamera):
        parts = cameras.intrinsics, cameras.extrinsics, cameras.height, cameras.width
        return {
            f"camera{i}": PinholeCamera(*each) for i, each in enumerate(zip(*(p.split(1) for p in parts)))
        }
    if not isinstance(cameras, StereoCamera):
        kind = type(cameras).__name__
        raise TypeError(f"a {kind} is none of PinholeCameras by name, a batch of them, and StereoCamera")
    if hw is None:
        raise ValueError("a StereoCamera states no image size: give hw=(height, width)")
    made = {}
    for name, P in (("left", cameras.rectified_left_camera), ("right", cameras.rectified_right_camera)):
        K = P[..., :3]
        made[name] = to_pinhole(
            K, Pose(torch.eye(3).to(K).expand_as(K), torch.linalg.solve(K, P[..., 3])), hw
        )
    return made


def to_pinhole_batch(cameras: Mapping[str, PinholeCamera]) -> PinholeCamera:
    """Join cameras, as `Rig.to_kornia` returns them, to one batch, in their order; sizes may differ."""
    from kornia.geometry.camera import PinholeCamera

    parts = [(c.intrinsics, c.extrinsics, c.height, c.width) for c in cameras.values()]
    return PinholeCamera(*map(torch.cat, zip(*parts)))
