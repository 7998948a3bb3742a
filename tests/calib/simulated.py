"""Simulated rigs of wide and narrow field, the points matched in their images, with noise, wrong ones."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from arraygeom import Camera, Distortion, Pose, Rig, intrinsics, rotation_from_vector
from calib.images.matches import PointMatches

HW = (480, 640)
FOCAL = {"wide": 420.0, "narrow": 1900.0}
DISTANCE = {"wide": (1.0, 4.0), "narrow": (4.0, 9.0)}
"""Metres to the nearest and the farthest points."""
NOISE, WRONG = 0.15, 0.08
"""Pixels, and the share of wrong matches among those that an F with a tolerance of some pixels lets pass."""


def simulated_rig(field: str, count: int, g: np.random.Generator, *, lens: bool = False) -> Rig:
    """A row of unlike cameras some 0.25 m apart that look at the middle of the scene, each roughly."""
    near, far = DISTANCE[field]
    target = np.array([0.0, 0.0, (near + far) / 2])
    cameras = {}
    for i in range(count):
        centre = np.array([0.25 * i, *g.normal(0, 0.03, 2)])
        focal = FOCAL[field] * g.uniform(0.9, 1.1)
        middle = (np.array(HW[::-1]) - 1) / 2 + g.normal(0, 8, 2)
        corner = math.hypot(*HW) / 2 / focal
        k1 = -g.uniform(0.06, 0.12) / corner**2
        distortion = Distortion("brown-conrady", torch.tensor([k1, 0.3 * k1**2, 0, 0])) if lens else None
        R = rotation_from_vector(torch.from_numpy(g.normal(0, 0.02, 3))) @ _towards(target - centre)
        pose = Pose.from_centre(R, torch.from_numpy(centre))
        cameras[f"c{i}"] = Camera(
            K=intrinsics((focal, focal * 1.002), HW, tuple(middle)),
            cam_from_world=pose,
            hw=HW,
            distortion=None if distortion is None else distortion.to(torch.float64),
        )
    return Rig(cameras, depth=(0.9 * near, 1.1 * far))


def _towards(direction: np.ndarray) -> Tensor:
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return torch.from_numpy(np.stack([x, np.cross(z, x), z]))


def simulated_matches(
    rig: Rig, field: str, g: np.random.Generator, *, count: int = 250, wrong: float = WRONG
) -> dict[tuple[str, str], PointMatches]:
    """Matched points of neighbouring cameras of a true rig; wrong ones lie some pixels across the lines."""
    near, far = DISTANCE[field]
    found = {}
    for names in pairwise(rig.names):
        alpha, beta = (rig[name] for name in names)
        h, w = alpha.hw
        x = torch.from_numpy(g.uniform(0, 1, (6 * count, 2)) * [w - 1, h - 1])
        depth = torch.from_numpy(1 / g.uniform(1 / far, 1 / near, len(x)))
        y, _, valid = beta.project(alpha.unproject(x, depth))
        seen = valid & beta.contains(y) & x.isfinite().all(-1)
        x, y = x[seen][:count], y[seen][:count]
        is_wrong = g.uniform(size=(len(x), 1)) < wrong
        off = np.where(is_wrong, g.uniform(-5, 5, x.shape), g.normal(0, NOISE, x.shape))
        here = g.normal(0, NOISE, x.shape)
        found[names] = PointMatches(x + torch.from_numpy(here), y + torch.from_numpy(off))
    return found


def worse(rig: Rig, g: torch.Generator) -> Rig:
    """Every camera rotated by 0.3 degrees, its principal point moved by 5 px, in random directions."""
    sizes = {"rotation": math.radians(0.3), "centre": 5.0}
    changes = rig.parameters(free=[f"*.{kind}" for kind in sizes])
    drawn = {k: torch.randn(v.shape, generator=g, dtype=torch.float64) for k, v in changes.items()}
    return rig.perturbed({k: v / v.norm() * sizes[k.rpartition(".")[2]] for k, v in drawn.items()})
