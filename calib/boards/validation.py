"""How well a calibrated rig predicts: epipolar errors, frames held out in turn, frames that do not fit."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Rig, epipolar_distance

from .bundle import BundleProblem, Solved, readjusted
from .detect import BoardViews
from .intrinsics import LEAST_SIGMA
from .photos import FrameKey

FEWEST_TO_HOLD_OUT = 8
"""Frames are held out from this many on that two cameras share."""
FOLDS = 5
"""Frames are held out in so many parts, each once."""
FEWEST_LEFT = 3
"""Frames that every camera must keep."""
MISFIT = 1.8
"""A frame does not fit if its residuals exceed those of the camera's median frame by this factor,"""
CONSPICUOUS = 1.8
"""and the camera's noise by this one."""
LISTED = 5


def held_out_errors(fit: Solved, views: Mapping[str, BoardViews]) -> dict[tuple[str, str], Float[np.ndarray, "_"]]:
    """Epipolar errors of all frames, each by a rig calibrated without it; empty if there are too few.

    Frames are held out in five parts.
    """
    frames = fit.problem.frames
    shared = [key for key in frames if sum(key in v.seen for v in views.values()) > 1]
    if len(shared) < FEWEST_TO_HOLD_OUT:
        return {}
    found = dict[tuple[str, str], list[np.ndarray]]()
    for fold in range(FOLDS):
        out = set(shared[fold::FOLDS])
        if any(len(v.seen.keys() - out) < FEWEST_LEFT for v in views.values()):
            return {}
        used = readjusted(fit.problem.of_boards(np.array([key not in out for key in frames])))
        judged = {name: v.only(out) for name, v in views.items()}
        for names, errors in epipolar_errors(Rig(used.cameras), judged).items():
            found.setdefault(names, []).append(errors)
    return {names: np.concatenate(errors) for names, errors in found.items()}


class FrameMisfit(NamedTuple):
    """A frame that a camera does not fit: its residuals, and those of the camera's median frame (RMS, pixels)."""

    camera: str
    frame: FrameKey
    rms: float
    typical: float


def frame_rms(problem: BundleProblem) -> dict[str, dict[FrameKey, float]]:
    """By camera and frame: root mean square residual, pixels."""
    found = {}
    for name, r in problem.residuals().items():
        block = problem.seen[name].block
        squared, count = np.bincount(block, (r**2).sum(-1)), np.bincount(block)
        found[name] = {problem.frames[b]: float(np.sqrt(squared[b] / count[b])) for b in np.flatnonzero(count)}
    return found


def misfits(fit: Solved) -> list[FrameMisfit]:
    """Frames whose residuals stand out, worst first."""
    found = []
    for name, by_frame in frame_rms(fit.problem).items():
        typical = float(np.median(list(by_frame.values())))
        limit = max(MISFIT * typical, CONSPICUOUS * 2**0.5 * max(fit.sigma[name], LEAST_SIGMA))
        found += [FrameMisfit(name, frame, rms, typical) for frame, rms in by_frame.items() if rms > limit]
    return sorted(found, key=lambda m: -m.rms / m.typical)


def misfit_notes(fit: Solved) -> list[str]:
    """One note per camera on its frames that do not fit."""
    notes = []
    for name in fit.problem.cameras:
        if mine := [m for m in misfits(fit) if m.camera == name]:
            listed = ", ".join(f"{m.frame} ({m.rms:.2f} px)" for m in mine[:LISTED])
            more = f" and {len(mine) - LISTED} more" if len(mine) > LISTED else ""
            notes.append(
                f"{name}: frames that do not fit: {listed}{more}, others {mine[0].typical:.2f} px: "
                "moved, blurred or wrongly detected? See the report"
            )
    return notes


def epipolar_errors(rig: Rig, views: Mapping[str, BoardViews]) -> dict[tuple[str, str], Float[np.ndarray, "_"]]:
    """By pair: distances in undistorted pixels from beta's points to the lines of alpha's, and the reverse."""
    found = {}
    for a, b in combinations(views, 2):
        xa, xb = _common(views[a], views[b])
        if len(xa):
            found[a, b] = _symmetric_distance(rig, a, b, xa, xb)
    return found


def _symmetric_distance(rig: Rig, a: str, b: str, xa: np.ndarray, xb: np.ndarray) -> np.ndarray:
    pair, reverse = rig.pair(a, b), rig.pair(b, a)
    (pa, va), (pb, vb) = pair.alpha.undistort(torch.from_numpy(xa)), pair.beta.undistort(torch.from_numpy(xb))
    forward = epipolar_distance(pair.fundamental, pa, pb).abs()
    backward = epipolar_distance(reverse.fundamental, pb, pa).abs()
    return ((forward + backward) / 2)[va & vb].numpy()


def _common(a: BoardViews, b: BoardViews) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of the points both cameras observed in the same frames."""
    parts: list[tuple[np.ndarray, np.ndarray]] = [(np.zeros((0, 2)), np.zeros((0, 2)))]
    for key in a.seen:
        if key in b.seen:
            _, i, j = np.intersect1d(a.seen[key].ids, b.seen[key].ids, return_indices=True)
            parts.append((a.seen[key].x[i], b.seen[key].x[j]))
    xa, xb = (np.concatenate(part) for part in zip(*parts))
    return xa, xb
