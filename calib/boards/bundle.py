"""Bundle adjustment: cameras and the board poses they observed, fitted together to the pixels.

Boards are coupled by the cameras alone. Gauss-Newton with Levenberg's damping on the Schur complement of the boards
(Triggs et al. 2000, section 6); derivatives with respect to the camera parameters are automatic, through `arraygeom`.
Pixels are weighted by the noise of their camera, and a residual r beyond k = 3 standard deviations by (k / r)^2, so
that outliers have little influence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from arraygeom import Camera, Pose

from .deformation import BoardDeformation
from .parameters import CameraPrior, camera_jacobian, changed, parameter_names
from .photos import FrameKey

ROBUST = 3.0
"""Residuals beyond this many standard deviations are down-weighted."""
RAYLEIGH_MEDIAN = 1.17741
"""The median length of a vector of two independent standard normal variables."""
LEAST_NOISE = 1e-3
"""Lower bound of the noise, pixels: perfect corners must not get infinite weight."""
CONVERGED = 1e-3
"""Iteration ends once a step lowers the loss by less than this, in squared standard deviations."""
POOLED = 50
"""Each camera's noise is estimated as if it had this many additional residuals of the average noise."""
POSE = 6
"""Parameters of a board: a rotation vector about the world's axes and a translation."""

Array = np.ndarray
Masks = Mapping[str, Bool[np.ndarray, "_"]]
"""By camera, which of its parameters are meant, in the order of `parameter_names`."""


class Observations(NamedTuple):
    """Points observed by one camera: the board of each, its position on it (metres) and its pixel."""

    block: Int[np.ndarray, " n"]
    p: Float[np.ndarray, "n 3"]
    x: Float[np.ndarray, "n 2"]


@dataclass(frozen=True)
class BundleProblem:
    """Cameras, boards and observations.

    boards: `world_from_board`, a batch, of the `frames`. free: the parameters that may change. sigma: by camera, the
    noise along x or y, pixels. deformation: that of the boards, adjusted with the cameras; None for flat ones.
    """

    cameras: Mapping[str, Camera]
    boards: Pose
    seen: Mapping[str, Observations]
    frames: tuple[FrameKey, ...]
    free: Masks
    sigma: Mapping[str, float] = field(default_factory=dict)
    priors: Mapping[str, CameraPrior] = field(default_factory=dict)
    deformation: BoardDeformation | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' free parameters, such as "left.focal.0"."""
        return tuple(
            f"{name}.{entry}"
            for name, camera in self.cameras.items()
            for entry, is_free in zip(parameter_names(camera), self.free[name])
            if is_free
        )

    @property
    def board_poses(self) -> dict[FrameKey, Pose]:
        """`world_from_board` by frame."""
        return {key: self.boards[i] for i, key in enumerate(self.frames)}

    def on_board(self, name: str) -> Float[np.ndarray, "n 3"]:
        """The points that a camera observed, on the boards as they are shaped, metres."""
        seen = self.seen[name]
        if self.deformation is None:
            return seen.p
        return self.deformation.deformed(seen.p, self.deformation.part[seen.block])

    def rotated(self, name: str) -> Float[np.ndarray, "n 3"]:
        """The points that a camera observed, along the world's axes from the origin of their board."""
        return np.einsum("nij,nj->ni", self.boards.R.numpy()[self.seen[name].block], self.on_board(name))

    def world(self, name: str) -> Float[np.ndarray, "n 3"]:
        """The points that a camera observed, in the world, metres."""
        return self.rotated(name) + self.boards.t.numpy()[self.seen[name].block]

    def residuals(self) -> dict[str, Float[np.ndarray, "_ 2"]]:
        """By camera: measured minus projected, pixels."""
        found = {}
        for name, seen in self.seen.items():
            X = torch.from_numpy(self.world(name))
            found[name] = seen.x - self.cameras[name].project(X).x.detach().numpy()
        return found

    def rms(self) -> float:
        """Root mean square length of all residuals, pixels: OpenCV's reprojection error."""
        lengths = np.concatenate([(r**2).sum(-1) for r in self.residuals().values()])
        return float(np.sqrt(lengths.mean()))

    def loss(self) -> float:
        """Sum over residuals of s in standard deviations: s^2 / 2 up to k, k^2 (1/2 + log(s / k)) beyond."""
        total = sum(prior.loss(self.cameras[name]) for name, prior in self.priors.items())
        if self.deformation is not None:
            total += self.deformation.loss()
        for name, r in self.residuals().items():
            s = np.linalg.norm(r, axis=-1) / self.sigma[name]
            far = np.maximum(s, ROBUST)
            total += float(np.where(s < ROBUST, s**2 / 2, ROBUST**2 * (0.5 + np.log(far / ROBUST))).sum())
        return total

    def of_boards(self, kept: Bool[np.ndarray, " b"]) -> BundleProblem:
        """The problem with some of its boards only."""
        index, seen = np.cumsum(kept) - 1, {}
        for name, s in self.seen.items():
            mine = kept[s.block]
            seen[name] = Observations(index[s.block[mine]], s.p[mine], s.x[mine])
        return replace(
            self,
            boards=self.boards[torch.from_numpy(kept)],
            seen=seen,
            frames=tuple(key for key, keep in zip(self.frames, kept) if keep),
            deformation=self.deformation and self.deformation.of_blocks(self.deformation.part[kept]),
        )

    def stepped(self, change: Float[np.ndarray, " c"], boards: Float[np.ndarray, "b 6"]) -> BundleProblem:
        """The problem after a change of its free parameters, the deformations' last, and of the boards' poses."""
        cameras, at = {}, 0
        for name, camera in self.cameras.items():
            full = np.zeros(len(self.free[name]))
            count = int(self.free[name].sum())
            full[self.free[name]] = change[at : at + count]
            cameras[name] = changed(camera, torch.from_numpy(full))
            at += count
        rotation, translation = torch.from_numpy(boards).split(3, -1)
        return replace(
            self,
            cameras=cameras,
            boards=self.boards.perturbed(rotation, translation),
            deformation=self.deformation and self.deformation.stepped(change[at:]),
        )


