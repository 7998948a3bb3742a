"""The solution of a calibration: which parameters the images determine, how boards are shaped, how frames disagree."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from arraygeom import Camera, Pose, stack

from .board import Board, KnownPoints
from .bundle import BundleProblem, Masks, Observations, Solved, adjust, jackknife, linearised, noise, normal_equations
from .deformation import LEAST_GAIN, BoardDeformation, described, fewest_frames, is_significant
from .detect import BoardViews
from .parameters import (
    CameraPrior,
    described_default,
    parameter_names,
    typical_prior,
    typical_sizes,
    with_default,
)
from .photos import FrameKey

UNOBSERVABLE = 0.5
"""A parameter is unobservable if its posterior deviation stays above this share of its typical size."""
ROUNDS = 3
"""Times that parameters may return."""
FEWEST_TO_JACKKNIFE = 6
UNCHECKED = 3.0
"""The factor by which standard deviations are raised of fewer frames, which cannot be checked: real sets
of six frames and more are raised by 1.0 to 4.8 (tests/benchmarks/RESULTS_sigma.md)."""
CONSIDERABLE = 1.3
"""Standard deviations are raised if the jackknife's are larger by this."""


def board_problem(
    cameras: Mapping[str, Camera],
    boards: Mapping[FrameKey, Pose],
    views: Mapping[str, BoardViews],
    board: Board,
    priors: Mapping[str, CameraPrior] | None = None,
) -> BundleProblem:
    """Cameras, boards and views as a problem; without stated `priors`, those of ordinary cameras, the first fixed."""
    index, seen, free = {key: i for i, key in enumerate(boards)}, {}, {}
    for number, (name, camera) in enumerate(cameras.items()):
        parts = [(np.full(len(d.ids), index[key]), board.points[d.ids], d.x) for key, d in views[name].seen.items()]
        seen[name] = Observations(*(np.concatenate(part) for part in zip(*parts)))
        free[name] = np.ones(len(parameter_names(camera)), dtype=bool)
        free[name][:6] = number > 0 or priors is not None
    usual = {name: typical_prior(camera) for name, camera in cameras.items()} if priors is None else priors
    return BundleProblem(cameras, stack(list(boards.values())), seen, tuple(boards), free, priors=usual)


def flat_boards(board: Board, frames: Iterable[FrameKey], views: Mapping[str, BoardViews]) -> BoardDeformation | None:
    """Flat boards, in the order of the frames; None for points whose positions are known."""
    if isinstance(board, KnownPoints):
        return None
    first = {key: d.ids[0] for v in views.values() for key, d in v.seen.items()}
    return BoardDeformation.flat(board.points, board.part, board.part[[first[key] for key in frames]])


def solve(problem: BundleProblem, flat: BoardDeformation | None, *, final: bool = True) -> Solved:
    """Fit all observable parameters; those that turn out to be unobservable are fixed, until none is.

    Parameters fixed before the fit, when the noise was overestimated, may return after it; and boards that are clearly
    neither `flat` nor printed true are deformed. Raises ValueError where a `final` fit has no focal length.
    """
    full = problem.free
    problem, notes = observable(replace(problem, sigma=noise(problem, 0)), final=False)
    solved = _with_deformation(adjust(problem), flat)
    for _ in range(ROUNDS):
        returned, changed = observable(replace(solved.problem, free=full), final=False)
        if _equal(returned.free, solved.problem.free):
            break
        notes = changed
        solved = _with_deformation(adjust(returned), flat)
    while True:
        fewer, dropped = observable(solved.problem, final=final)
        if not dropped:
            return replace(solved, notes=tuple(notes))
        notes = notes + dropped
        solved = adjust(fewer)


def observable(problem: BundleProblem, *, final: bool) -> tuple[BundleProblem, list[str]]:
    """The problem with every unobservable parameter of a lens or principal point fixed at its default, and notes.

    The worst is fixed first. Once the fit is `final`, raises ValueError where a focal length is unobservable.
    """
    free = {name: mask.copy() for name, mask in problem.free.items()}
    cameras, notes = dict(problem.cameras), list[str]()
    candidates = [(name, int(i)) for name in cameras for i in np.flatnonzero(free[name])]
    information = _relative_information(problem)
    while (worst := _worst(candidates, information)) is not None:
        name, index = candidates.pop(worst)
        entry = parameter_names(cameras[name])[index]
        if entry.startswith("focal"):
            if not final:
                break
            raise ValueError(
                f"{name}: the images do not determine the focal length: tilt the board by 20 to 40 degrees, to "
                "different sides, and bring it close in some of them"
            )
        free[name][index] = False
        information = np.delete(np.delete(information, worst, 0), worst, 1)
        cameras[name] = with_default(cameras[name], entry)
        notes.append(f"{name}: {described_default(cameras[name], entry)}: the images do not determine it")
    return replace(problem, cameras=cameras, free=free), notes


