"""A calibrated rig from detected board points, with its accuracy."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from arraygeom import Camera, Pose, Rig, stack
from arraygeom.threads import torch_in_one_thread

from .board import Board
from .bundle import BoardPoses, BundleProblem, BundleResult, Free, Observations, adjust, loss, noise
from .camera_parameters import CameraPrior, intrinsic_values, parameter_names
from .intrinsics import BoardViews, InitialCamera, Lens, calibrate_camera, check_tilts, without_outliers
from .jackknife import jackknife
from .known_points import KnownPoints
from .observability import gate, typical_prior
from .photos import FrameKey
from .poses import CalibratedViews, InitialRig, initial_rig
from .shape import LEAST_GAIN, BoardShape, described, fewest_frames, is_significant
from .start import StartDeviations, rig_near_start, start_cameras, start_notes, start_prior
from .validation import epipolar_errors, held_out_errors, misfit_notes, misfits

SYNCHRONISED = "taken at the same moments, with matching numbers, not mirrored, with a stiff board"
INCONSISTENT, REJECTED = 3.0, 20.0
"""Ratios of joint to single RMS from which a camera is inconsistent with the others, or refused."""
MANY_WRONG = 0.34
"""The share of a camera's images that may be left out, in all, because they contradict the others."""
FEWEST_TO_JACKKNIFE = 6
CONSIDERABLE = 1.3
"""Standard deviations are raised if the jackknife's are larger by this."""
ROUNDS = 3
"""Times that parameters and outliers may return."""


@dataclass(frozen=True)
class Calibration:
    """A rig with its accuracy.

    fit: result of the bundle adjustment; its blocks are `frames` in order.
    single: each camera's reprojection error (RMS, px) when it is calibrated by itself; none with a start.
    views: the detections used, numbered consistently in all cameras.
    raised: the largest factor by which a standard deviation was raised to that of a jackknife over frames.
    """

    rig: Rig
    board: Board
    fit: BundleResult
    frames: tuple[FrameKey, ...]
    views: Mapping[str, BoardViews]
    single: Mapping[str, float]
    epipolar: Mapping[tuple[str, str], Float[np.ndarray, "_"]]
    notes: tuple[str, ...] = field(default=())
    raised: float = 1.0

    @property
    def rms(self) -> float:
        """The reprojection error of all points of all images, pixels, outliers included."""
        return self.fit.problem.rms()

    @cached_property
    def held_out(self) -> dict[tuple[str, str], Float[np.ndarray, "_"]]:
        """By pair: epipolar errors (pixels) of all frames, each by a rig calibrated without it; empty if too few."""
        return held_out_errors(self.fit, self.frames, self.views)

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
    single = {
        name: calibrate_single(name, v, board, lens=models[name], final=len(views) == 1) for name, v in views.items()
    }
    alone = [CalibratedViews(name, a.camera, a.views, a.cam_from_board) for name, a in single.items()]
    initial = initial_rig(alone, board)
    cameras = {name: a.camera.replace(cam_from_world=initial.cam_from_world[name]) for name, a in single.items()}
    fit, notes, initial = _joint_fit(initial, cameras, board, single)
    notes = [*_images_left_out(views, single, initial.left_out), *notes]
    return _finished(*_scaled_covariance(fit), initial, board, single, notes)


def _from_start(
    cameras: Mapping[str, Camera], views: Mapping[str, BoardViews], board: Board, deviations: StartDeviations
) -> Calibration:
    """Calibrate cameras with their start as a prior, all at once."""
    initial = rig_near_start(cameras, views, board)
    priors = {name: start_prior(camera, deviations) for name, camera in cameras.items()}
    placed = {name: c.replace(cam_from_world=initial.cam_from_world[name]) for name, c in cameras.items()}
    detected, flat = initial.views, _flat(board, initial.world_from_board, initial.views)
    problem = replace(_problem(placed, initial.world_from_board, detected, board), priors=priors)
    fit, notes = _fitted(problem, flat)
    used = {name: _near_fit(fit, name, v, initial.world_from_board, board) for name, v in detected.items()}
    if left_out := [note for name, v in detected.items() for note in _points_left_out(name, v, used[name])]:
        initial = initial._replace(views=used)
        boards = fit.problem.board_poses(initial.world_from_board)
        fit, notes = _fitted(replace(_problem(fit.problem.cameras, boards, used, board), priors=priors), flat)
    far = (f"{name}: left out {key}: its board contradicts the start" for name, key in initial.left_out)
    fit, factor = _scaled_covariance(fit)
    return _finished(fit, factor, initial, board, {}, [*start_notes(fit, deviations), *far, *left_out, *notes])


