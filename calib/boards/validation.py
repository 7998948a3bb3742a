"""Validation of a calibration: epipolar errors, held-out frames, comparison of lens models, notes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Camera, Rig, epipolar_distance

from .board import Board
from .bundle import POSE, BundleProblem, Observations, Solved, camera_jacobian, intrinsic_values
from .detect import BoardViews, named
from .intrinsics import LENSES, Lens
from .poses import StartDeviations
from .solve import calibrate_single, readjusted
from .uncertainty import compensation, covered, grid_points, in_own_frame

FEWEST_TO_HOLD_OUT = 8
"""Least number of frames shared by two cameras for holding some out."""
FOLDS = 5
"""Number of parts of the frames, each held out once."""
FEWEST_TO_HALVE = 8
FEWEST_LEFT = 3
"""Least number of frames that every camera keeps."""
FAR_FROM_START = 4.0
"""Standard deviations from the start above which a camera is named."""
COMPARED: tuple[Lens, ...] = ("none", "brown-conrady", "kannala-brandt", "rational", "thin-prism", "tilted")
"""Lens models under comparison, the most usual first; then by number of coefficients."""
LENS_FOLDS = 4
FEWEST_TO_COMPARE = 8
EQUAL = 0.01
"""Relative difference of held-out errors below which they are equal."""


def epipolar_errors(
    rig: Rig, views: Mapping[str, BoardViews]
) -> dict[tuple[str, str], Float[np.ndarray, " _"]]:
    """Compute epipolar errors by pair: distances of points from their lines, averaged over both directions.

    Args:
        rig: rig of the cameras in `views`; ValueError if it lacks one that has points in common.
        views: detections by camera; points of one moment and one index are common.

    Returns:
        Errors in undistorted pixels, one for each common point within both lens models; pairs without such
        points are absent.
    """
    errors = {}
    for a, b in combinations(views, 2):
        parts = []
        for key in views[a].seen:
            if key in views[b].seen:
                seen_by_a, seen_by_b = views[a].seen[key], views[b].seen[key]
                _, i, j = np.intersect1d(seen_by_a.ids, seen_by_b.ids, return_indices=True)
                parts.append((seen_by_a.x[i], seen_by_b.x[j]))
        if not any(len(x) for x, _ in parts):
            continue
        xa, xb = (torch.from_numpy(np.concatenate(points)) for points in zip(*parts))
        pair, reverse = rig.pair(a, b), rig.pair(b, a)
        (pa, va), (pb, vb) = pair.alpha.undistort(xa), pair.beta.undistort(xb)
        forward = epipolar_distance(pair.fundamental, pa, pb).abs()
        backward = epipolar_distance(reverse.fundamental, pb, pa).abs()
        if (valid := va & vb).any():
            errors[a, b] = ((forward + backward) / 2)[valid].numpy()
    return errors


# Frames held out --------------------------------------------------------------------------------------------


def held_out_errors(
    fit: Solved, views: Mapping[str, BoardViews]
) -> dict[tuple[str, str], Float[np.ndarray, " _"]]:
    """Compute epipolar errors of shared frames, each by a rig calibrated without it (in `FOLDS` parts).

    Returns:
        Errors by pair, undistorted pixels; empty if fewer than `FEWEST_TO_HOLD_OUT` frames are seen by two
        cameras or more, or a camera would keep fewer than `FEWEST_LEFT`.
    """
    frames = fit.problem.frames
    shared = [key for key in frames if sum(key in v.seen for v in views.values()) > 1]
    if len(shared) < FEWEST_TO_HOLD_OUT:
        return {}
    by_pair = dict[tuple[str, str], list[np.ndarray]]()
    for fold in range(FOLDS):
        out = set(shared[fold::FOLDS])
        if any(len(v.seen.keys() - out) < FEWEST_LEFT for v in views.values()):
            return {}
        used = readjusted(fit.problem.of_boards(np.array([key not in out for key in frames])))
        judged = {name: v.only(out) for name, v in views.items()}
        for names, errors in epipolar_errors(Rig(used.cameras), judged).items():
            by_pair.setdefault(names, []).append(errors)
    return {names: np.concatenate(errors) for names, errors in by_pair.items()}


def half_difference(fit: Solved, depth: float) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Compare the fit to every other frame with the fit to the rest.

    Args:
        depth: depth at which projections are compared, metres.

    Returns:
        By camera, pixels (n, 2) near points of both halves, possibly none, and how far projections differ
        there (n, 2), pixels, after the motion of the camera that keeps its boards where they were; empty for
        fewer than `FEWEST_TO_HALVE` frames, a camera without a board in one half, or a failing fit.
    """
    count = len(fit.problem.frames)
    even = np.arange(count) % 2 == 0
    parts = [fit.problem.of_boards(half) for half in (even, ~even)]
    if count < FEWEST_TO_HALVE or not all(
        len(observed.x) for half in parts for observed in half.seen.values()
    ):
        return {}
    try:
        halves = [readjusted(half) for half in parts]
    except np.linalg.LinAlgError:
        return {}
    differences = {}
    for name in fit.problem.cameras:
        (a, observed), (b, _) = (in_own_frame(half, name) for half in halves)
        motion = compensation(camera_jacobian(a, observed)[..., :6], _difference(a, b, observed))
        x, X = grid_points(a, depth)
        near = np.logical_and(*(covered(x, half.seen[name].x, a.hw) for half in halves))
        x, X = x[near], X[near]
        differences[name] = x, _difference(a, b, X) - (camera_jacobian(a, X)[..., :6] @ motion)[..., 0]
    return differences


