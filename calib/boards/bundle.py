"""Bundle adjustment: cameras and the board poses they observed, fitted together to the pixels.

The structure comes in blocks that only cameras couple: a board pose has 6 parameters. Gauss-Newton with Levenberg's
damping on the Schur complement of the blocks (Triggs et al. 2000, section 6); derivatives with respect to the camera
parameters are automatic, through `arraygeom`. Pixels are weighted by the noise of their camera, and a residual r beyond
k = 3 standard deviations by (k / r)^2, so that outliers have little influence.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from arraygeom import Camera, Pose

from .camera_parameters import CameraPrior, camera_jacobian, changed, parameter_names
from .shape import BoardShape

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

Array = np.ndarray
Key = TypeVar("Key")


class Observations(NamedTuple):
    """Points observed by one camera: their block, their position in it (metres) and their pixel."""

    block: Int[np.ndarray, " n"]
    p: Float[np.ndarray, "n 3"]
    x: Float[np.ndarray, "n 2"]


@runtime_checkable
class Structure(Protocol):
    """Blocks of parameters of the observed points."""

    width: ClassVar[int]
    """Parameters per block."""

    def __len__(self) -> int: ...

    def world(self, seen: Observations) -> Float[np.ndarray, "n 3"]:
        """The observed points in the world, metres."""

    def jacobian(self, seen: Observations) -> Float[np.ndarray, "n 3 d"]:
        """Their derivatives with respect to the parameters of their blocks."""

    def stepped(self, change: Float[np.ndarray, "b d"]) -> Structure:
        """The blocks after a change of their parameters."""


@dataclass(frozen=True)
class BoardPoses:
    """A rigid board in many poses, `world_from_board` batched over them."""

    world_from_board: Pose
    width: ClassVar[int] = 6
    """A rotation vector and a translation."""

    def __len__(self) -> int:
        return len(self.world_from_board.t)

    def world(self, seen: Observations) -> Float[np.ndarray, "n 3"]:
        """The observed points in the world, metres."""
        return self._rotated(seen) + self.world_from_board.t.numpy()[seen.block]

    def jacobian(self, seen: Observations) -> Float[np.ndarray, "n 3 6"]:
        """Derivatives with respect to a rotation vector about the world's axes, exp(w) R, and the translation."""
        x, y, z = self._rotated(seen).T
        o, one = np.zeros_like(x), np.ones_like(x)
        rows = [[o, z, -y, one, o, o], [-z, o, x, o, one, o], [y, -x, o, o, o, one]]
        return np.moveaxis(np.array(rows), -1, 0)

    def stepped(self, change: Float[np.ndarray, "b 6"]) -> BoardPoses:
        """The boards after a change of their poses."""
        rotation, translation = torch.from_numpy(change).split(3, -1)
        return BoardPoses(self.world_from_board.perturbed(rotation, translation))

    def _rotated(self, seen: Observations) -> Array:
        return np.einsum("nij,nj->ni", self.world_from_board.R.numpy()[seen.block], seen.p)


Free = Mapping[str, Bool[np.ndarray, "_"]]
"""By camera, a mask of the parameters that may change, in the order of `parameter_names`."""


@dataclass(frozen=True)
class BundleProblem:
    """Cameras, structure and observations; optionally a prior of each camera.

    shape: the shape of the boards, adjusted with the cameras; None for flat ones, and where there are no boards.
    """

    cameras: Mapping[str, Camera]
    structure: Structure
    seen: Mapping[str, Observations]
    priors: Mapping[str, CameraPrior] = field(default_factory=dict)
    shape: BoardShape | None = None

    def observed(self, name: str) -> Observations:
        """What a camera observed, at its positions on the boards as they are shaped."""
        seen = self.seen[name]
        return seen if self.shape is None else seen._replace(p=self.shape.deformed(seen.p, self.shape.part[seen.block]))

    def residuals(self) -> dict[str, Float[np.ndarray, "_ 2"]]:
        """By camera: measured minus projected, pixels."""
        found = {}
        for name, seen in self.seen.items():
            X = torch.from_numpy(self.structure.world(self.observed(name)))
            found[name] = seen.x - self.cameras[name].project(X).x.detach().numpy()
        return found

    def board_poses(self, keys: Iterable[Key]) -> dict[Key, Pose]:
        """`world_from_board` by key, for keys in the order of the blocks. Raises TypeError for other structures."""
        if not isinstance(self.structure, BoardPoses):
            raise TypeError(f"the structure is {type(self.structure).__name__}; wanted BoardPoses")
        boards = self.structure.world_from_board
        return {key: boards[i] for i, key in enumerate(keys)}

    def rms(self) -> float:
        """Root mean square length of all residuals, pixels: OpenCV's reprojection error."""
        lengths = np.concatenate([(r**2).sum(-1) for r in self.residuals().values()])
        return float(np.sqrt(lengths.mean()))


