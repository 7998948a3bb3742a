"""Bundle adjustment of a calibration: observable parameters, board shapes, outliers.

Gauss-Newton with Marquardt's damping (Triggs et al. 2000).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from arraygeom import Pose
from arraygeom.robust import LocalModel, levenberg_marquardt

from .board import Board
from .bundle import (
    POSE,
    Array,
    BundleProblem,
    CameraPrior,
    InitialRig,
    Solved,
    intrinsic_values,
    linearised,
    normal_equations,
    parameter_names,
    robust_weights,
    typical_sizes,
    with_default,
)
from .deformation import LEAST_GAIN, BoardDeformation, is_significant
from .detect import BoardViews, named
from .intrinsics import (
    LEAST_SIGMA,
    RAYLEIGH_MEDIAN,
    Lens,
    initial_camera,
    without_bad_images,
    without_outliers,
)
from .photos import FrameKey
from .uncertainty import jackknife

LEAST_NOISE = 1e-3
"""Lower bound of the noise, pixels: perfect corners must not get infinite weight."""
CONVERGED = 1e-3
"""Decrease of the loss, in squared standard deviations, below which the iteration ends."""
DAMPING = 1e-4
"""Damping of the first step."""
POOLED = 50
"""Number of residuals of average noise that are added to each camera's own for its noise estimate."""
UNOBSERVABLE = 0.5
"""Share of a parameter's typical size above which its posterior deviation makes it unobservable."""
ROUNDS = 3
"""Times that parameters may return, and that outliers may change."""
MISFIT = 1.8
"""Ratio of a frame's residuals to those of the camera's median frame above which it may not fit,"""
CONSPICUOUS = 1.8
"""and ratio to the camera's noise, which it must exceed too."""
SYNCHRONISED = "taken at the same moments, with matching numbers, not mirrored, with a stiff board"
MOVED = 2.0
"""Ratio of an image's joint residuals to those of its camera alone above which it contradicts the others."""
INCONSISTENT, REJECTED = 3.0, 20.0
"""Ratios of joint to single RMS above which a camera is inconsistent with the others, or refused."""
LISTED = 5
"""Largest number of frames named."""
FEWEST_TILT = 8.0
"""Angle in degrees between boards' normals below which all count as parallel."""
MANY_WRONG = 0.34
"""Largest share of a camera's images that may be left out in all because they contradict the others."""


def calibrate_single(
    name: str, views: BoardViews, board: Board, *, lens: Lens = "brown-conrady", final: bool = True
) -> Solved:
    """Calibrate one camera's intrinsics and lens from its images.

    Args:
        name: name of the camera.
        views: its detections.
        lens: lens model.
        final: False accepts a poorly constrained focal length, as other cameras will add constraints.

    Returns:
        The solution, the camera at the origin; `views` has the images and points that were used.

    Raises:
        ValueError: with advice, for too few images, parallel boards, no camera that fits, or (`final`) an
            undetermined focal length.
        KeyError: as `initial_camera`.
    """
    first = initial_camera(name, views, board, lens)
    kept = without_bad_images(views, first, board)
    if len(kept.seen) < len(views.seen):
        first = initial_camera(name, kept, board, lens)
    _check_tilts(name, first.poses, board)
    initial = InitialRig({name: first.camera}, first.poses, {name: first.views})
    solved = solve_inliers(initial, {name: kept}, board, final=final)
    _check_tilts(name, solved.problem.board_poses, board)
    return solved


def _check_tilts(name: str, poses: Mapping[FrameKey, Pose], board: Board) -> None:
    """Raise ValueError if all (flat) boards are parallel: focal length and distance are then ambiguous."""
    if not board.flat:
        return
    normals = np.stack([pose.R[:, 2].numpy() for pose in poses.values()])
    widest = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1)).max()))
    if widest < FEWEST_TILT:
        raise ValueError(
            f"{name}: all boards are parallel (to {widest:.1f} degrees), "
            "so that focal length and distance are ambiguous: tilt the board by 20 to 40 degrees, "
            "to different sides, in most of the images"
        )