@dataclass(frozen=True)
class Solved:
    """A problem after bundle adjustment, its noise estimated from the residuals.

    covariance: of the cameras' free parameters, in their own units; None where they are not observable.
    raised: the largest factor by which a standard deviation was raised to that of the jackknife.
    """

    problem: BundleProblem
    covariance: Float[np.ndarray, "c c"] | None
    converged: bool
    notes: tuple[str, ...] = ()
    raised: float = 1.0

    @property
    def names(self) -> tuple[str, ...]:
        """The free parameters, in the order of the covariance."""
        return self.problem.names

    @property
    def sigma(self) -> Mapping[str, float]:
        """Each camera's noise along x or y, pixels."""
        return self.problem.sigma


def adjust(problem: BundleProblem, *, rounds: int = 4, equal_noise: bool = False) -> Solved:
    """Minimise the reprojection error over the free camera parameters and all boards.

    First by least squares of equal noise, as the initial values may be poor; then `rounds` times with the noise of each
    camera estimated from its residuals. (Individual noise from the beginning would discard the camera that starts
    worst.) With `equal_noise` all cameras share one noise: where the board moves between exposures, a camera with a
    noise of its own would attract every board pose.
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
    """The problem adjusted once more, from a solution of nearly the same problem and with its noise."""
    return _minimised(problem, iterations=10)[0]


def noise(problem: BundleProblem, parameters: int) -> dict[str, float]:
    """A robust estimate of each camera's noise along x or y, pixels, given the number of fitted parameters."""
    residuals = problem.residuals()
    numbers = 2 * sum(len(r) for r in residuals.values())
    left = numbers / max(numbers - parameters, 0.1 * numbers)
    squares = np.array([_square(r) for r in residuals.values()])
    counts = np.array([len(r) for r in residuals.values()], dtype=float)
    average = np.exp(np.average(np.log(squares), weights=counts))
    pooled = left * (counts * squares + POOLED * average) / (counts + POOLED)
    return dict(zip(residuals, np.sqrt(pooled).tolist()))


def _pooled(sigma: Mapping[str, float]) -> dict[str, float]:
    """Their root mean square, for all cameras."""
    return dict.fromkeys(sigma, float(np.sqrt(np.mean(np.square(list(sigma.values()))))))


def _square(r: Array) -> float:
    """The mean square of a coordinate, with outliers down-weighted."""
    lengths = np.linalg.norm(r, axis=-1)
    typical = max(float(np.median(lengths)) / RAYLEIGH_MEDIAN, LEAST_NOISE)
    return max(float((_weights(lengths / typical) * lengths**2).mean() / 2), LEAST_NOISE**2)


def _weights(lengths: Array) -> Array:
    """Robust weights of residuals in standard deviations."""
    return np.minimum(1.0, (ROBUST / np.maximum(lengths, ROBUST)) ** 2)


