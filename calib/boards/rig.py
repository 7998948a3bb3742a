"""A calibrated rig from detected board points, with its accuracy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from arraygeom import Camera, Rig
from arraygeom.threads import torch_in_one_thread

from .board import Board
from .bundle import Solved, adjust
from .detect import BoardViews
from .intrinsics import Lens, SingleCalibration, calibrate_single, near_fit
from .parameters import (
    CameraPrior,
    StartDeviations,
    centre_derivatives,
    intrinsic_values,
    parameter_names,
    start_prior,
)
from .photos import FrameKey
from .poses import InitialRig, initial_rig, rig_near_start, start_cameras
from .solve import board_problem, flat_boards, solve, with_disagreement
from .validation import epipolar_errors, held_out_errors, misfit_notes, misfits

SYNCHRONISED = "taken at the same moments, with matching numbers, not mirrored, with a stiff board"
INCONSISTENT, REJECTED = 3.0, 20.0
"""Ratios of joint to single RMS from which a camera is inconsistent with the others, or refused."""
MANY_WRONG = 0.34
"""The share of a camera's images that may be left out, in all, because they contradict the others."""
FAR_FROM_START = 4.0
"""Standard deviations from the start beyond which a camera is named."""


@dataclass(frozen=True)
class Calibration:
    """A rig with its accuracy.

    fit: result of the bundle adjustment. views: the detections used, numbered consistently in all cameras.
    single: each camera's reprojection error (RMS, px) when it is calibrated by itself; none with a start.
    """

    rig: Rig
    board: Board
    fit: Solved
    views: Mapping[str, BoardViews]
    single: Mapping[str, float]
    epipolar: Mapping[tuple[str, str], Float[np.ndarray, "_"]]
    notes: tuple[str, ...] = field(default=())

    @property
    def frames(self) -> tuple[FrameKey, ...]:
        """The moments of the boards' poses."""
        return self.fit.problem.frames

    @property
    def rms(self) -> float:
        """The reprojection error of all points of all images, pixels, outliers included."""
        return self.fit.problem.rms()

    @property
    def raised(self) -> float:
        """The largest factor by which a standard deviation was raised to that of a jackknife over frames."""
        return self.fit.raised

    @cached_property
    def held_out(self) -> dict[tuple[str, str], Float[np.ndarray, "_"]]:
        """By pair: epipolar errors (pixels) of all frames, each by a rig calibrated without it; empty if too few."""
        return held_out_errors(self.fit, self.views)

    def deviations(self) -> dict[str, float]:
        """The standard deviation of each free parameter by name ("left.focal.0"), in its own unit."""
        assert self.fit.covariance is not None
        return dict(zip(self.fit.names, np.sqrt(self.fit.covariance.diagonal()).tolist()))


@torch_in_one_thread()
def calibrate(
    views: Mapping[str, BoardViews],
    board: Board,
    *,
    lens: Lens | Mapping[str, Lens] = "brown-conrady",
    start: Rig | None = None,
    deviations: StartDeviations | None = None,
) -> Calibration:
    """Calibrate a rig from detected board points. Its world is the first camera.

    `lens` is the model of all cameras, or of each by name. Raises ValueError, with advice, if a camera has too few
    images or only parallel boards, if cameras are not connected, or if their frames contradict each other.
    With `start`, a rig known to within `deviations`, one image of each camera is enough, and the world is the start's.
    """
    models = {name: lens if isinstance(lens, str) else lens[name] for name in views}
    if start is not None:
        return _from_start(start_cameras(start, views, models), views, board, deviations or StartDeviations())
    alone = {
        name: calibrate_single(name, v, board, lens=models[name], final=len(views) == 1) for name, v in views.items()
    }
    initial = initial_rig([a.seen for a in alone.values()], board)
    if len(alone) == 1:
        (only,) = alone.values()
        solved = only.solved
    else:
        solved, initial = _joint_fit(initial, board, alone)
    left_out = _images_left_out(views, alone, initial.left_out)
    return _finished(replace(solved, notes=(*left_out, *solved.notes)), initial.views, board, alone)


def _finished(
    solved: Solved, views: Mapping[str, BoardViews], board: Board, alone: Mapping[str, SingleCalibration]
) -> Calibration:
    """The calibration by a fit of all cameras, with its errors."""
    solved = with_disagreement(solved, board.extents, unchecked=bool(alone) and board.flat)
    rig, single = Rig(solved.problem.cameras), {name: a.rms for name, a in alone.items()}
    notes = (*solved.notes, *misfit_notes(solved))
    return Calibration(rig, board, solved, views, single, epipolar_errors(rig, views), notes)