def _near_fit(fit: BundleResult, name: str, views: BoardViews, frames: Iterable[FrameKey], board: Board) -> BoardViews:
    """A camera's views without the points that a fit shows to be outliers; `frames` are those of its blocks."""
    camera, boards = fit.problem.cameras[name], fit.problem.board_poses(frames)
    poses = {key: camera.cam_from_world @ boards[key] for key in views.seen}
    points = board.points if fit.problem.shape is None else fit.problem.shape.deformed(board.points, board.part)
    return without_outliers(views, camera, poses, points, sigma=fit.sigma[name])


def _finished(
    fit: BundleResult,
    factor: float,
    initial: InitialRig,
    board: Board,
    single: Mapping[str, SingleCalibration],
    notes: Iterable[str],
) -> Calibration:
    """The calibration by a fit of all cameras, with its errors, and notes after those given."""
    rig, frames = Rig(fit.problem.cameras), tuple(initial.world_from_board)
    return Calibration(
        rig=rig,
        board=board,
        fit=fit,
        frames=frames,
        views=initial.views,
        single={name: a.fit.problem.rms() for name, a in single.items()},
        epipolar=epipolar_errors(rig, initial.views),
        notes=(*notes, *_shape_notes(fit, board), *misfit_notes(fit, frames), *_noted(factor)),
        raised=factor,
    )


class SingleCalibration(NamedTuple):
    """One camera calibrated by itself, in its own frame; `views` are the images used."""

    fit: BundleResult
    views: BoardViews
    frames: tuple[FrameKey, ...]
    notes: tuple[str, ...]

    @property
    def camera(self) -> Camera:
        """The camera, at the origin."""
        return next(iter(self.fit.problem.cameras.values()))

    @property
    def cam_from_board(self) -> dict[FrameKey, Pose]:
        """The board's pose in the camera by moment."""
        return self.fit.problem.board_poses(self.frames)


def calibrate_single(
    name: str, views: BoardViews, board: Board, *, lens: Lens = "brown-conrady", final: bool = True
) -> SingleCalibration:
    """One camera's intrinsics and lens from its own images. Raises ValueError as `calibrate` does.

    Unless `final`, a poorly constrained focal length is accepted, as other cameras will add constraints.
    """
    start = calibrate_camera(name, views, board, lens=lens)
    kept = _without_outliers(views, start)
    if len(kept.seen) < len(views.seen):
        start = calibrate_camera(name, kept, board, lens=lens)
    camera, poses = start.camera, start.cam_from_board
    used = without_outliers(kept, camera, poses, board.points)
    flat = _flat(board, poses, {name: kept})
    shape = None
    for _ in range(ROUNDS):
        problem = replace(_problem({name: camera}, poses, {name: used}, board), shape=shape)
        fit, notes = _fitted(problem, flat, final=final)
        camera, poses, shape = fit.problem.cameras[name], fit.problem.board_poses(poses), fit.problem.shape
        before, used = used, _near_fit(fit, name, kept, poses, board)
        if _count_points(used) == _count_points(before):
            break
    found = SingleCalibration(fit, before, tuple(poses), tuple(notes))
    check_tilts(name, found.cam_from_board, board)
    return found