def solve(initial: InitialRig, board: Board, *, final: bool = True) -> Solved:
    """Fit all observable parameters; unobservable lens terms and principal points are fixed at defaults.

    Parameters fixed before the fit, when the noise was overestimated, may return after it; boards that are
    clearly not flat or not printed true are deformed.

    Args:
        initial: initial values, each camera with detections (as `InitialRig.problem` needs them).
        final: False accepts a focal length that is not observable.

    Returns:
        The solution, with a note for each fixed parameter.

    Raises:
        ValueError: for a `final` fit without an observable focal length.
    """
    problem, flat = initial.problem(board), initial.flat(board)
    full = problem.free
    problem, notes = observable(replace(problem, sigma=noise(problem, 0)), final=False)
    solved = _with_deformation(adjust(problem), flat)
    for _ in range(ROUNDS):
        returned, changed = observable(replace(solved.problem, free=full), final=False)
        if all(np.array_equal(mask, solved.problem.free[name]) for name, mask in returned.free.items()):
            break
        notes = changed
        solved = _with_deformation(adjust(returned), flat)
    while True:
        fewer, dropped = observable(solved.problem, final=final)
        if not dropped:
            return replace(solved, notes=tuple(notes), views=initial.views, left_out=initial.left_out)
        notes = notes + dropped
        solved = adjust(fewer)


def solve_inliers(
    initial: InitialRig,
    detected: Mapping[str, BoardViews],
    board: Board,
    *,
    final: bool = True,
) -> Solved:
    """Run `solve` in rounds, each without the points that the round before shows to be outliers.

    Args:
        initial: initial values, with the points of the first round.
        detected: all detections by camera, of which each round takes its points; KeyError for one at a moment
            that `initial` has not.
        final: False accepts a focal length that is not observable.

    Returns:
        The last solution.

    Raises:
        ValueError: for a `final` fit without an observable focal length.
    """
    solved = solve(initial, board, final=final)
    for _ in range(ROUNDS - 1):
        problem, boards, deformation = solved.problem, solved.problem.board_poses, solved.problem.deformation
        points = board.points if deformation is None else deformation.deformed(board.points, board.part)
        views = {}
        for name, v in detected.items():
            camera = problem.cameras[name]
            poses = {key: camera.cam_from_world @ boards[key] for key in v.seen}
            views[name] = without_outliers(v, camera, poses, points, sigma=problem.sigma[name])
        if all(v.count == solved.views[name].count for name, v in views.items()):
            break
        again = initial._replace(cameras=problem.cameras, boards=boards, views=views, deformation=deformation)
        solved = solve(again, board, final=final)
    return solved


def observable(problem: BundleProblem, *, final: bool) -> tuple[BundleProblem, list[str]]:
    """Fix unobservable parameters of lenses and principal points at their defaults, the worst first.

    Observability follows from the pixels and the priors of a start rig, in units of typical sizes. Poses stay
    free.

    Args:
        problem: the problem, with its noise.
        final: False to leave an unobservable focal length free.

    Returns:
        The problem with fewer free parameters, and a note for each fixed one.

    Raises:
        ValueError: for an unobservable focal length if `final`.
    """
    free = {name: mask.copy() for name, mask in problem.free.items()}
    cameras, notes = dict(problem.cameras), list[str]()
    candidates = [(name, int(i)) for name in cameras for i in np.flatnonzero(free[name])]
    sizes = np.concatenate([typical_sizes(c)[free[name]] for name, c in cameras.items()])
    stated = {name: prior for name, prior in problem.priors.items() if prior.pose is not None}
    equations = normal_equations(replace(problem, priors=stated), linearised(problem))
    information = equations.information() * sizes[:, None] * sizes
    while (worst := _worst(candidates, information)) is not None:
        name, index = candidates.pop(worst)
        entry = parameter_names(cameras[name])[index]
        if entry.startswith("focal"):
            if not final:
                break
            raise ValueError(
                f"{name}: the images do not determine the focal length: tilt the board by 20 to 40 degrees, "
                "to different sides, and bring it close in some of them"
            )
        free[name][index] = False
        information = np.delete(np.delete(information, worst, 0), worst, 1)
        cameras[name], fixed = with_default(cameras[name], entry)
        notes.append(f"{name}: {fixed}: the images do not determine it")
    return replace(problem, cameras=cameras, free=free), notes


def _worst(candidates: list[tuple[str, int]], information: np.ndarray) -> int | None:
    """Index of the parameter with the largest deviation of those too large; None if there is none."""
    covariance = np.linalg.inv(information + np.eye(len(candidates)))
    shares = np.sqrt(np.maximum(covariance.diagonal(), 0))
    order = np.array([2 if i >= 8 else 1 if i >= 6 else 0 for _, i in candidates]) * (shares > UNOBSERVABLE)
    worst = int(np.lexsort((shares, order))[-1])
    return worst if order[worst] else None