class BundleResult(NamedTuple):
    """A problem after bundle adjustment.

    sigma: each camera's noise along x or y, pixels, estimated from the residuals.
    names, covariance: of the cameras' free parameters, in their own units; None where they are not observable.
    """

    problem: BundleProblem
    sigma: dict[str, float]
    names: tuple[str, ...]
    covariance: Float[np.ndarray, "c c"] | None
    converged: bool

    def free(self) -> dict[str, Bool[np.ndarray, "_"]]:
        """The masks of the parameters that were free."""
        named = set(self.names)
        return {
            name: np.array([f"{name}.{entry}" in named for entry in parameter_names(camera)])
            for name, camera in self.problem.cameras.items()
        }


def adjust(problem: BundleProblem, free: Free, *, rounds: int = 4, equal_noise: bool = False) -> BundleResult:
    """Minimise the reprojection error over the free camera parameters and all blocks.

    First by least squares of equal noise, as the initial values may be poor; then `rounds` times with the noise of each
    camera estimated from its residuals. (Individual noise from the beginning would discard the camera that starts
    worst.) With `equal_noise` all cameras share one noise: where the board moves between exposures, a camera with a
    noise of its own would attract every board pose.
    """
    parameters = _count(free) + len(problem.structure) * problem.structure.width
    problem, converged = _minimise(problem, free, dict.fromkeys(problem.cameras, max(problem.rms(), LEAST_NOISE)))
    sigma = _pooled(noise(problem, parameters))
    for _ in range(rounds):
        problem, converged = _minimise(problem, free, sigma)
        before, sigma = sigma, noise(problem, parameters)
        sigma = _pooled(sigma) if equal_noise else sigma
        if all(abs(np.log(sigma[name] / before[name])) < 1e-2 for name in sigma):
            break
    names = tuple(
        f"{name}.{entry}"
        for name, camera in problem.cameras.items()
        for entry, is_free in zip(parameter_names(camera), free[name])
        if is_free
    )
    return BundleResult(problem, sigma, names, _covariance(problem, free, sigma), converged)


def readjusted(problem: BundleProblem, free: Free, sigma: Mapping[str, float]) -> BundleProblem:
    """The problem adjusted once more, from a solution of nearly the same problem and with its noise."""
    return _minimise(problem, free, sigma, iterations=10)[0]


def _pooled(sigma: Mapping[str, float]) -> dict[str, float]:
    """Their root mean square, for all cameras."""
    return dict.fromkeys(sigma, float(np.sqrt(np.mean(np.square(list(sigma.values()))))))


def noise(problem: BundleProblem, parameters: int) -> dict[str, float]:
    """A robust estimate of each camera's noise along x or y, pixels, given the number of fitted parameters."""
    residuals = problem.residuals()
    numbers = 2 * sum(len(r) for r in residuals.values())
    left = numbers / max(numbers - parameters, 0.1 * numbers)
    squares, counts = np.array([(_square(r), len(r)) for r in residuals.values()]).T
    average = np.exp(np.average(np.log(squares), weights=counts))
    pooled = left * (counts * squares + POOLED * average) / (counts + POOLED)
    return dict(zip(residuals, np.sqrt(pooled).tolist()))