def _scaled_covariance(fit: BundleResult) -> tuple[BundleResult, float]:
    """The fit with its covariance raised if frames disagree considerably; and the largest factor of its deviations.

    The raised covariance is the mean of the jackknife's, which few frames make noisy, and of that of the points' noise,
    scaled to the jackknife's level: the median over the parameters, as frames that disagree about a focal length say
    nothing of the lens.
    """
    if fit.covariance is None or not len(fit.covariance) or len(fit.problem.structure) < FEWEST_TO_JACKKNIFE:
        return fit, 1.0
    found = jackknife(fit.problem, fit.free(), fit.sigma)
    disagreement = float(np.sqrt(np.trace(np.linalg.solve(fit.covariance, found.covariance)) / len(fit.covariance)))
    if disagreement < CONSIDERABLE:
        return fit, 1.0
    level = max(1.0, float(np.median(_ratio(found.left_out, fit.covariance))))
    raised = (level**2 * fit.covariance + found.left_out) / 2
    return fit._replace(covariance=raised), float(_ratio(raised, fit.covariance).max())


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of the standard deviations of two covariances."""
    return np.asarray(np.sqrt(a.diagonal() / b.diagonal()))


def _noted(factor: float) -> list[str]:
    if factor == 1.0:
        return []
    return [
        "frames disagree more than the points' noise explains: standard deviations are raised, by up to "
        f"{factor:.1f}, to those of a jackknife over frames (is the board flat and printed true to size, and were the "
        "images sharp?)"
    ]


def _shape_notes(fit: BundleResult, board: Board) -> list[str]:
    """What the boards were found to be shaped like, if not flat."""
    shape = fit.problem.shape
    if shape is None:
        return []
    covariance = jackknife(fit.problem, fit.free(), fit.sigma).shapes
    return described(shape, np.sqrt(covariance.diagonal()).reshape(shape.values.shape), board.extents)


def _joint_fit(
    initial: InitialRig, cameras: Mapping[str, Camera], board: Board, single: Mapping[str, SingleCalibration]
) -> tuple[BundleResult, list[str], InitialRig]:
    """All cameras at once, with notes; if they fit far worse than alone, with their single calibrations as priors.

    Boards that move between the exposures of unsynchronised cameras would distort the lens models otherwise. A few
    images that contradict the others (boards detected a square off, say) are left out.
    """
    if len(cameras) == 1:
        (only,) = single.values()
        return only.fit, list(only.notes), initial
    problem = _problem(cameras, initial.world_from_board, initial.views, board)
    fit, notes = _fitted(problem, _flat(board, initial.world_from_board, initial.views))
    if wrong := _wrong_images(fit, initial, single):
        return _joint_fit(initial.without(wrong), cameras, board, single)
    if not (doubts := _inconsistent_cameras(fit, single)):
        return fit, notes, initial
    priors = {name: _as_prior(name, a) for name, a in single.items()}
    free = {name: priors[name].information.diagonal() > 0 for name in problem.cameras}
    for index, mask in enumerate(free.values()):
        mask[:6] = index > 0
    fit = adjust(replace(problem, priors=priors, shape=fit.problem.shape), free, equal_noise=True)
    kept = "so each camera's intrinsics keep close to its own calibration"
    notes = [note for a in single.values() for note in a.notes]
    return fit, [*notes, f"{doubts}; {kept}"], initial


def _wrong_images(
    fit: BundleResult, initial: InitialRig, single: Mapping[str, SingleCalibration]
) -> list[tuple[str, FrameKey]]:
    """Images so far off that their camera would be refused, one of a moment, unless they are many of a camera's."""
    frames, found = tuple(initial.world_from_board), dict[FrameKey, str]()
    for m in misfits(fit):
        if m.rms > _refused_from(single[m.camera]):
            found.setdefault(frames[m.block], m.camera)
    seen = {name: len(v.seen) for name, v in initial.views.items()}
    many = many_wrong(list(found.values()), [name for name, _ in initial.left_out], seen)
    return [] if many else [(camera, frame) for frame, camera in found.items()]


def many_wrong(found: Sequence[str], before: Sequence[str], seen: Mapping[str, int]) -> bool:
    """Whether images found wrong, and those left out before (the camera of each), are more than `MANY_WRONG` of all of
    a camera's; `seen` are those that are left of it."""
    return any(found.count(n) + before.count(n) > MANY_WRONG * (seen[n] + before.count(n)) for n in set(found))


def _refused_from(single: SingleCalibration) -> float:
    """The reprojection error (RMS, px) with the other cameras from which a camera contradicts them."""
    return REJECTED * max(single.fit.problem.rms(), 0.3)


def _as_prior(name: str, single: SingleCalibration) -> CameraPrior:
    """The single calibration of a camera as a prior of its intrinsics; none for parameters that were fixed."""
    fit, entries = single.fit, parameter_names(single.camera)
    free = [entries.index(entry.removeprefix(f"{name}.")) for entry in fit.names]
    information = np.zeros((len(entries), len(entries)))
    if fit.covariance is not None:
        information[np.ix_(free, free)] = np.linalg.inv(fit.covariance)
    return CameraPrior(intrinsic_values(single.camera), information)


def _count_points(views: BoardViews) -> int:
    return sum(len(d.ids) for d in views.seen.values())


def _without_outliers(views: BoardViews, start: InitialCamera) -> BoardViews:
    """The views without images whose reprojection error is far above the others'."""
    limit = max(2.0, 10 * float(np.median(list(start.rms.values()))))
    return BoardViews(views.hw, {key: d for key, d in views.seen.items() if start.rms[key] < limit})


def _problem(
    cameras: Mapping[str, Camera], boards: Mapping[FrameKey, Pose], views: Mapping[str, BoardViews], board: Board
) -> BundleProblem:
    index = {key: i for i, key in enumerate(boards)}
    seen = {name: _observations(v, index, board) for name, v in views.items()}
    priors = {name: typical_prior(camera) for name, camera in cameras.items()}
    return BundleProblem(cameras, BoardPoses(stack(list(boards.values()))), seen, priors)


def _flat(board: Board, boards: Iterable[FrameKey], views: Mapping[str, BoardViews]) -> BoardShape | None:
    """Flat boards, in the order of the blocks; None for points whose positions are known."""
    if isinstance(board, KnownPoints):
        return None
    first = {key: d.ids[0] for v in views.values() for key, d in v.seen.items()}
    return BoardShape.flat(board.points, board.part, board.part[[first[key] for key in boards]])