def _with_deformation(solved: Solved, flat: BoardDeformation | None) -> Solved:
    """Deform boards if frames agree on it; with too few frames, if the loss falls by half."""
    if flat is None or solved.problem.deformation is not None:
        return solved
    trial, count = replace(solved.problem, deformation=flat), len(solved.problem.frames)
    few = count < 2 * len(flat) + 2  # fewer frames agree on so many values by chance
    try:
        agreed = jackknife(trial)
        if not few and not is_significant(agreed.step, agreed.deformations, count):
            return solved
        deformed = adjust(trial)
    except np.linalg.LinAlgError:  # some parameters are not observable yet
        return solved
    left = deformed.problem.loss
    gain = replace(solved.problem, sigma=deformed.problem.sigma).loss - left
    return deformed if gain > (max(left, LEAST_GAIN) if few else LEAST_GAIN) else solved


# The adjustment ---------------------------------------------------------------------------------------------


def adjust(problem: BundleProblem, *, rounds: int = 4, equal_noise: bool = False) -> Solved:
    """Minimise the reprojection error over the free camera parameters, board poses and shapes.

    First with one noise of all cameras, as the initial values may be poor; then up to `rounds` times with
    noise estimated from residuals, once more of all cameras, later of each. (Individual noise from the
    beginning would discard the camera that starts worst.)

    Args:
        problem: the problem, with points of every camera; its noise is not used.
        rounds: largest number of rounds with noise estimated from residuals.
        equal_noise: True for one noise of all cameras: where the board moves between exposures, a camera with
            a noise of its own would attract every board pose.

    Returns:
        The solution, without notes and views; its covariance is None if the parameters are not observable.
    """
    parameters = len(problem.names) + POSE * len(problem.frames)
    start = dict.fromkeys(problem.cameras, max(problem.rms(), LEAST_NOISE))
    problem, converged = _minimised(replace(problem, sigma=start))
    sigma = _pooled(noise(problem, parameters))
    for _ in range(rounds):
        problem, converged = _minimised(replace(problem, sigma=sigma))
        before, sigma = sigma, noise(problem, parameters)
        sigma = _pooled(sigma) if equal_noise else sigma
        if all(abs(np.log(sigma[name] / before[name])) < 1e-2 for name in sigma):
            break
    problem = replace(problem, sigma=sigma)
    return Solved(problem, _covariance(problem), converged)


def readjusted(problem: BundleProblem) -> BundleProblem:
    """Return a problem adjusted again, with its noise, from a near solution, in 10 steps at most."""
    return _minimised(problem, iterations=10)[0]


def noise(problem: BundleProblem, parameters: int) -> dict[str, float]:
    """Estimate each camera's noise along x or y robustly from its residuals.

    Args:
        problem: problem in which each camera has points.
        parameters: number of fitted parameters, by which degrees of freedom are reduced.

    Returns:
        Standard deviations by camera, pixels, `LEAST_NOISE` or more; from few points they are drawn towards
        the cameras' mean.
    """
    residuals = problem.residuals
    numbers = 2 * sum(len(r) for r in residuals.values())
    left = numbers / max(numbers - parameters, 0.1 * numbers)
    squares = np.array([_square(r) for r in residuals.values()])
    counts = np.array([len(r) for r in residuals.values()], dtype=float)
    average = np.exp(np.average(np.log(squares), weights=counts))
    pooled = left * (counts * squares + POOLED * average) / (counts + POOLED)
    return dict(zip(residuals, np.sqrt(pooled).tolist()))


def _pooled(sigma: Mapping[str, float]) -> dict[str, float]:
    """Root mean square of all cameras' noise, for each."""
    return dict.fromkeys(sigma, float(np.sqrt(np.mean(np.square(list(sigma.values()))))))


def _square(r: Array) -> float:
    """Mean square of a coordinate, with outliers down-weighted."""
    lengths = np.linalg.norm(r, axis=-1)
    typical = max(float(np.median(lengths)) / RAYLEIGH_MEDIAN, LEAST_NOISE)
    return max(float((robust_weights(lengths / typical) * lengths**2).mean() / 2), LEAST_NOISE**2)