def _square(r: Array) -> float:
    """The mean square of a coordinate, with outliers down-weighted."""
    lengths = np.linalg.norm(r, axis=-1)
    typical = max(float(np.median(lengths)) / RAYLEIGH_MEDIAN, LEAST_NOISE)
    return max(float((_weights(lengths / typical) * lengths**2).mean() / 2), LEAST_NOISE**2)


def _weights(lengths: Array) -> Array:
    """Robust weights of residuals in standard deviations."""
    return np.minimum(1.0, (ROBUST / np.maximum(lengths, ROBUST)) ** 2)


def loss(problem: BundleProblem, sigma: Mapping[str, float]) -> float:
    """Sum over residuals of s in standard deviations: s^2 / 2 up to k, k^2 (1/2 + log(s / k)) beyond."""
    total = sum(prior.loss(problem.cameras[name]) for name, prior in problem.priors.items())
    if problem.shape is not None:
        total += float(problem.shape.information @ problem.shape.values.ravel() ** 2) / 2
    for name, r in problem.residuals().items():
        s = np.linalg.norm(r, axis=-1) / sigma[name]
        far = np.maximum(s, ROBUST)
        total += float(np.where(s < ROBUST, s**2 / 2, ROBUST**2 * (0.5 + np.log(far / ROBUST))).sum())
    return total


def _minimise(
    problem: BundleProblem, free: Free, sigma: Mapping[str, float], *, iterations: int = 50
) -> tuple[BundleProblem, bool]:
    """Levenberg's loop: (problem, converged)."""
    least, damping = loss(problem, sigma), 1e-4
    for _ in range(iterations):
        equations = normal_equations(problem, free, sigma)
        while True:
            trial = _stepped(problem, free, *equations.solve(damping))
            trial_loss = loss(trial, sigma)
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


def _stepped(problem: BundleProblem, free: Free, change: Array, blocks: Array) -> BundleProblem:
    cameras, at = {}, 0
    for name, camera in problem.cameras.items():
        full = np.zeros(len(free[name]))
        count = int(free[name].sum())
        full[free[name]] = change[at : at + count]
        cameras[name] = changed(camera, torch.from_numpy(full))
        at += count
    shape = problem.shape and problem.shape.stepped(change[at:])
    return replace(problem, cameras=cameras, structure=problem.structure.stepped(blocks), shape=shape)


@dataclass(frozen=True)
class NormalEquations:
    """[H W; W^T B] [cameras; blocks] = [g; h], B block-diagonal (b, d, d), W (b, c, d).

    shapes: the number of the cameras' rows, at their end, that are of the boards' shapes.
    """

    H: Array
    W: Array
    B: Array
    g: Array
    h: Array
    shapes: int = 0

    def solve(self, damping: float) -> tuple[Array, Array]:
        """The step of cameras (c,) and blocks (b, d), with diagonals multiplied by 1 + damping."""
        S, Y, inverse = self._reduced(damping)
        scale = 1 / np.sqrt(np.maximum(S.diagonal(), 1e-300))
        reduced = scale * (self.g - np.einsum("bcd,bd->c", Y, self.h))
        change = scale * np.linalg.lstsq(S * scale[:, None] * scale, reduced, rcond=1e-14)[0]
        blocks = np.einsum("bde,be->bd", inverse, self.h - np.einsum("bcd,c->bd", self.W, change))
        return change, blocks

    def information(self) -> Array:
        """The inverse covariance (c, c) of the camera parameters, marginalised over the blocks and the shapes."""
        S = self.information_with_shapes()
        c = len(S) - self.shapes
        return S[:c, :c] - S[:c, c:] @ np.linalg.solve(S[c:, c:], S[c:, :c])

    def information_with_shapes(self) -> Array:
        """The inverse covariance of the camera parameters and the boards' shapes."""
        return self._reduced(0.0)[0]

    def _reduced(self, damping: float) -> tuple[Array, Array, Array]:
        eye = np.eye(self.B.shape[-1])
        raised = self.B * (1 + damping * eye) + 1e-12 * eye
        inverse = np.linalg.inv(raised)
        Y = self.W @ inverse
        H = self.H + damping * np.diag(self.H.diagonal())
        return H - np.tensordot(Y, self.W, axes=([0, 2], [0, 2])), Y, inverse


