"""Random rigs with every camera model, in every position, and which points of a ray beta sees."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

import arraygeom as ag
from arraygeom.lenses import CameraModel, FlatPort, RollingShutter
from tests.arraygeom.rigs import number
from tests.arraygeom.test_camera_models import HW, MODELS

KINDS = ("beside", "facing", "near behind", "forward", "backward", "verging", "anywhere")


@dataclass(frozen=True, eq=False, repr=False)
class Pushbroom(CameraModel):
    """A line that is moved along y while it records: central across, parallel along."""

    central = False
    lengths = ()

    def project(self, X):
        ahead = X[..., 2] > 0
        z = torch.where(ahead, X[..., 2], 1.0)
        return torch.stack([X[..., 0] / z, X[..., 1]], -1), ahead

    def unproject(self, xy):
        x, y = xy.unbind(-1)
        return torch.stack([x, 0 * y, 0 * x + 1], -1), xy.isfinite().all(-1)

    def origins(self, xy):
        x, y = xy.unbind(-1)
        return torch.stack([0 * x, y, 0 * x], -1)


BETAS: dict[str, tuple[Any, float]] = {
    **MODELS,
    "pinhole": (None, 110.0),
    "pushbroom": (Pushbroom(), 60.0),
    "rolling fisheye": (
        RollingShutter(
            velocity=number(0.5, 0.1, -0.3),
            rotation=number(0.1, -0.3, 0.2),
            readout=number(0.05),
            lens=ag.Distortion("kannala-brandt", number(0.02, -0.01, 0.0, 0.0)),
        ),
        50.0,
    ),
    "wide port": (
        FlatPort(distance=number(0.3), thickness=number(0.02), glass=number(1.52), water=number(1.333)),
        60.0,
    ),
    "narrow rolling shutter": (
        RollingShutter(velocity=number(1.0, 0.5, 0.0), rotation=number(0.2, 0.0, 0.1), readout=number(0.5)),
        1500.0,
    ),
}
ALPHAS = ("pinhole", "pinhole", "pinhole", "rolling shutter", "port", "own")


def drawn(beta: str, seed: int) -> tuple[str, ag.Rig, torch.Tensor]:
    """(kind, rig, pixels of alpha) of a beta's model and a seed."""
    kind, rng = KINDS[seed % len(KINDS)], np.random.default_rng(seed)
    near = float(rng.uniform(0.3, 1.5))
    far = math.inf if rng.random() < 0.3 else near * float(rng.uniform(2, 30))
    w, c = rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.4, 0.4, 3)
    if kind == "facing":
        w[1], c[2] = w[1] + math.pi, c[2] + rng.uniform(0.5, 2) * near + 0.2
    if kind == "near behind":
        c[2] = near * rng.uniform(1.0, 2.0)
    if kind in ("forward", "backward"):
        c = np.array([0.05 * c[0], 0.05 * c[1], rng.uniform(0, 0.6) * (1 if kind == "forward" else -1)])
    if kind == "verging":
        w = np.array([0, rng.uniform(0.3, 1.3), 0]) * rng.choice([-1, 1])
        c[0] = -abs(c[0]) * 3 * np.sign(w[1])
    if kind == "anywhere":
        w, c = rng.uniform(-math.pi, math.pi, 3), rng.uniform(-2, 2, 3)
    name = ALPHAS[int(rng.integers(len(ALPHAS)))]
    cameras = {"a": _camera(name, np.zeros(3), np.zeros(3)), "b": _camera(beta, w, c)}
    x = torch.from_numpy(rng.uniform([0, 0], [HW[1] - 1, HW[0] - 1], (6, 2)))
    return f"{kind} of {name}", ag.Rig(cameras, depth=(near, far)), x


def _camera(name: str, w: np.ndarray, centre: np.ndarray) -> ag.Camera:
    model, focal = BETAS[name]
    pose = ag.Pose.from_centre(ag.rotation_from_vector(torch.from_numpy(w)), torch.from_numpy(centre))
    return ag.Camera(K=ag.intrinsics(focal, HW), cam_from_world=pose, hw=HW, distortion=model)


def seen(pair: ag.Pair, x: torch.Tensor, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Beta's pixels (n, m, 2) of the points of alpha's rays at depths (m), and which are on its image."""
    alpha, beta = pair.cameras
    x, z = x[:, None].expand(-1, len(depth), -1), torch.from_numpy(depth).expand(len(x), -1)
    X = alpha.unproject(x, z)
    there = beta.project(X.nan_to_num())
    on = there.valid & beta.contains(there.x) & X.isfinite().all(-1)
    return there.x.numpy(), on.numpy()


def depths(pair: ag.Pair, count: int) -> np.ndarray:
    """Depths between the bounds: even, even in inverse, in logarithm, and towards the plane of beta."""
    near, far = (float(d) for d in pair.depth_range)
    last = min(far, 1e4)
    z = float(pair.cameras[0].cam_from_world.apply(pair.cameras[1].centre)[2])
    close = z + np.concatenate([s * np.geomspace(1e-4, 10, count) for s in (-1, 1)])
    some = [np.linspace(near, min(last, 30), count), 1 / np.linspace(1 / near, 1 / last, count)]
    all_ = np.concatenate([*some, np.geomspace(near, last, count), close])
    return np.unique(all_[(all_ >= near) & (all_ <= last)])


def lost_and_false(pair: ag.Pair, x: torch.Tensor, count: int) -> tuple[float, float]:
    """Pixels from the farthest point that beta sees to the samples, beyond half a step, and from the farthest
    sample to the curve of the points."""
    found = ag.Curved(200)(pair, x)
    xy, on = seen(pair, x, depths(pair, count))
    lost = false = 0.0
    for i, line in enumerate(samples[mask].numpy() for samples, mask in zip(found.xy, found.mask)):
        points = xy[i][on[i]]
        if len(points) and not len(line):
            lost = max(lost, float(np.ptp(points, axis=0).max()))
        if len(points) and len(line):
            step = float(np.median(np.linalg.norm(np.diff(line, axis=0), axis=-1))) if len(line) > 1 else 0.0
            apart = np.linalg.norm(points[:, None] - line[None], axis=-1)
            lost = max(lost, apart.min(1).max() - 0.6 * step)
        if len(line):
            # pieces that leave the image count as well: of a curve that only just touches it
            some = on[i][1:] | on[i][:-1] | (len(points) == 0)
            false = max(false, _off(line, xy[i][:-1][some], xy[i][1:][some]))
    return lost, false


def _off(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """Pixels from the farthest of some points (n, 2) to the nearest of straight pieces (m, 2)."""
    step, away = end - start, points[:, None] - start
    share = (away * step).sum(-1) / np.maximum((step * step).sum(-1), 1e-12)
    return float(np.linalg.norm(away - np.clip(share, 0, 1)[..., None] * step, axis=-1).min(1).max())