def _minimised(problem: BundleProblem, *, iterations: int = 50) -> tuple[BundleProblem, bool]:
    """Minimise a problem's loss. Returns the problem, and True if that converged."""

    def model(problem: BundleProblem) -> LocalModel[BundleProblem]:
        equations = normal_equations(problem, linearised(problem))
        return LocalModel(
            problem.loss, lambda p: p.loss, lambda damping: problem.stepped(*equations.solve(damping))
        )

    return levenberg_marquardt(
        problem,
        model,
        lambda _, __, before, after: before - after < CONVERGED,
        steps=iterations,
        damping=DAMPING,
    )


def _covariance(problem: BundleProblem) -> Array | None:
    """Covariance of the free camera parameters; None if some combination of them changes no pixel."""
    information = normal_equations(problem, linearised(problem)).information()
    scale = 1 / np.sqrt(np.maximum(information.diagonal(), 1e-300))
    scaled = information * scale[:, None] * scale
    if len(scaled) and np.linalg.eigvalsh(scaled)[0] < 1e-13:
        return None
    return np.linalg.inv(scaled) * scale[:, None] * scale


# Outliers ---------------------------------------------------------------------------------------------------


class FrameMisfit(NamedTuple):
    """Frame whose residuals in one camera are conspicuously large.

    Attributes:
        camera: name of the camera.
        frame: moment of the frame.
        rms: root mean square length of the frame's residuals in that camera, pixels.
        typical: median of these over the camera's frames, pixels.
    """

    camera: str
    frame: FrameKey
    rms: float
    typical: float


def frame_rms(problem: BundleProblem) -> dict[str, dict[FrameKey, float]]:
    """Compute the root mean square length of the residuals of each camera's image of each frame.

    Returns:
        Pixels, by camera and then by moment; moments at which a camera saw no board are missing.
    """
    by_camera = {}
    for name, r in problem.residuals.items():
        block = problem.seen[name].block
        squared, count = np.bincount(block, (r**2).sum(-1)), np.bincount(block)
        by_camera[name] = {
            problem.frames[b]: float(np.sqrt(squared[b] / count[b])) for b in np.flatnonzero(count)
        }
    return by_camera


def misfits(fit: Solved) -> list[FrameMisfit]:
    """List the frames with conspicuous residuals, worst first."""
    misfits = []
    for name, by_frame in frame_rms(fit.problem).items():
        typical = float(np.median(list(by_frame.values())))
        limit = max(MISFIT * typical, CONSPICUOUS * 2**0.5 * max(fit.problem.sigma[name], LEAST_SIGMA))
        misfits += [FrameMisfit(name, frame, rms, typical) for frame, rms in by_frame.items() if rms > limit]
    return sorted(misfits, key=lambda m: -m.rms / m.typical)


def misfit_notes(fit: Solved) -> Iterator[str]:
    """Yield a note if the adjustment did not converge, and one for each camera with frames that
    do not fit."""
    if not fit.converged:
        yield "the adjustment has not come to rest: too few boards, or some that contradict it"
    for name in fit.problem.cameras:
        if mine := [m for m in misfits(fit) if m.camera == name]:
            listed = named([f"{m.frame} ({m.rms:.2f} px)" for m in mine], LISTED)
            yield (
                f"{name}: frames that do not fit: {listed}, others {mine[0].typical:.2f} px: "
                "moved, blurred or wrongly detected?"
            )


# All cameras ------------------------------------------------------------------------------------------------


def solve_together(initial: InitialRig, board: Board, singles: Mapping[str, Solved]) -> Solved:
    """Fit all cameras at once; if they fit far worse than alone, with their single calibrations as priors.

    Boards that move between the exposures of unsynchronised cameras would otherwise distort the lens models.
    A few images that contradict the others (boards detected a square off, for instance) are left out.

    Args:
        initial: initial values of all cameras and boards.
        singles: solution of each camera alone, by name.

    Returns:
        The solution, the images that contradict the others in `left_out`; the single camera's own if there is
        only one.

    Raises:
        ValueError: if a camera contradicts the others altogether, or its focal length is not observable.
        TypeError: for a camera without detections in `initial`.
    """
    if len(singles) == 1:
        return next(iter(singles.values()))
    rms = {name: single.problem.rms() for name, single in singles.items()}
    given, first = initial, solve(initial, board)
    for limit in (
        _moved_from,
        _refused_from,
    ):  # if boards move in all frames, only images far off are left out
        initial, solved = given, first
        while wrong := _wrong_images(solved, singles, limit):
            initial = _without(initial, wrong)
            solved = solve(initial, board)
        if not (doubts := _inconsistent_cameras(solved, rms)):
            return solved
    priors = {name: _as_prior(name, single) for name, single in singles.items()}
    free = {name: prior.information.diagonal() > 0 for name, prior in priors.items()}
    for name, mask in free.items():
        mask[:6] = name != next(iter(free))
    held = replace(initial.problem(board), priors=priors, deformation=solved.problem.deformation, free=free)
    notes = [note for single in singles.values() for note in single.notes]
    notes.append(f"{doubts}; so each camera's intrinsics keep close to its own calibration")
    adjusted = adjust(held, equal_noise=True)
    return replace(adjusted, notes=tuple(notes), views=initial.views, left_out=initial.left_out)