def _equal(a: Masks, b: Masks) -> bool:
    return all((a[name] == b[name]).all() for name in a)


def _relative_information(problem: BundleProblem) -> np.ndarray:
    """The inverse covariance of the free parameters in units of their typical sizes, by pixels and stated priors."""
    sizes = np.concatenate([typical_sizes(camera)[problem.free[name]] for name, camera in problem.cameras.items()])
    stated = {name: prior for name, prior in problem.priors.items() if prior.pose is not None}
    information = normal_equations(replace(problem, priors=stated), linearised(problem)).information()
    return information * sizes[:, None] * sizes


def _worst(candidates: list[tuple[str, int]], information: np.ndarray) -> int | None:
    """The parameter whose deviation is the largest share of its typical size, if too large; focal lengths last."""
    covariance = np.linalg.inv(information + np.eye(len(candidates)))
    shares = np.sqrt(np.maximum(covariance.diagonal(), 0))
    order = np.array([2 if i >= 8 else 1 if i >= 6 else 0 for _, i in candidates]) * (shares > UNOBSERVABLE)
    worst = int(np.lexsort((shares, order))[-1])
    return worst if order[worst] else None


def _with_deformation(solved: Solved, flat: BoardDeformation | None) -> Solved:
    """The solution with the boards' deformations as unknowns if the points show them and frames agree on them.

    Where frames are too few to agree, the loss must fall by half.
    """
    if flat is None or solved.problem.deformation is not None:
        return solved
    trial, count = replace(solved.problem, deformation=flat), len(solved.problem.frames)
    few = count < fewest_frames(len(flat))
    try:
        agreed = jackknife(trial)
        if not few and not is_significant(agreed.step, agreed.deformations, count):
            return solved
        deformed = adjust(trial)
    except np.linalg.LinAlgError:  # some parameters are not observable yet
        return solved
    left = deformed.problem.loss()
    gain = replace(solved.problem, sigma=deformed.sigma).loss() - left
    return deformed if gain > (max(left, LEAST_GAIN) if few else LEAST_GAIN) else solved


def with_disagreement(solved: Solved, extents: list[tuple[float, float]], *, unchecked: bool = False) -> Solved:
    """The solution with its covariance raised if frames disagree considerably; with notes on that and on the boards.

    Where frames are too few to tell, it is raised by `UNCHECKED` if it is of such frames alone (`unchecked`).

    `extents` are the boards' sizes, metres. The raised covariance is the mean of the jackknife's, which few frames make
    noisy, and of that of the points' noise, scaled to the jackknife's level: the median over the parameters, as frames
    that disagree about a focal length say nothing of the lens.
    """
    problem, covariance, notes = solved.problem, solved.covariance, list[str]()
    enough = len(problem.names) > 0 and len(problem.frames) >= FEWEST_TO_JACKKNIFE
    raised = 1.0
    if covariance is not None and unchecked and len(problem.frames) < FEWEST_TO_JACKKNIFE:
        covariance, raised = UNCHECKED**2 * covariance, UNCHECKED
        notes.append(
            f"{len(problem.frames)} frames are too few to check standard deviations: they are raised by "
            f"{UNCHECKED:.0f}, as more frames do of real boards; take {FEWEST_TO_JACKKNIFE} or more"
        )
    if problem.deformation is None and (covariance is None or not enough):
        return replace(solved, covariance=covariance, raised=raised, notes=(*solved.notes, *notes))
    found = jackknife(problem)
    if problem.deformation is not None:
        deviations = np.sqrt(found.deformations.diagonal()).reshape(problem.deformation.values.shape)
        notes += described(problem.deformation, deviations, extents)
    if enough and covariance is not None and _excess(found.covariance, covariance) > CONSIDERABLE:
        level = max(1.0, float(np.median(_ratio(found.left_out, covariance))))
        before, covariance = covariance, (level**2 * covariance + found.left_out) / 2
        raised = float(_ratio(covariance, before).max())
        notes.append(
            "frames disagree more than the points' noise explains: standard deviations are raised, by up to "
            f"{raised:.1f}, to those of a jackknife over frames (is the board flat and printed true to size, and were "
            "the images sharp?)"
        )
    return replace(solved, covariance=covariance, raised=raised, notes=(*solved.notes, *notes))


def _excess(a: np.ndarray, b: np.ndarray) -> float:
    """The typical ratio of the standard deviations of two covariances, in all directions."""
    return float(np.sqrt(np.trace(np.linalg.solve(b, a)) / len(b)))


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of the standard deviations of two covariances."""
    return np.asarray(np.sqrt(a.diagonal() / b.diagonal()))