def _minimised(problem: BundleProblem, *, iterations: int = 50) -> tuple[BundleProblem, bool]:
    """Levenberg's loop: the problem, and whether it converged."""
    least, damping = problem.loss(), 1e-4
    for _ in range(iterations):
        equations = normal_equations(problem, linearised(problem))
        while True:
            trial = problem.stepped(*equations.solve(damping))
            trial_loss = trial.loss()
            if trial_loss < least:
                break
            damping *= 10
            if damping > 1e6:
                return problem, True
        gained = least - trial_loss
        problem, least = trial, trial_loss
        damping = max(damping / 10, 1e-12)
        if gained < CONVERGED:
            return problem, True
    return problem, False


def _covariance(problem: BundleProblem) -> Array | None:
    """Of the free camera parameters; None if some combination of them changes no pixel."""
    information = normal_equations(problem, linearised(problem)).information()
    scale = 1 / np.sqrt(np.maximum(information.diagonal(), 1e-300))
    scaled = information * scale[:, None] * scale
    if len(scaled) and np.linalg.eigvalsh(scaled)[0] < 1e-13:
        return None
    return np.linalg.inv(scaled) * scale[:, None] * scale


# Linear equations ---------------------------------------------------------------------------------------------


class Linearised(NamedTuple):
    """One camera's residuals, and its pixels' derivatives, weighted.

    by_shared: by the camera's free parameters and the boards' deformations, which are the `columns` of all cameras'.
    by_board: by the pose of the board of each point.
    """

    r: Float[np.ndarray, "n 2"]
    by_shared: Float[np.ndarray, "n 2 p"]
    by_board: Float[np.ndarray, "n 2 6"]
    block: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " p"]


def linearised(problem: BundleProblem) -> dict[str, Linearised]:
    """The residuals and derivatives of each camera."""
    shapes = 0 if problem.deformation is None else len(problem.deformation)
    first, found = 0, {}
    total = len(problem.names) + shapes
    for name, camera in problem.cameras.items():
        seen, free, sigma = problem.seen[name], problem.free[name], problem.sigma[name]
        last = first + int(free.sum())
        columns = np.array([*range(first, last), *range(total - shapes, total)], dtype=int)
        first = last
        X = problem.world(name)
        r = seen.x - camera.project(torch.from_numpy(X)).x.numpy()
        by_camera = camera_jacobian(camera, X)
        by_point = by_camera[..., 3:6] @ camera.R.numpy()
        by_board = by_point @ _by_pose(problem, name)
        by_shared = np.concatenate([by_camera[..., free], by_point @ _by_deformation(problem, name)], -1)
        weight = np.sqrt(_weights(np.linalg.norm(r, axis=-1) / sigma)) / sigma
        wide = weight[:, None, None]
        found[name] = Linearised(weight[:, None] * r, wide * by_shared, wide * by_board, seen.block, columns)
    return found


def _by_pose(problem: BundleProblem, name: str) -> Float[np.ndarray, "n 3 6"]:
    """Derivatives of a camera's points in the world by the poses of their boards, exp(w) R and the translation."""
    x, y, z = problem.rotated(name).T
    o, one = np.zeros_like(x), np.ones_like(x)
    rows = [[o, z, -y, one, o, o], [-z, o, x, o, one, o], [y, -x, o, o, o, one]]
    return np.moveaxis(np.array(rows), -1, 0)


def _by_deformation(problem: BundleProblem, name: str) -> Float[np.ndarray, "n 3 s"]:
    """Derivatives of a camera's points in the world by the boards' deformations."""
    seen = problem.seen[name]
    if problem.deformation is None:
        return np.zeros((len(seen.block), 3, 0))
    on_board = problem.deformation.jacobian(seen.p, problem.deformation.part[seen.block])
    return problem.boards.R.numpy()[seen.block] @ on_board


@dataclass(frozen=True)
class NormalEquations:
    """[H W; W^T B] [cameras; boards] = [g; h], B block-diagonal (b, 6, 6), W (b, c, 6).

    shapes: the number of the cameras' rows, at their end, that are of the boards' deformations.
    """

    H: Array
    W: Array
    B: Array
    g: Array
    h: Array
    shapes: int = 0

    def solve(self, damping: float) -> tuple[Array, Array]:
        """The step of cameras (c,) and boards (b, 6), with diagonals multiplied by 1 + damping."""
        S, Y, inverse = self.reduced(damping)
        scale = 1 / np.sqrt(np.maximum(S.diagonal(), 1e-300))
        right = scale * (self.g - np.einsum("bcd,bd->c", Y, self.h))
        change = scale * np.linalg.lstsq(S * scale[:, None] * scale, right, rcond=1e-14)[0]
        boards = np.einsum("bde,be->bd", inverse, self.h - np.einsum("bcd,c->bd", self.W, change))
        return change, boards

    def information(self) -> Array:
        """The inverse covariance (c, c) of the camera parameters, marginalised over the boards and deformations."""
        S, _, _ = self.reduced(0.0)
        c = len(S) - self.shapes
        return S[:c, :c] - S[:c, c:] @ np.linalg.solve(S[c:, c:], S[c:, :c])

    def reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """The Schur complement of the boards, W B^-1 and B^-1."""
        eye = np.eye(POSE)
        inverse = np.linalg.inv(self.B * (1 + damping * eye) + 1e-12 * eye)
        Y = self.W @ inverse
        H = self.H + damping * np.diag(self.H.diagonal())
        return H - np.tensordot(Y, self.W, axes=([0, 2], [0, 2])), Y, inverse