def _wrong_images(
    solved: Solved, singles: Mapping[str, Solved], limit: Callable[[float], float]
) -> list[tuple[str, FrameKey]]:
    """Images that fit their own camera, not the others: one for each moment; none if too many."""
    reasons = dict[FrameKey, str]()
    alone = {name: frame_rms(single.problem)[name] for name, single in singles.items()}
    for misfit in misfits(solved):
        others = sum(misfit.frame in views.seen for views in solved.views.values()) > 1
        if others and misfit.rms > limit(alone[misfit.camera].get(misfit.frame, misfit.rms)):
            reasons.setdefault(misfit.frame, misfit.camera)
    counts = {name: len(v.seen) for name, v in solved.views.items()}
    many = many_wrong(list(reasons.values()), [name for name, _ in solved.left_out], counts)
    return [] if many else [(camera, frame) for frame, camera in reasons.items()]


def _without(initial: InitialRig, images: Sequence[tuple[str, FrameKey]]) -> InitialRig:
    views = {
        name: v.only([key for key in v.seen if (name, key) not in images])
        for name, v in initial.views.items()
    }
    boards = {key: pose for key, pose in initial.boards.items() if any(key in v.seen for v in views.values())}
    return initial._replace(boards=boards, views=views, left_out=[*initial.left_out, *images])


def many_wrong(wrong: Sequence[str], before: Sequence[str], counts: Mapping[str, int]) -> bool:
    """Test whether too large a share of a camera's images contradicts the others (`MANY_WRONG`).

    Args:
        wrong: camera of each contradicting image.
        before: camera of each image left out before.
        counts: images by camera, without the ones left out before.

    Returns:
        True if a camera has too many.
    """
    return any(
        wrong.count(n) + before.count(n) > MANY_WRONG * (counts[n] + before.count(n)) for n in set(wrong)
    )


def _moved_from(single_rms: float) -> float:
    """Joint reprojection error (RMS, pixels) above which an image contradicts other cameras' images."""
    return MOVED * single_rms


def _refused_from(single_rms: float) -> float:
    """Joint reprojection error (RMS, pixels) above which a camera contradicts the others."""
    return REJECTED * max(single_rms, 0.3)


def _inconsistent_cameras(solved: Solved, single_rms: Mapping[str, float]) -> str:
    """Text on cameras that fit much worse together than alone, or "". Raises ValueError if far worse."""
    doubts = []
    for name, r in solved.problem.residuals.items():
        together = float(np.sqrt((r**2).sum(-1).mean()))
        fits = f"{name} fits to {single_rms[name]:.2f} px alone but to {together:.2f} px with the others"
        if together > _refused_from(single_rms[name]):
            raise ValueError(f"{fits}: were the images {SYNCHRONISED}?")
        if together > 0.5 and together > INCONSISTENT * single_rms[name]:
            doubts.append(fits)
    return f"{', '.join(doubts)} (were the images {SYNCHRONISED}?)" if doubts else ""


def _as_prior(name: str, single: Solved) -> CameraPrior:
    """A camera's own calibration as a prior of its intrinsics; none for fixed parameters."""
    camera = single.problem.cameras[name]
    entries = parameter_names(camera)
    free = [entries.index(entry.removeprefix(f"{name}.")) for entry in single.names]
    information = np.zeros((len(entries), len(entries)))
    if single.covariance is not None:
        information[np.ix_(free, free)] = np.linalg.inv(single.covariance)
    return CameraPrior(intrinsic_values(camera), information)
