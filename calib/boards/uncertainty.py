"""Uncertainty of a rig: covariance of its parameters, in a file beside the rig's, and its consequences.

A camera's pose and its lens can stand for one another: what is compared are the pixels of points at a
distance, after the small motion of the camera that fits them best (as in mrcal's projection uncertainty and
difference).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float

from arraygeom import Camera, Pose, Rig
from arraygeom.io.native import read_text, write
from arraygeom.io.source import float64_of
from arraygeom.pixels import HW
from arraygeom.runtime.atomic import write_text
from arraygeom.runtime.safe_yaml import load_json
from arraygeom.sensor import Sensor
from arraygeom.uncertainty import position_covariance

from .board import Board
from .bundle import (
    Array,
    BundleProblem,
    Solved,
    block_sums,
    camera_jacobian,
    linearised,
    normal_equations,
    parameter_names,
)
from .deformation import described

FORMAT = "arraygeom-covariance 1"
GRID = 15, 20
"""Rows and columns of the pixels at which projections are compared."""
SEEN = 400
"""Approximate number of a camera's board points that compensate its motion."""
FEWEST_TO_JACKKNIFE = 6
UNCHECKED = 3.0
"""Factor that raises standard deviations from too few frames to check them: real sets of six frames and more
are raised by 1.0 to 4.8 (tests/benchmarks/RESULTS_sigma.md)."""
CONSIDERABLE = 1.3
"""Ratio of the jackknife's standard deviations to those of the points' noise above which they are raised."""


@dataclass(frozen=True)
class RigCovariance:
    """Covariance of some parameters of a rig; all others are fixed.

    Attributes:
        names: parameters as in `Rig.parameters` with the index of a component, "left.rotation.0",
            "left.focal.1": rotation vectors in radians about the camera's axes, translations in metres,
            pixels, distortion coefficients.
        matrix: covariance of these, in their units.
    """

    names: tuple[str, ...]
    matrix: Float[np.ndarray, "c c"]

    def selection(self, name: str, camera: Camera) -> Float[np.ndarray, "p c"]:
        """Return the matrix (p, c) that selects a camera's `parameter_names` among these parameters."""
        entries = np.array([f"{name}.{entry}" for entry in parameter_names(camera)])
        return (entries[:, None] == np.array(self.names, dtype=str)).astype(np.float64)

    def save(self, path: str | Path, rig: Rig) -> None:
        """Write the covariance and the geometry of its rig as JSON, atomically."""
        document = {"format": FORMAT, "names": list(self.names), "covariance": self.matrix.tolist()}
        write_text(path, json.dumps(document | {"rig": write(_geometry(rig))}))

    @classmethod
    def load(cls, path: str | Path, rig: Rig | None = None) -> RigCovariance:
        """Read a covariance file.

        Args:
            path: JSON file.
            rig: rig to which the file must belong: all cameras equal, but for their sensors; a file that
                states no rig passes. None does not check.

        Raises:
            OSError: for a file that is missing (FileNotFoundError) or cannot be read.
            ValueError: for another file, a damaged one, or one of another rig.
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such covariance file")
        try:
            document = load_json(path.read_text(encoding="utf-8"))
            names, numbers = tuple(document["names"]), float64_of(document["covariance"])
            if numbers is None:
                raise TypeError
            stated = rig if rig is None or "rig" not in document else read_text(str(document["rig"]), path)
        except (ValueError, KeyError, OverflowError, RecursionError, TypeError):
            raise ValueError(f"{path}: is not a covariance file of this program") from None
        matrix = numbers.numpy()
        if not all(isinstance(name, str) for name in names) or not np.isfinite(matrix).all():
            raise ValueError(f"{path}: holds names that are no text, or NaN or infinity: calibrate again")
        if matrix.shape != (len(names), len(names)):
            raise ValueError(f"{path}: {len(names)} names, a matrix of {matrix.shape}: is the file complete?")
        if rig is not None and stated is not None and _geometry(rig) != _geometry(stated):
            raise ValueError(
                f"{path}: is not of the rig beside it, which was changed since: remove it, or calibrate again"
            )
        return cls(names, matrix)


def _geometry(rig: Rig) -> Rig:
    """Rig without the sensors' properties."""
    return Rig({name: view.replace(sensor=Sensor()) for name, view in rig.cameras.items()})