def normal_equations(problem: BundleProblem, parts: Mapping[str, Linearised]) -> NormalEquations:
    """The Gauss-Newton equations of the free camera parameters, the boards' deformations and their poses."""
    shapes = 0 if problem.deformation is None else len(problem.deformation)
    b, c = len(problem.frames), len(problem.names) + shapes
    H, g = np.zeros((c, c)), np.zeros(c)
    W, B, h = np.zeros((b, c, POSE)), np.zeros((b, POSE, POSE)), np.zeros((b, POSE))
    for name, part in parts.items():
        columns = part.columns
        rows = part.by_shared.reshape(2 * len(part.r), len(columns))
        H[np.ix_(columns, columns)] += rows.T @ rows
        g[columns] += np.einsum("nip,ni->p", part.by_shared, part.r)
        if (prior := problem.priors.get(name)) is not None:
            free, own = problem.free[name], columns[: len(columns) - shapes]
            information, slope = prior.equations(problem.cameras[name])
            H[np.ix_(own, own)] += information[np.ix_(free, free)]
            g[own] += slope[free]
        np.add.at(B, part.block, np.einsum("nid,nie->nde", part.by_board, part.by_board))
        np.add.at(h, part.block, np.einsum("nid,ni->nd", part.by_board, part.r))
        coupled = np.zeros((b, len(columns), POSE))
        np.add.at(coupled, part.block, np.einsum("nip,nid->npd", part.by_shared, part.by_board))
        W[:, columns] += coupled
    if problem.deformation is not None:
        H[range(c - shapes, c), range(c - shapes, c)] += problem.deformation.information
        g[c - shapes :] -= problem.deformation.information * problem.deformation.values.ravel()
    return NormalEquations(H, W, B, g, h, shapes)


# How frames disagree ------------------------------------------------------------------------------------------


class Jackknife(NamedTuple):
    """By how the frames disagree: covariances of the cameras' parameters and of the boards' deformations.

    left_out: of the cameras' parameters by leaving out each frame in turn. step: the deformations after a Gauss-Newton
    step.
    """

    covariance: Float[np.ndarray, "c c"]
    left_out: Float[np.ndarray, "c c"]
    deformations: Float[np.ndarray, "s s"]
    step: Float[np.ndarray, " s"]


def jackknife(problem: BundleProblem) -> Jackknife:
    """The covariance of the free parameters by how the frames disagree, to first order.

    It contains what frames have in common beyond their points' noise: a bent board, blur, wrong exposure times. A plain
    jackknife's deviations are too large by 15 to 40 % with a dozen boards that determine all parameters between them;
    Bell and McCaffrey's (2002) correction removes that.
    """
    parts = linearised(problem)
    equations = normal_equations(problem, parts)
    b, c = equations.W.shape[:2]
    H, g = np.zeros((b, c, c)), np.zeros((b, c))
    for part in parts.values():
        columns = part.columns
        own, slope = np.zeros((b, len(columns), len(columns))), np.zeros((b, len(columns)))
        np.add.at(own, part.block, np.einsum("nip,niq->npq", part.by_shared, part.by_shared))
        np.add.at(slope, part.block, np.einsum("nip,ni->np", part.by_shared, part.r))
        H[:, columns[:, None], columns] += own
        g[:, columns] += slope
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
    """The covariance by the slopes g (b, c) of frames, each scaled by (1 - its share H of the information)^(-1/2)."""
    scale = 1 / np.sqrt(total.diagonal())
    whiten = np.linalg.inv(np.linalg.cholesky(total * scale * scale[:, None])) * scale
    share, axes = np.linalg.eigh(whiten @ H @ whiten.T)
    slopes = np.einsum("bji,bj->bi", axes, g @ whiten.T) / np.sqrt(np.maximum(1 - share, 1e-6))
    changes = np.einsum("bij,bj->bi", axes, slopes) @ whiten
    return np.asarray(changes.T @ changes)