# All cameras --------------------------------------------------------------------------------------------------


def _joint_fit(initial: InitialRig, board: Board, alone: Mapping[str, SingleCalibration]) -> tuple[Solved, InitialRig]:
    """All cameras at once; if they fit far worse than alone, with their single calibrations as priors.

    Boards that move between the exposures of unsynchronised cameras would distort the lens models otherwise. A few
    images that contradict the others (boards detected a square off, say) are left out.
    """
    problem = board_problem(initial.cameras, initial.boards, initial.views, board)
    solved = solve(problem, flat_boards(board, initial.boards, initial.views))
    if wrong := _wrong_images(solved, initial, alone):
        return _joint_fit(initial.without(wrong), board, alone)
    if not (doubts := _inconsistent_cameras(solved, alone)):
        return solved, initial
    priors = {name: _as_prior(name, a) for name, a in alone.items()}
    free = {name: prior.information.diagonal() > 0 for name, prior in priors.items()}
    for index, mask in enumerate(free.values()):
        mask[:6] = index > 0
    held = replace(problem, priors=priors, deformation=solved.problem.deformation, free=free)
    notes = [note for a in alone.values() for note in a.solved.notes]
    notes.append(f"{doubts}; so each camera's intrinsics keep close to its own calibration")
    return replace(adjust(held, equal_noise=True), notes=tuple(notes)), initial


def _wrong_images(
    solved: Solved, initial: InitialRig, alone: Mapping[str, SingleCalibration]
) -> list[tuple[str, FrameKey]]:
    """Images so far off that their camera would be refused, one of a moment, unless they are many of a camera's."""
    found = dict[FrameKey, str]()
    for misfit in misfits(solved):
        if misfit.rms > _refused_from(alone[misfit.camera]):
            found.setdefault(misfit.frame, misfit.camera)
    seen = {name: len(v.seen) for name, v in initial.views.items()}
    many = many_wrong(list(found.values()), [name for name, _ in initial.left_out], seen)
    return [] if many else [(camera, frame) for frame, camera in found.items()]


def many_wrong(found: Sequence[str], before: Sequence[str], seen: Mapping[str, int]) -> bool:
    """Whether images found wrong, and those left out before (the camera of each), are more than `MANY_WRONG` of all of
    a camera's; `seen` are those that are left of it."""
    return any(found.count(n) + before.count(n) > MANY_WRONG * (seen[n] + before.count(n)) for n in set(found))


def _refused_from(alone: SingleCalibration) -> float:
    """The reprojection error (RMS, px) with the other cameras from which a camera contradicts them."""
    return REJECTED * max(alone.rms, 0.3)


def _inconsistent_cameras(solved: Solved, alone: Mapping[str, SingleCalibration]) -> str:
    """Text on cameras that fit much worse together than alone, or "". Raises ValueError if far worse."""
    doubts = []
    for name, r in solved.problem.residuals().items():
        together, by_itself = float(np.sqrt((r**2).sum(-1).mean())), alone[name].rms
        fits = f"{name} fits to {by_itself:.2f} px alone but to {together:.2f} px with the others"
        if together > _refused_from(alone[name]):
            raise ValueError(f"{fits}: were the images {SYNCHRONISED}?")
        if together > 0.5 and together > INCONSISTENT * by_itself:
            doubts.append(fits)
    return f"{', '.join(doubts)} (were the images {SYNCHRONISED}?)" if doubts else ""


def _as_prior(name: str, alone: SingleCalibration) -> CameraPrior:
    """The single calibration of a camera as a prior of its intrinsics; none for parameters that were fixed."""
    entries, covariance = parameter_names(alone.camera), alone.solved.covariance
    free = [entries.index(entry.removeprefix(f"{name}.")) for entry in alone.solved.names]
    information = np.zeros((len(entries), len(entries)))
    if covariance is not None:
        information[np.ix_(free, free)] = np.linalg.inv(covariance)
    return CameraPrior(intrinsic_values(alone.camera), information)


def _images_left_out(
    views: Mapping[str, BoardViews], alone: Mapping[str, SingleCalibration], left_out: list[tuple[str, FrameKey]]
) -> Iterator[str]:
    for name, v in views.items():
        used = alone[name].seen.views
        if rejected := [str(key) for key in v.seen if key not in used.seen]:
            yield f"{name}: left out {', '.join(rejected)}: the detected board does not fit the camera"
        yield from _points_left_out(name, v, used)
        if inconsistent := [str(key) for other, key in left_out if other == name]:
            yield f"{name}: left out {', '.join(inconsistent)}: they contradict the other cameras' images"