def rig_covariance(fit: Solved) -> RigCovariance | None:
    """Return the covariance of a solution's free parameters; None if they are not observable."""
    matrix = fit.covariance
    return None if matrix is None else RigCovariance(fit.names, matrix)


def beta_covariance(
    rig: Rig, covariance: RigCovariance, alpha: str, beta: str, x: Float[np.ndarray, "n 2"], depth: float
) -> Float[np.ndarray, "n 2 2"]:
    """Propagate a rig's covariance to the positions in beta of alpha's pixels at a depth.

    Args:
        x: pixels of alpha.
        depth: depth in alpha, metres or the rig's own unit.

    Returns:
        Covariances (n, 2, 2) in pixels² of beta; NaN where alpha's lens has no ray or beta's does not project
        the point, and at infinite depth.

    Raises:
        ValueError: for a camera that is unknown or not calibrated, and parameters that the rig has not.
    """
    found = position_covariance(rig, covariance, alpha, beta, torch.from_numpy(x), depth)
    return found.numpy()


def baseline_deviation(rig: Mapping[str, Camera], a: str, b: str, covariance: RigCovariance) -> float:
    """Compute the standard deviation of the distance between two cameras, metres."""
    baseline = (rig[b].centre - rig[a].centre).numpy()
    direction = baseline / max(float(np.linalg.norm(baseline)), 1e-12)
    of_a, of_b = (
        direction @ rig[n].cam_from_world.centre_jacobian.numpy() @ covariance.selection(n, rig[n])[:6]
        for n in (a, b)
    )
    return float(np.sqrt((of_b - of_a) @ covariance.matrix @ (of_b - of_a)))


# One camera -------------------------------------------------------------------------------------------------


class Intrinsics(NamedTuple):
    """One camera's intrinsics with their uncertainty.

    Attributes:
        camera: the camera, at the origin.
        covariance: covariance of the free intrinsics, in their units (pixels, lens coefficients); (0, 0) if
            none is free.
        free: mask of the free intrinsics among all parameters, in the order of `parameter_names`.
        sigma: standard deviation of the noise along x or y, pixels.
        seen: some board points that the camera observed, in its frame, metres.
    """

    camera: Camera
    covariance: Float[np.ndarray, "f f"]
    free: Bool[np.ndarray, " p"]
    sigma: float
    seen: Float[np.ndarray, "m 3"]


def intrinsics_of(fit: Solved, name: str) -> Intrinsics:
    """Extract one camera from a fit; without a covariance none of its intrinsics is free."""
    camera, points = in_own_frame(fit.problem, name)
    of_rig = rig_covariance(fit) or RigCovariance((), np.zeros((0, 0)))
    mine = of_rig.selection(name, camera)
    mine[:6] = 0  # the pose
    free = np.asarray(mine.any(1))
    covariance = mine[free] @ of_rig.matrix @ mine[free].T
    return Intrinsics(camera, covariance, free, fit.problem.sigma[name], points)