def _difference(a: Camera, b: Camera, X: np.ndarray) -> Float[np.ndarray, "n 2"]:
    xa, xb = (camera.project_local(torch.from_numpy(X)).x.numpy() for camera in (a, b))
    return np.asarray(xb - xa)


@dataclass(frozen=True)
class LensComparison:
    """Errors of several lens models of one camera on held-out frames.

    Attributes:
        errors: mean square error of a coordinate (pixels²) of each frame, with the board's pose fitted and
            its freedom allowed for, by model that fits all frames; empty for too few frames.
    """

    errors: Mapping[Lens, Float[np.ndarray, " f"]]

    def rms(self, lens: Lens) -> float:
        """Return the held-out error of a model along x or y, pixels."""
        return float(np.sqrt(self.errors[lens].mean()))

    @property
    def advised(self) -> Lens:
        """First model as good as the best, to a standard error or 1 %; brown-conrady without errors."""
        if not self.errors:
            return "brown-conrady"
        best = min(self.errors, key=self.rms)
        return next(lens for lens in COMPARED if lens in self.errors and self._equal(lens, best))

    def _equal(self, lens: Lens, best: Lens) -> bool:
        worse = self.errors[lens] - self.errors[best]
        error = float(worse.std(ddof=1)) / len(worse) ** 0.5
        return float(worse.mean()) <= max(error, 2 * EQUAL * float(self.errors[best].mean()))

    @property
    def advice(self) -> str:
        """Advised model and all errors, in a sentence."""
        if not self.errors:
            return f"too few frames to compare lenses (fewer than {FEWEST_TO_COMPARE}): brown-conrady is used"
        listed = ", ".join(f"{lens} {self.rms(lens):.3f}" for lens in COMPARED if lens in self.errors)
        return f"the images support the lens model {self.advised} (error on held-out frames, px: {listed})"


def compare_lenses(views: Mapping[str, BoardViews], board: Board) -> dict[str, LensComparison]:
    """Compare the lens models of each camera on frames that they were not fitted to.

    Models that contradict frames which others fit are left out.

    Returns:
        Comparisons by camera, without errors for fewer than `FEWEST_TO_COMPARE` frames.

    Raises:
        ValueError: if a camera with enough frames cannot be calibrated with the usual model, brown-conrady.
    """
    return {name: _compared(name, v, board) for name, v in views.items()}


def _compared(name: str, views: BoardViews, board: Board) -> LensComparison:
    """Errors of each lens model on held-out frames; empty for too few frames."""
    if len(views.seen) < FEWEST_TO_COMPARE:
        return LensComparison({})
    inliers = calibrate_single(name, views, board, final=False).views[name]
    fitted: dict[Lens, BundleProblem] = {}
    for lens in COMPARED:
        with suppress(ValueError):  # it does not fit at all, as a fisheye's model of a long lens may
            fitted[lens] = calibrate_single(name, inliers, board, lens=lens, final=False).problem
    frames = max((problem.frames for problem in fitted.values()), key=len, default=())
    parts = [np.arange(len(frames)) % LENS_FOLDS == fold for fold in range(LENS_FOLDS)]
    return LensComparison(
        {
            lens: np.concatenate([_held_out(problem, held_out) for held_out in parts])
            for lens, problem in fitted.items()
            if problem.frames == frames
        }
    )


def _held_out(problem: BundleProblem, out: np.ndarray) -> Float[np.ndarray, " f"]:
    """Mean square errors of the frames in `out`, their boards' poses fitted, by a camera of the others."""
    fitted, judged = readjusted(problem.of_boards(~out)), problem.of_boards(out)
    (name,) = fitted.cameras
    if fitted.deformation is not None and judged.deformation is not None:
        judged = replace(judged, deformation=replace(fitted.deformation, part=judged.deformation.part))
    observed = Observations(judged.seen[name].block, judged.on_board(name), judged.seen[name].x)
    fixed = {name: np.zeros(len(judged.free[name]), dtype=bool)}
    posed = replace(
        judged, cameras=fitted.cameras, seen={name: observed}, free=fixed, priors={}, deformation=None
    )
    squares = (readjusted(posed).residuals[name] ** 2).sum(-1)
    count = np.bincount(observed.block)
    return np.asarray(np.bincount(observed.block, squares) / np.maximum(2 * count - POSE, 1))


