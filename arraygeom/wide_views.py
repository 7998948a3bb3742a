"""Views of cameras that no pinhole covers: rectified on the sphere, and cut into pinholes."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from .camera import Camera, intrinsics
from .checks import check_above
from .lenses import Equirectangular
from .pair import Pair
from .pixels import pixel_grid, product
from .pose import Pose, matvec, rotation_from_vector
from .rectification import rectifying_rotations


def rectify_spherical(pair: Pair, *, focal: float | None = None) -> Pair:
    """Rectify a pair with any lenses: pixels of the new cameras are angles about and along the baseline.

    A point has the same row in both new images, however far off axis it is; rays along the baseline are at
    the left and right ends. Images follow by `resampled(image, old_camera, new_camera)`.

    Args:
        focal: pixels for each radian, above 0; None for the lower of the cameras' in their images' middle.

    Returns:
        The pair of the new cameras (their lens is `Equirectangular`), alike in K, size and orientation, just
        large enough for both images, without a link. Its depth range has the old numbers, along the new axis.

    Raises:
        ValueError: for batches, no baseline, lenses whose rays do not meet in a point, none with a ray, a
            focal length that is not positive, new images larger than `check_hw` allows, and as
            `Pair.beta_from_alpha`.
    """
    check_above(0, itself=False, focal=focal)
    cameras = pair.cameras
    if any(c.batch_shape for c in cameras) or not all(c.central for c in cameras):
        raise ValueError("spherical rectification is of one pair at a time, whose rays meet in a point each")
    if not pair.beta_from_alpha.t.norm() > 0:
        raise ValueError("two co-located cameras cannot be rectified: there is no baseline")
    to_columns = pair.beta_from_alpha.R.new_tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rotations = [product(to_columns, R) for R in rectifying_rotations(pair.beta_from_alpha)]
    scale = min(_focal(c) for c in cameras) if focal is None else focal
    angles = torch.cat([_angles(c, R) for c, R in zip(cameras, rotations)])
    if not len(angles):
        raise ValueError("no pixel of either camera has a ray: correct their K and lens models")
    low, high = (scale * angles.amin(0)).floor() - 1, (scale * angles.amax(0)).ceil() + 1
    w, h = (int(n) + 1 for n in (high - low).tolist())
    K = intrinsics(scale, (h, w)).to(low)
    K[:2, 2] = -low
    made = [
        Camera(
            K=K,
            cam_from_world=Pose(product(R, c.R), matvec(R, c.t)),
            hw=(h, w),
            distortion=Equirectangular(),
            sensor=c.sensor,
        ).rot90(1)
        for c, R in zip(cameras, rotations)
    ]
    return replace(pair, alpha=made[0], beta=made[1], link=None)


def _angles(camera: Camera, R: Tensor) -> Float[Tensor, "n 2"]:
    """Longitudes and latitudes of a camera's pixels, some of them, about a rotated frame."""
    rays, valid = _rays(camera)
    return Equirectangular().project(rays[valid] @ R.mT)[0]


def _rays(camera: Camera) -> tuple[Tensor, Tensor]:
    """Rays over a camera's image, its border's included, and which there are."""
    h, w = camera.hw
    steps = camera.K.new_tensor([w / (SIDE - 1), h / (SIDE - 1)])
    return camera.rays(pixel_grid((SIDE, SIDE)).to(steps) * steps - 0.5)


SIDE = 33
"""Rows and columns of pixels whose rays say what a camera sees."""


def _focal(camera: Camera) -> float:
    """Pixels for each radian in the middle of a camera's image."""
    h, w = camera.hw
    middle = camera.K.new_tensor([(w - 1) / 2, (h - 1) / 2])
    rays, _ = camera.rays(torch.stack([middle, middle + middle.new_tensor([1.0, 0.0])]))
    a, b = rays / rays.norm(dim=-1, keepdim=True)
    return float(1 / torch.linalg.cross(a, b).norm())


QUARTER = math.pi / 2
FACES = {
    "front": (0.0, 0.0),
    "left": (0.0, -QUARTER),
    "right": (0.0, QUARTER),
    "up": (QUARTER, 0.0),
    "down": (-QUARTER, 0.0),
    "back": (0.0, 2 * QUARTER),
}
"""Angles up and to the right of each face's axis."""


def cube_faces(camera: Camera, *, overlap: float = 5.0) -> dict[str, Camera]:
    """Cut the view of a wide lens into pinhole cameras, the faces of a cube around it.

    Images follow by `resampled(image, camera, face)`. Each face is fused or matched as any pinhole camera.

    Args:
        overlap: degrees by which faces reach beyond their edges, well below 45.

    Returns:
        Cameras in the place of `camera` by face, in the order of `FACES` ("front", "left", ...), if the lens
        sees any of it, with its resolution in the middle.

    Raises:
        ValueError: for a batch, lenses whose rays do not meet in a point, and an overlap of about 45 or more.
    """
    if camera.batch_shape or not camera.central:
        raise ValueError("faces are of one camera at a time, whose rays meet in a point")
    rays, valid = _rays(camera)
    tangent, scale = math.tan(math.radians(45 + overlap)), _focal(camera)
    side = 2 * round(scale * tangent) + 1
    K, faces = intrinsics(scale, (side, side)).to(camera.K), {}
    for name, (x, y) in FACES.items():
        up, right = (rotation_from_vector(camera.K.new_tensor(v)) for v in ((-x, 0, 0), (0, -y, 0)))
        turn = product(up, right)
        seen = rays[valid] @ turn.mT
        if bool(((seen[:, 2] > 0) & (seen[:, :2].abs().amax(-1) <= seen[:, 2])).any()):
            pose = Pose(product(turn, camera.R), matvec(turn, camera.t))
            faces[name] = camera.replace(K=K, cam_from_world=pose, hw=(side, side), distortion=None)
    return faces
