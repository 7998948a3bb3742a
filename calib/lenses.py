"""Cameras with lenses in place of pictures that are known by fundamental matrices alone.

F has seven numbers: a pose up to its length has five, two focal lengths the rest. So cameras with unlike focal lengths
say all that F says, and unlike F they can have lenses, through which lines are bent. What is unknowable stays open: the
unit of length, and focal lengths that trade with depth.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import torch
from torch import Tensor

from arraygeom import Camera, Distortion, Pose, Rig, intrinsics, triangulate
from arraygeom.pixels import HW

from .matches import ENOUGH, Matches, similarity
from .residuals import epipolar_residuals

GUESSES = 1.2, 0.8, 1.8
"""Focal lengths of the first camera that are tried, in widths of its picture, likely ones first."""
BETTER = 0.7
"""A guess is taken before a likelier one if points are nearer to their lines by this factor."""
SIGMA = {"rotation": 0.1, "translation": 0.2, "focal": 0.2, "distortion": 0.5}
"""How well the numbers of such cameras are known, as `unknowns.SIGMA` counts them."""
FREE = tuple(SIGMA)

Pairs = Mapping[tuple[str, str], Matches]


def with_cameras(rig: Rig, pairs: Pairs) -> Rig:
    """A rig of cameras, each with two terms of a lens that are still 0, that puts matches where the rig's links do.

    The unit of length is the first link's baseline; the other baselines are such that points seen in both pairs of a
    camera have one depth. Raises ValueError for cameras that no chain of pairs joins to the first.
    """
    cameras: dict[str, Camera] = {}
    depths: dict[str, dict[tuple[float, float], float]] = {}
    todo = {names: matches for names, matches in pairs.items() if len(matches.alpha) >= ENOUGH}
    while todo:
        names = next((n for n in todo if not cameras or set(n) & set(cameras)), None)
        if names is None:
            break
        a, b = names
        matches = todo.pop(names)
        if b in cameras and a in cameras:
            continue
        if b in cameras:
            a, b, matches = b, a, Matches(matches.beta, matches.alpha)
        sizes = rig[a].hw, rig[b].hw
        alpha, beta = _pair(matches, sizes, cameras.get(a))
        depth = _depths(alpha, beta, matches)
        scale = _scale(depth, depths.setdefault(a, {}))
        depths[a] |= {x: scale * z for x, z in depth.items()}
        from_world = cameras[a].cam_from_world if a in cameras else Pose.identity()
        cameras.setdefault(a, alpha)
        moved = Pose(beta.R, scale * beta.t) @ from_world
        cameras[b] = beta.replace(cam_from_world=moved)
    if left := [name for name in rig.names if name not in cameras and any(name in names for names in pairs)]:
        raise ValueError(f"no pictures join {', '.join(map(repr, left))} to the others")
    return Rig({**rig.cameras, **cameras}, links={n: v for n, v in rig.links.items() if not set(n) <= set(cameras)})


def _pair(matches: Matches, sizes: tuple[HW, HW], known: Camera | None) -> tuple[Camera, Camera]:
    """Two cameras, the first at the origin; what is one pixel in the first is as many in the second as focal lengths
    are to each other."""
    firsts = [known.replace(cam_from_world=Pose.identity())] if known else [_camera(sizes[0], f) for f in GUESSES]
    ratio = float(similarity(matches)[:2, :2].det().abs().sqrt())
    tried = [(a, _posed(matches, a, _camera(sizes[1], ratio * float(a.K[0, 0]) / sizes[1][1]))) for a in firsts]
    misfits = [_misfit(matches, *cameras) for cameras in tried]
    return next(c for c, misfit in zip(tried, misfits) if misfit <= min(misfits) / BETTER)


def _camera(hw: HW, focal: float) -> Camera:
    lens = Distortion("brown-conrady", torch.zeros(4, dtype=torch.float64))
    K = intrinsics(focal * hw[1], hw).to(torch.float64)
    return Camera(K=K, cam_from_world=Pose.identity(), hw=hw, distortion=lens)


def _posed(matches: Matches, alpha: Camera, beta: Camera) -> Camera:
    """Beta where the essential matrix of the matches has it, a unit away, most points in front."""
    rays = [c.rays(x)[0] for c, x in zip((alpha, beta), matches)]
    x, y = ((r[:, :2] / r[:, 2:]).numpy() for r in rays)
    limit = 2.0 / float(beta.K[0, 0])
    E, _ = cv2.findEssentialMat(x, y, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.999, threshold=limit)
    if E is None or E.shape != (3, 3):
        return beta.replace(cam_from_world=Pose(torch.eye(3).double(), torch.tensor([-1.0, 0, 0]).double()))
    _, R, t, _ = cv2.recoverPose(E, x, y, np.eye(3))
    return beta.replace(cam_from_world=Pose(torch.from_numpy(R), torch.from_numpy(t.reshape(3))))


def _misfit(matches: Matches, alpha: Camera, beta: Camera) -> float:
    pair = Rig({"a": alpha, "b": beta}).pair("a", "b")
    return float(epipolar_residuals(pair, matches).sampson.detach().abs().median())


def _depths(alpha: Camera, beta: Camera, matches: Matches) -> dict[tuple[float, float], float]:
    """By alpha's points, which features of one picture share between pairs."""
    found = triangulate([alpha, beta], torch.stack(list(matches)))
    depth: Tensor = alpha.cam_from_world.apply(found.X)[:, 2]
    kept = (found.valid & (depth > 0)).tolist()
    places = [(float(x), float(y)) for x, y in matches.alpha.tolist()]
    return {x: z for x, z, good in zip(places, depth.tolist(), kept) if good}


def _scale(depth: Mapping[tuple[float, float], float], known: Mapping[tuple[float, float], float]) -> float:
    """What brings depths to those known of the same points; of all points, if few are the same."""
    if not known or not depth:
        return 1.0
    ratios = [known[x] / z for x, z in depth.items() if x in known]
    if len(ratios) >= ENOUGH:
        return float(np.median(ratios))
    return float(np.median(list(known.values())) / np.median(list(depth.values())))