# Notes ------------------------------------------------------------------------------------------------------


def left_out_notes(
    detected: Mapping[str, BoardViews], singles: Mapping[str, Solved], solved: Solved
) -> Iterator[str]:
    """Yield notes on images and points that were left out.

    Args:
        detected: all detections by camera.
        singles: solution of each camera alone, of all in `detected`.
        solved: solution of all cameras together.

    Yields:
        Sentences "camera: note".
    """
    for name, v in detected.items():
        used = singles[name].views[name]
        if rejected := [str(key) for key in v.seen if key not in used.seen]:
            yield f"{name}: left out {', '.join(rejected)}: the detected board does not fit the camera"
        yield from _points_left_out(name, v, used)
        if inconsistent := [str(key) for other, key in solved.left_out if other == name]:
            yield f"{name}: left out {', '.join(inconsistent)}: they contradict the other cameras' images"


def start_notes(
    detected: Mapping[str, BoardViews], solved: Solved, deviations: StartDeviations, lens: Mapping[str, Lens]
) -> Iterator[str]:
    """Yield notes on a calibration from a start rig.

    Args:
        detected: detections by camera before outliers were left out.
        solved: solution with priors about the start.
        deviations: standard deviations about the start.
        lens: lens model by camera that was asked for.

    Yields:
        Sentences on gains by the images (if there is a covariance), lenses, distance from the start, and
        images and points left out.
    """
    if solved.covariance is not None:
        yield _gains(solved, deviations)
    for name, camera in solved.problem.cameras.items():
        if (distortion := camera.distortion) is not None and distortion.model != LENSES[lens[name]][0]:
            yield f"{name}: keeps the start's lens, {distortion.model}"
    yield from _far(solved)
    for name, key in solved.left_out:
        yield f"{name}: left out {key}: its board contradicts the start"
    for name, used in solved.views.items():
        yield from _points_left_out(name, detected[name], used)


def _points_left_out(name: str, detected: BoardViews, used: BoardViews) -> Iterator[str]:
    """Note on points that were left out as outliers, most of an image first."""
    counts = {
        key: len(d.ids) - len(used.seen[key].ids) for key, d in detected.seen.items() if key in used.seen
    }
    worst = sorted((key for key in counts if counts[key]), key=lambda key: -counts[key])
    if worst:
        listed = named([f"{counts[key]} of {key}" for key in worst], 5)
        yield f"{name}: {sum(counts.values())} of {detected.count} points left out as outliers ({listed})"


def _gains(fit: Solved, deviations: StartDeviations) -> str:
    """Sentence on how the images reduce the start's deviations, by kind of parameter."""
    focal = np.mean([intrinsic_values(c)[6] for c in fit.problem.cameras.values()])
    width = np.mean([c.hw[1] for c in fit.problem.cameras.values()])
    stated = (
        ("focal", "focal lengths", deviations.focal * focal),
        ("centre", "principal points", deviations.centre * width),
    )
    texts = []
    for kind, label, before in stated:
        after = [d for name, d in fit.deviations.items() if f".{kind}." in name]
        texts += [f"{label} ±{before:.3g} > ±{np.median(after):.3g} px"] if after else []
    positions = np.median(_position_deviations(fit))
    texts.append(f"positions ±{1e3 * deviations.position:.3g} > ±{1e3 * positions:.3g} mm")
    return f"held to the start; standard deviations stated > with the images: {', '.join(texts)}"


def _position_deviations(fit: Solved) -> list[float]:
    """Standard deviation of each camera's optical centre, root mean square of the axes, metres."""
    assert fit.covariance is not None
    deviations = []
    for name, camera in fit.problem.cameras.items():
        derivatives = camera.cam_from_world.centre_jacobian.numpy()
        first = fit.names.index(f"{name}.rotation.0")
        pose = slice(first, first + 6)
        covariance = derivatives @ fit.covariance[pose, pose] @ derivatives.T
        deviations.append(float(np.sqrt(np.trace(covariance) / 3)))
    return deviations


def _far(fit: Solved) -> Iterator[str]:
    """Notes on cameras that lie far from the start."""
    for name, camera in fit.problem.cameras.items():
        prior = fit.problem.priors[name]
        ratio = np.abs(prior.residual(camera)) / np.sqrt(np.linalg.inv(prior.information).diagonal())
        parts = [ratios.max() for ratios in np.split(ratio[:10], [3, 6, 8])]
        kinds = zip(("orientation", "position", "focal length", "principal point"), parts)
        if far := [f"{kind} ({worst:.0f} deviations)" for kind, worst in kinds if worst > FAR_FROM_START]:
            listed = ", ".join(far)
            yield f"{name}: far from the start: {listed}: is the start right, or its deviations too small?"