def in_own_frame(problem: BundleProblem, name: str) -> tuple[Camera, Float[np.ndarray, "m 3"]]:
    """Return a camera at the origin, and some board points that it observed, in its frame, metres."""
    camera = problem.cameras[name]
    X = camera.cam_from_world.apply(torch.from_numpy(problem.world(name))).numpy()
    return camera.replace(cam_from_world=Pose.identity()), X[:: max(1, len(X) // SEEN)]


def grid_points(camera: Camera, depth: float) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 3"]]:
    """Return a grid of pixels that have a ray, and their points at a depth in the camera's frame."""
    rows, columns = GRID
    h, w = camera.hw
    x = np.stack(np.meshgrid(np.linspace(0, w - 1, columns), np.linspace(0, h - 1, rows)), -1).reshape(-1, 2)
    X = camera.unproject(torch.from_numpy(x), torch.full((len(x),), depth, dtype=torch.float64)).numpy()
    usable = np.isfinite(X).all(1)
    return x[usable], X[usable]


def uncertainty(
    intrinsics: Intrinsics, depth: float
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Compute the standard deviation of projections at a depth (metres) over the image.

    It is after the motion of the camera that keeps the boards where they were seen (see `moved_pixels`).

    Returns:
        Pixels (n, 2) of a grid, where the lens has a ray, and deviations in the worst direction (n), pixels;
        0 where no intrinsics are free.
    """
    x, change = moved_pixels(intrinsics, depth)
    return x, worst_deviation(change @ intrinsics.covariance @ change.swapaxes(-1, -2))


def worst_deviation(covariance: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, " n"]:
    """Return the standard deviation in the direction in which it is largest."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(covariance)[:, -1]))


def moved_pixels(intrinsics: Intrinsics, depth: float) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate pixels over the image by the free intrinsics, at a depth (metres).

    The camera is moved to keep the boards where they were seen, so that points nearer or farther than the
    boards move more.

    Returns:
        Pixels (n, 2) of a grid (`grid_points`) and derivatives (n, 2, f), in the order of the free ones.
    """
    x, X = grid_points(intrinsics.camera, depth)
    J, at_boards = camera_jacobian(intrinsics.camera, X), camera_jacobian(intrinsics.camera, intrinsics.seen)
    motion = compensation(at_boards[..., :6], at_boards[..., intrinsics.free])
    return x, J[..., intrinsics.free] - J[..., :6] @ motion


def compensation(by_pose: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Fit the camera motion whose effect on pixels is closest to given changes, in least squares.

    Args:
        by_pose: derivatives (m, 2, 6) of pixels by the pose.
        moved: changes of the pixels (m, 2, f), each of f to be fitted, or (m, 2) for one.

    Returns:
        Motions (6, f), for one (6, 1): rotation vector in radians, translation in metres.
    """
    return np.asarray(
        np.linalg.lstsq(by_pose.reshape(-1, 6), moved.reshape(len(by_pose) * 2, -1), rcond=None)[0]
    )


def covered(
    x: Float[np.ndarray, "n 2"], observed: Float[np.ndarray, "m 2"], hw: HW
) -> Bool[np.ndarray, " n"]:
    """Return True for pixels with a board point within a cell of the comparison grid."""
    reach = max(hw[0] / GRID[0], hw[1] / GRID[1])
    nearest = np.array([np.linalg.norm(observed - each, axis=1).min() for each in x])
    return np.asarray(nearest < reach)


# How frames disagree ----------------------------------------------------------------------------------------


class Jackknife(NamedTuple):
    """Covariances of a bundle adjustment from the disagreement of its frames.

    Attributes:
        covariance: covariance of the cameras' free parameters, by the corrected estimate.
        left_out: covariance of these by a plain jackknife, which leaves out each frame in turn.
        deformations: covariance of the boards' shapes, by the corrected estimate; (0, 0) without shapes.
        step: boards' shapes, board by board, after a Gauss-Newton step; empty without shapes.
    """

    covariance: Float[np.ndarray, "c c"]
    left_out: Float[np.ndarray, "c c"]
    deformations: Float[np.ndarray, "s s"]
    step: Float[np.ndarray, " s"]


def jackknife(problem: BundleProblem) -> Jackknife:
    """Estimate covariances from the disagreement of frames, to first order.

    They include common errors of a frame beyond its points' noise: a bent board, blur, wrong exposure times.
    A plain jackknife's deviations are too large where few boards determine all parameters between them; Bell
    and McCaffrey's (2002) correction removes that.

    Args:
        problem: a solution, with its noise.

    Raises:
        numpy.linalg.LinAlgError: if parameters are not observable.
    """
    parts = linearised(problem)
    equations = normal_equations(problem, parts)
    b, c = equations.W.shape[:2]
    H, g = np.zeros((b, c, c)), np.zeros((b, c))
    for linear in parts.values():
        columns = linear.columns
        H[:, columns[:, None], columns] += block_sums(
            linear.block, linear.by_shared.swapaxes(1, 2) @ linear.by_shared, b
        )
        g[:, columns] += block_sums(linear.block, np.einsum("nip,ni->np", linear.by_shared, linear.r), b)
    total, Y, _ = equations.reduced(0.0)
    H -= Y @ equations.W.swapaxes(-1, -2)
    g -= np.einsum("bcd,bd->bc", Y, equations.h)
    whole = equations.g - np.einsum("bcd,bd->c", Y, equations.h)
    step = np.linalg.lstsq(total, whole, rcond=1e-14)[0]
    covariance = _clustered(total, H, g - H @ step)
    each = np.stack([np.linalg.lstsq(total - P, whole - slope, rcond=1e-14)[0] for P, slope in zip(H, g)])
    each -= each.mean(0)
    cameras, shapes = slice(c - equations.shapes), slice(c - equations.shapes, c)
    deformation = problem.deformation
    after = np.zeros(0) if deformation is None else deformation.values.ravel() + step[shapes]
    left_out = (b - 1) / b * (each.T @ each)[cameras, cameras]
    return Jackknife(covariance[cameras, cameras], left_out, covariance[shapes, shapes], after)


def _clustered(total: Array, H: Array, g: Array) -> Array:
    """Covariance by the slopes g (b, c) of frames, each times (1 - its share H of the information)^(-1/2)."""
    scale = 1 / np.sqrt(total.diagonal())
    whiten = np.linalg.inv(np.linalg.cholesky(total * scale * scale[:, None])) * scale
    share, axes = np.linalg.eigh(whiten @ H @ whiten.T)
    slopes = np.einsum("bji,bj->bi", axes, g @ whiten.T) / np.sqrt(np.maximum(1 - share, 1e-6))
    changes = np.einsum("bij,bj->bi", axes, slopes) @ whiten
    return np.asarray(changes.T @ changes)


def with_disagreement(solved: Solved, board: Board, *, unchecked: bool = False) -> Solved:
    """Raise a solution's covariance where frames disagree considerably, and add notes on that and on boards.

    The raised covariance is the mean of a plain jackknife's, which few frames make noisy, and the solution's
    own scaled to the jackknife's level: the median over the parameters, as frames that disagree about a focal
    length say nothing of the lens.

    Args:
        solved: the solution; without a covariance it gets notes on boards alone.
        unchecked: True to raise deviations by the factor `UNCHECKED` where frames are too few to tell.

    Returns:
        The solution with that covariance, the largest factor in `raised` (1 for none), and notes added.

    Raises:
        numpy.linalg.LinAlgError: if parameters are not observable by the frames.
    """
    problem, covariance, notes = solved.problem, solved.covariance, list[str]()
    raised, frames = 1.0, len(problem.frames)
    if covariance is not None and unchecked and frames < FEWEST_TO_JACKKNIFE:
        covariance, raised = UNCHECKED**2 * covariance, UNCHECKED
        notes.append(
            f"{frames} frames are too few to check standard deviations: they are raised by "
            f"{UNCHECKED:.0f}, as more frames do of real boards; take {FEWEST_TO_JACKKNIFE} or more"
        )
    checked = covariance is not None and len(covariance) > 0 and frames >= FEWEST_TO_JACKKNIFE
    jackknifed = jackknife(problem) if checked or problem.deformation is not None else None
    if jackknifed is not None and problem.deformation is not None:
        deviations = np.sqrt(jackknifed.deformations.diagonal()).reshape(problem.deformation.values.shape)
        notes += described(problem.deformation, deviations, [each.extent for each in board.members])
    if jackknifed is not None and checked and covariance is not None:
        excess = np.trace(np.linalg.solve(covariance, jackknifed.covariance)) / len(covariance)
        if excess**0.5 > CONSIDERABLE:
            level = max(1.0, float(np.median(_ratio(jackknifed.left_out, covariance))))
            before, covariance = covariance, (level**2 * covariance + jackknifed.left_out) / 2
            raised = float(_ratio(covariance, before).max())
            notes.append(
                "frames disagree more than the points' noise explains: standard deviations are raised, "
                f"by up to {raised:.1f}, to those of a jackknife over frames (is the board flat and printed "
                "true to size, and did it stand still, as rolling shutters shear what moves?)"
            )
    return replace(solved, covariance=covariance, raised=raised, notes=(*solved.notes, *notes))


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Ratios of the standard deviations of two covariances."""
    return np.asarray(np.sqrt(a.diagonal() / b.diagonal()))
