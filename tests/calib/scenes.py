"""Rigs, points and images with known ground truth."""

import cv2
import numpy as np
import torch

from arraygeom import Camera, Distortion, Pose, Rig, intrinsics, rotation_from_vector
from calib.images.matches import PointMatches
from tests.arraygeom.rigs import parallel_rig

HW = (240, 320)


def texture(hw=HW, seed=0):
    """Blobs of many sizes, (1, H, W)."""
    noise = np.random.default_rng(seed).standard_normal(hw).astype(np.float32)
    image = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.5, 3, 6))
    return torch.from_numpy((image - image.min()) / np.ptp(image))[None]


def vector(*numbers) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def unlike_pair(*, lens: bool = False) -> Rig:
    """Two cameras with nothing in common: other sizes, focal lengths, principal points, rotated, apart."""
    first = Camera(
        K=intrinsics((300.0, 310.0), HW, (170.0, 110.0)),
        cam_from_world=Pose.from_centre(
            rotation_from_vector(vector(0.1, -0.2, 0.05)), vector(0.3, 0.1, -0.2)
        ),
        hw=HW,
        distortion=Distortion("brown-conrady", vector(-0.45, 0.15, 0.0, 0.0005)) if lens else None,
    )
    second_from_first = Pose(rotation_from_vector(vector(0.06, 0.09, -0.12)), vector(-0.2, 0.05, 0.03))
    second = Camera(
        K=intrinsics((330.0, 335.0), (250, 330), (150.0, 140.0)),
        cam_from_world=second_from_first @ first.cam_from_world,
        hw=(250, 330),
        distortion=Distortion("brown-conrady", vector(-0.4, 0.12, 0.0005, 0.0)) if lens else None,
    )
    return Rig({"first": first, "second": second}, depth=(1.5, 8.0))


def rectified_pair() -> Rig:
    """Two equal cameras side by side."""
    return parallel_rig(300.0, HW, {"left": (), "right": (0.2,)}, (1.5, 8.0))


def seen_points(
    rig, *, count=200, near=2.0, far=6.0, noise=0.15, seed=0
) -> dict[tuple[str, str], PointMatches]:
    """Points of the first two cameras between two depths, in both images, good to `noise` pixels in beta."""
    g = torch.Generator().manual_seed(seed)
    (a, alpha), (b, beta) = list(rig.cameras.items())[:2]
    h, w = alpha.hw
    x = torch.rand(4 * count, 2, generator=g, dtype=torch.float64) * vector(w - 1, h - 1)
    depth = near + (far - near) * torch.rand(len(x), generator=g, dtype=torch.float64)
    y, _, valid = beta.project(alpha.unproject(x, depth))
    seen = valid & beta.contains(y) & x.isfinite().all(-1)
    x, y = x[seen][:count], y[seen][:count]
    return {(a, b): PointMatches(x, y + noise * torch.randn(len(y), 2, generator=g, dtype=torch.float64))}


def rectified_images(seed=0) -> dict[str, torch.Tensor]:
    """Render `rectified_pair`'s views of two planes, one above the other, at 60 / 20 = 3 m and 60 / 11 m."""
    wide = texture((HW[0], HW[1] + 60), seed)
    near, far = (wide[..., d : d + HW[1]] for d in (20, 11))
    right = torch.cat([far[:, : HW[0] // 2], near[:, HW[0] // 2 :]], 1)
    return {"left": wide[..., : HW[1]].contiguous(), "right": right.contiguous()}