def _observations(views: BoardViews, index: Mapping[FrameKey, int], board: Board) -> Observations:
    parts = [(np.full(len(d.ids), index[key]), board.points[d.ids], d.x) for key, d in views.seen.items()]
    return Observations(*(np.concatenate(part) for part in zip(*parts)))


def _fitted(problem: BundleProblem, flat: BoardShape | None, *, final: bool = True) -> tuple[BundleResult, list[str]]:
    """Fit all observable parameters; those that turn out to be unobservable are fixed, until none is.

    Parameters fixed before the fit, when the noise was overestimated, may return after it; and boards that are clearly
    neither `flat` nor printed true get a shape.
    """
    full = {
        name: _free(camera, index > 0 or problem.priors[name].pose is not None)
        for index, (name, camera) in enumerate(problem.cameras.items())
    }
    problem, free, notes = gate(problem, full, noise(problem, 0), final=False)
    fit = _with_shape(adjust(problem, free), free, flat)
    for _ in range(ROUNDS):
        returned, more, changed = gate(fit.problem, full, fit.sigma, final=False)
        if all((more[name] == free[name]).all() for name in free):
            break
        problem, free, notes = returned, more, changed
        fit = _with_shape(adjust(problem, free), free, flat)
    while True:
        problem, free, dropped = gate(fit.problem, free, fit.sigma, final=final)
        if not dropped:
            return fit, notes
        notes, fit = notes + dropped, adjust(problem, free)


def _with_shape(fit: BundleResult, free: Free, flat: BoardShape | None) -> BundleResult:
    """The fit with the boards' shapes as unknowns if they matter, by the points and by how frames agree on them.

    Where frames are too few to agree, the loss must fall by half.
    """
    if flat is None or fit.problem.shape is not None:
        return fit
    trial, few = replace(fit.problem, shape=flat), len(flat.part) < fewest_frames(len(flat))
    try:
        found = jackknife(trial, free, fit.sigma)
        if not few and not is_significant(found.step, found.shapes, len(flat.part)):
            return fit
        shaped = adjust(trial, free)
    except np.linalg.LinAlgError:  # some parameters are not observable yet
        return fit
    left = loss(shaped.problem, shaped.sigma)
    gain = loss(fit.problem, shaped.sigma) - left
    return shaped if gain > (max(left, LEAST_GAIN) if few else LEAST_GAIN) else fit


def _free(camera: Camera, posed: bool) -> np.ndarray:
    """A mask of the camera's parameters: its pose if `posed`, K and the lens."""
    mask = np.ones(len(parameter_names(camera)), dtype=bool)
    mask[:6] = posed
    return mask


def _images_left_out(
    views: Mapping[str, BoardViews], single: Mapping[str, SingleCalibration], left_out: list[tuple[str, FrameKey]]
) -> list[str]:
    notes = []
    for name, v in views.items():
        if rejected := [str(key) for key in v.seen if key not in single[name].views.seen]:
            notes.append(f"{name}: left out {', '.join(rejected)}: the detected board does not fit the camera")
        notes += _points_left_out(name, v, single[name].views)
        if inconsistent := [str(key) for other, key in left_out if other == name]:
            notes.append(f"{name}: left out {', '.join(inconsistent)}: they contradict the other cameras' images")
    return notes


def _points_left_out(name: str, detected: BoardViews, used: BoardViews) -> list[str]:
    """A note on points that were left out as outliers, most of an image first."""
    counts = {key: len(d.ids) - len(used.seen[key].ids) for key, d in detected.seen.items() if key in used.seen}
    if not any(counts.values()):
        return []
    worst = sorted((key for key in counts if counts[key]), key=lambda key: -counts[key])
    listed = ", ".join(f"{counts[key]} of {key}" for key in worst[:5]) + (", ..." if len(worst) > 5 else "")
    return [f"{name}: {sum(counts.values())} of {_count_points(detected)} points left out as outliers ({listed})"]


def _inconsistent_cameras(fit: BundleResult, single: Mapping[str, SingleCalibration]) -> str:
    """Text on cameras that fit much worse together than alone, or "". Raises ValueError if far worse."""
    doubts = []
    for name, r in fit.problem.residuals().items():
        together, by_itself = float(np.sqrt((r**2).sum(-1).mean())), single[name].fit.problem.rms()
        fits = f"{name} fits to {by_itself:.2f} px alone but to {together:.2f} px with the others"
        if together > _refused_from(single[name]):
            raise ValueError(f"{fits}: were the images {SYNCHRONISED}?")
        if together > 0.5 and together > INCONSISTENT * by_itself:
            doubts.append(fits)
    return f"{', '.join(doubts)} (were the images {SYNCHRONISED}?)" if doubts else ""