def normal_equations(problem: BundleProblem, free: Free, sigma: Mapping[str, float]) -> NormalEquations:
    """The Gauss-Newton equations of the free camera parameters, the boards' shapes and all blocks."""
    shapes = 0 if problem.shape is None else len(problem.shape)
    d, b, c = problem.structure.width, len(problem.structure), _count(free) + shapes
    H, W, B, g, h = np.zeros((c, c)), np.zeros((b, c, d)), np.zeros((b, d, d)), np.zeros(c), np.zeros((b, d))
    at = 0
    for name in problem.cameras:
        mine = np.array([*range(at, at := at + int(free[name].sum())), *range(c - shapes, c)], dtype=int)
        part = linearised(problem, name, sigma[name], free[name])
        rows = part.by_shared.reshape(2 * len(part.r), len(mine))
        H[np.ix_(mine, mine)] += rows.T @ rows
        g[mine] += np.einsum("nip,ni->p", part.by_shared, part.r)
        if (prior := problem.priors.get(name)) is not None:
            own = mine[: len(mine) - shapes]
            information, slope = prior.equations(problem.cameras[name])
            H[np.ix_(own, own)] += information[np.ix_(free[name], free[name])]
            g[own] += slope[free[name]]
        np.add.at(B, part.block, np.einsum("nid,nie->nde", part.by_block, part.by_block))
        np.add.at(h, part.block, np.einsum("nid,ni->nd", part.by_block, part.r))
        coupled = np.zeros((b, len(mine), d))
        np.add.at(coupled, part.block, np.einsum("nip,nid->npd", part.by_shared, part.by_block))
        W[:, mine] += coupled
    if problem.shape is not None:
        H[range(c - shapes, c), range(c - shapes, c)] += problem.shape.information
        g[c - shapes :] -= problem.shape.information * problem.shape.values.ravel()
    return NormalEquations(H, W, B, g, h, shapes)


class Linearised(NamedTuple):
    """One camera's residuals (n, 2), and its pixels' derivatives by parameters and shapes, and by blocks, weighted."""

    r: Array
    by_shared: Array
    by_block: Array
    block: Array


def linearised(problem: BundleProblem, name: str, sigma: float, free: np.ndarray) -> Linearised:
    """A camera's residuals and derivatives for its noise (pixels) and the mask of its free parameters."""
    camera, seen = problem.cameras[name], problem.observed(name)
    X = problem.structure.world(seen)
    r = seen.x - camera.project(torch.from_numpy(X)).x.numpy()
    by_camera = camera_jacobian(camera, X)
    by_point = by_camera[..., 3:6] @ camera.R.numpy()
    by_block = by_point @ problem.structure.jacobian(seen)
    by_shared = np.concatenate([by_camera[..., free], by_point @ _by_shape(problem, name)], -1)
    weight = np.sqrt(_weights(np.linalg.norm(r, axis=-1) / sigma)) / sigma
    wide = weight[:, None, None]
    return Linearised(weight[:, None] * r, wide * by_shared, wide * by_block, seen.block)


def _by_shape(problem: BundleProblem, name: str) -> Array:
    """Derivatives (n, 3, s) of a camera's points in the world with respect to the boards' shapes."""
    seen = problem.seen[name]
    if problem.shape is None or not isinstance(problem.structure, BoardPoses):
        return np.zeros((len(seen.block), 3, 0))
    on_board = problem.shape.jacobian(seen.p, problem.shape.part[seen.block])
    return problem.structure.world_from_board.R.numpy()[seen.block] @ on_board


def _covariance(problem: BundleProblem, free: Free, sigma: Mapping[str, float]) -> Array | None:
    """Of the free camera parameters; None if some combination of them changes no pixel."""
    information = normal_equations(problem, free, sigma).information()
    scale = 1 / np.sqrt(np.maximum(information.diagonal(), 1e-300))
    scaled = information * scale[:, None] * scale
    if len(scaled) and np.linalg.eigvalsh(scaled)[0] < 1e-13:
        return None
    return np.linalg.inv(scaled) * scale[:, None] * scale


def _count(free: Free) -> int:
    return sum(int(mask.sum()) for mask in free.values())