def _points_left_out(name: str, detected: BoardViews, used: BoardViews) -> Iterator[str]:
    """A note on points that were left out as outliers, most of an image first."""
    counts = {key: len(d.ids) - len(used.seen[key].ids) for key, d in detected.seen.items() if key in used.seen}
    worst = sorted((key for key in counts if counts[key]), key=lambda key: -counts[key])
    if worst:
        listed = ", ".join(f"{counts[key]} of {key}" for key in worst[:5]) + (", ..." if len(worst) > 5 else "")
        yield f"{name}: {sum(counts.values())} of {detected.count} points left out as outliers ({listed})"


# From a start -------------------------------------------------------------------------------------------------


def _from_start(
    cameras: Mapping[str, Camera], views: Mapping[str, BoardViews], board: Board, deviations: StartDeviations
) -> Calibration:
    """Calibrate cameras with their start as a prior, all at once."""
    initial = rig_near_start(cameras, views, board)
    priors = {name: start_prior(camera, deviations) for name, camera in cameras.items()}
    flat = flat_boards(board, initial.boards, initial.views)
    solved = solve(board_problem(initial.cameras, initial.boards, initial.views, board, priors), flat)
    used = {name: near_fit(solved, name, v, board) for name, v in initial.views.items()}
    left_out = [note for name, v in initial.views.items() for note in _points_left_out(name, v, used[name])]
    if left_out:
        problem = solved.problem
        solved = solve(board_problem(problem.cameras, problem.board_poses, used, board, priors), flat)
    far = [f"{name}: left out {key}: its board contradicts the start" for name, key in initial.left_out]
    notes = (_gains(solved, deviations), *_far(solved), *far, *left_out, *solved.notes)
    return _finished(replace(solved, notes=notes), used if left_out else initial.views, board, {})


def _gains(fit: Solved, deviations: StartDeviations) -> str:
    """What the images add to the start, by kind of parameter."""
    assert fit.covariance is not None
    after = dict(zip(fit.names, np.sqrt(fit.covariance.diagonal()).tolist()))
    focal = np.mean([float(c.K[0, 0]) for c in fit.problem.cameras.values()])
    width = np.mean([c.hw[1] for c in fit.problem.cameras.values()])
    kinds = {
        "focal": ("focal lengths", deviations.focal * focal),
        "centre": ("principal points", deviations.centre * width),
    }
    texts = []
    for kind, (label, before) in kinds.items():
        found = [d for name, d in after.items() if f".{kind}." in name]
        texts += [f"{label} ±{before:.3g} > ±{np.median(found):.3g} px"] if found else []
    positions = np.median(_position_deviations(fit))
    texts.append(f"positions ±{1e3 * deviations.position:.3g} > ±{1e3 * positions:.3g} mm")
    return f"held to the start; standard deviations stated > with the images: {', '.join(texts)}"


def _position_deviations(fit: Solved) -> list[float]:
    """Of each camera's optical centre, root mean square of the axes, metres."""
    assert fit.covariance is not None
    found = []
    for name, camera in fit.problem.cameras.items():
        mine = [fit.names.index(f"{name}.{kind}.{i}") for kind in ("rotation", "translation") for i in range(3)]
        derivatives = centre_derivatives(camera)
        covariance = derivatives @ fit.covariance[np.ix_(mine, mine)] @ derivatives.T
        found.append(float(np.sqrt(np.trace(covariance) / 3)))
    return found


def _far(fit: Solved) -> list[str]:
    """Which cameras lie far from the start."""
    notes = []
    for name, camera in fit.problem.cameras.items():
        prior = fit.problem.priors[name]
        ratio = np.abs(prior.offset(camera)) / np.sqrt(np.linalg.inv(prior.information).diagonal())
        parts = np.split(ratio[:10], [3, 6, 8])
        kinds = zip(("orientation", "position", "focal length", "principal point"), (part.max() for part in parts))
        if far := [f"{kind} ({worst:.0f} deviations)" for kind, worst in kinds if worst > FAR_FROM_START]:
            listed = ", ".join(far)
            notes.append(f"{name}: far from the start: {listed}: is the start right, or its deviations too small?")
    return notes
