"""Bundle adjustment: cameras and what they look at, together, so that the pixels fit.

What is looked at comes in blocks that only cameras tie together: a board in one pose (6 numbers), or a free point
(3). Gauss-Newton with Levenberg's damping on the Schur complement of the blocks (Triggs et al. 2000, section 6); the
derivatives by the cameras' numbers are autodiff's through `arraygeom`. Pixels are weighed by each camera's own noise,
and a residual r beyond k = 3 standard deviations by (k / r)^2, so that a gross error has next to no say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from arraygeom import Camera, Pose, Rig

ROBUST = 3.0
"""From this many standard deviations on a residual counts less."""
RAYLEIGH_MEDIAN = 1.17741
"""The median length of a vector of two independent standard normal numbers."""
QUIETEST = 1e-3
"""Noise below this, in pixels, is taken to be this: perfect corners must not weigh infinitely."""

SETTLED = 1e-3
"""A step that lowers the loss by less than this, in squared standard deviations, changes nothing that matters."""
POOLED = 50
"""Each camera's noise is estimated as if it had so many more residuals of the average noise of all."""

Array = np.ndarray


class Observations(NamedTuple):
    """What one camera saw: of which block, where on it (metres; zeros for a free point), and at which pixel."""

    block: Int[np.ndarray, " n"]
    p: Float[np.ndarray, "n 3"]
    x: Float[np.ndarray, "n 2"]


@runtime_checkable
class Structure(Protocol):
    """The blocks of what is looked at."""

    @property
    def width(self) -> int:
        """Numbers in a block."""

    def __len__(self) -> int: ...

    def world(self, seen: Observations) -> Float[np.ndarray, "n 3"]:
        """The observed points in the world, metres."""

    def jacobian(self, seen: Observations) -> Float[np.ndarray, "n 3 d"]:
        """Their derivatives by the numbers of their blocks."""

    def stepped(self, change: Float[np.ndarray, "b d"]) -> Structure:
        """The blocks after a change of their numbers."""


@dataclass(frozen=True)
class BoardPoses:
    """A rigid board in many poses, `world_from_board` batched over them."""

    world_from_board: Pose

    @property
    def width(self) -> int:
        """Six: a rotation vector and a translation."""
        return 6

    def __len__(self) -> int:
        return len(self.world_from_board.t)

    def world(self, seen: Observations) -> Float[np.ndarray, "n 3"]:
        """The observed points in the world, metres."""
        return self._turned(seen) + self.world_from_board.t.numpy()[seen.block]

    def jacobian(self, seen: Observations) -> Float[np.ndarray, "n 3 6"]:
        """Derivatives by a rotation vector about the world's axes, exp(w) R, and by the translation."""
        x, y, z = self._turned(seen).T
        o, one = np.zeros_like(x), np.ones_like(x)
        rows = [[o, z, -y, one, o, o], [-z, o, x, o, one, o], [y, -x, o, o, o, one]]
        return np.moveaxis(np.array(rows), -1, 0)

    def stepped(self, change: Float[np.ndarray, "b 6"]) -> BoardPoses:
        """The boards after a change of their poses."""
        rotation, translation = torch.from_numpy(change).split(3, -1)
        return BoardPoses(self.world_from_board.perturbed(rotation, translation))

    def _turned(self, seen: Observations) -> Array:
        return np.einsum("nij,nj->ni", self.world_from_board.R.numpy()[seen.block], seen.p)


@dataclass(frozen=True)
class FreePoints:
    """Points each on its own, metres."""

    X: Float[np.ndarray, "b 3"]

    @property
    def width(self) -> int:
        """Three."""
        return 3

    def __len__(self) -> int:
        return len(self.X)

    def world(self, seen: Observations) -> Float[np.ndarray, "n 3"]:
        """The observed points in the world, metres."""
        return self.X[seen.block]

    def jacobian(self, seen: Observations) -> Float[np.ndarray, "n 3 3"]:
        """The identity."""
        return np.broadcast_to(np.eye(3), (len(seen.block), 3, 3))

    def stepped(self, change: Float[np.ndarray, "b 3"]) -> FreePoints:
        """The points moved."""
        return FreePoints(self.X + change)


Free = Mapping[str, Bool[np.ndarray, "_"]]
"""By camera, which of its numbers may change, in the order of `parameter_names`."""


class Expected(NamedTuple):
    """What is thought of a camera's intrinsics before any image: each number's mean, and the inverse covariance.

    In the order of `parameter_names`; poses have no part in it.
    """

    mean: Float[np.ndarray, " p"]
    information: Float[np.ndarray, "p p"]

    def slope(self, camera: Camera) -> Float[np.ndarray, " p"]:
        """By how much a step of each number lowers half the squared deviations."""
        return self.information @ (self.mean - intrinsic_numbers(camera))

    def loss(self, camera: Camera) -> float:
        """Half the sum of the squared deviations."""
        return float(self.slope(camera) @ (self.mean - intrinsic_numbers(camera))) / 2


@dataclass(frozen=True)
class Scene:
    """Cameras, what they look at, what they saw of it; and, by camera, what is expected of it, if anything."""

    cameras: Mapping[str, Camera]
    structure: Structure
    seen: Mapping[str, Observations]
    expected: Mapping[str, Expected] = field(default_factory=dict)

    def residuals(self) -> dict[str, Float[np.ndarray, "_ 2"]]:
        """By camera: measured minus projected, pixels."""
        found = {}
        for name, seen in self.seen.items():
            X = torch.from_numpy(self.structure.world(seen))
            found[name] = seen.x - self.cameras[name].project(X).x.detach().numpy()
        return found

    def rms(self) -> float:
        """Root of the mean squared length of all residuals, pixels: what OpenCV calls the reprojection error."""
        lengths = np.concatenate([(r**2).sum(-1) for r in self.residuals().values()])
        return float(np.sqrt(lengths.mean()))


class Fit(NamedTuple):
    """A scene after bundle adjustment.

    sigma: each camera's noise along x or y, pixels; it has been estimated from the residuals.
    names, covariance: of the numbers that were free, in their own units; None where they cannot be told.
    """

    scene: Scene
    sigma: dict[str, float]
    names: tuple[str, ...]
    covariance: Float[np.ndarray, "c c"] | None
    iterations: int
    converged: bool


def parameter_names(camera: Camera) -> list[str]:
    """The numbers of a camera as `Rig.parameters` orders them: "rotation.0", ..., "distortion.4"."""
    return [f"{key.removeprefix('.')}.{i}" for key, size in parameter_sizes(camera).items() for i in range(size)]


def intrinsic_numbers(camera: Camera) -> Float[np.ndarray, " p"]:
    """Their values, in the order of `parameter_names`; 0 for those of the pose."""
    lens = () if camera.distortion is None else camera.distortion.coefficients.tolist()
    K = camera.K.detach().numpy()
    return np.array([*(0.0,) * 6, K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens])


def parameter_sizes(camera: Camera) -> dict[str, int]:
    """How many numbers each of a camera's parameters has, by the name it has in a rig with one camera called ""."""
    lens = {} if camera.distortion is None else {".distortion": camera.distortion.coefficients.shape[-1]}
    return {".rotation": 3, ".translation": 3, ".focal": 2, ".centre": 2} | lens


def adjust(scene: Scene, free: Free, *, rounds: int = 4, iterations: int = 50, alike: bool = False) -> Fit:
    """The scene in which free numbers of cameras and all blocks are such that the pixels fit best.

    First by least squares that take every residual seriously, as the start may be far off; then `rounds` times with
    the noise estimated for each camera from what is left. (Cameras weighed by their noise from the beginning would
    give up on the one that starts worst.) With `alike` all cameras have the same noise: where what they see moves
    between their exposures, a camera with a noise of its own would draw every board to itself.
    """
    parameters = _count(free) + len(scene.structure) * scene.structure.width
    scene, done, converged = _minimise(
        scene, free, dict.fromkeys(scene.cameras, max(scene.rms(), QUIETEST)), iterations
    )
    sigma = _pooled(noise(scene, parameters))
    for _ in range(rounds):
        scene, used, converged = _minimise(scene, free, sigma, iterations)
        done += used
        before, sigma = sigma, noise(scene, parameters)
        sigma = _pooled(sigma) if alike else sigma
        if all(abs(np.log(sigma[name] / before[name])) < 1e-2 for name in sigma):
            break
    names = tuple(
        f"{name}.{entry}"
        for name, camera in scene.cameras.items()
        for entry, is_free in zip(parameter_names(camera), free[name])
        if is_free
    )
    return Fit(scene, sigma, names, _covariance(scene, free, sigma), done, converged)


def _pooled(sigma: Mapping[str, float]) -> dict[str, float]:
    """The same for all cameras."""
    return dict.fromkeys(sigma, float(np.sqrt(np.mean(np.square(list(sigma.values()))))))


def noise(scene: Scene, parameters: int) -> dict[str, float]:
    """Each camera's noise along x or y in pixels, whatever a few gross errors are, for so many fitted numbers."""
    residuals = scene.residuals()
    numbers = 2 * sum(len(r) for r in residuals.values())
    left = numbers / max(numbers - parameters, 0.1 * numbers)
    squares, counts = np.array([(_square(r), len(r)) for r in residuals.values()]).T
    average = np.exp(np.average(np.log(squares), weights=counts))
    pooled = left * (counts * squares + POOLED * average) / (counts + POOLED)
    return dict(zip(residuals, np.sqrt(pooled).tolist()))


def _square(r: Array) -> float:
    """The mean square of a coordinate with gross errors weighed down."""
    lengths = np.linalg.norm(r, axis=-1)
    typical = max(float(np.median(lengths)) / RAYLEIGH_MEDIAN, QUIETEST)
    return max(float((_weights(lengths / typical) * lengths**2).mean() / 2), QUIETEST**2)


def _weights(lengths: Array) -> Array:
    """Of residuals in standard deviations."""
    return np.minimum(1.0, (ROBUST / np.maximum(lengths, ROBUST)) ** 2)


def _loss(scene: Scene, sigma: Mapping[str, float]) -> float:
    """Sum over residuals of s in standard deviations: s^2 / 2 up to k, k^2 (1/2 + log(s / k)) beyond."""
    total = sum(expected.loss(scene.cameras[name]) for name, expected in scene.expected.items())
    for name, r in scene.residuals().items():
        s = np.linalg.norm(r, axis=-1) / sigma[name]
        far = np.maximum(s, ROBUST)
        total += float(np.where(s < ROBUST, s**2 / 2, ROBUST**2 * (0.5 + np.log(far / ROBUST))).sum())
    return total


def _minimise(scene: Scene, free: Free, sigma: Mapping[str, float], iterations: int) -> tuple[Scene, int, bool]:
    """Levenberg's loop: (scene, iterations, converged)."""
    loss, damping = _loss(scene, sigma), 1e-4
    for iteration in range(1, iterations + 1):
        equations = normal_equations(scene, free, sigma)
        while True:
            trial = _stepped(scene, free, *equations.solved(damping))
            trial_loss = _loss(trial, sigma)
            if trial_loss < loss:
                break
            damping *= 10
            if damping > 1e6:
                return scene, iteration, True
        gained, scene, loss, damping = loss - trial_loss, trial, trial_loss, max(damping / 10, 1e-12)
        if gained < SETTLED:
            return scene, iteration, True
    return scene, iterations, False


def _stepped(scene: Scene, free: Free, change: Array, blocks: Array) -> Scene:
    cameras, at = {}, 0
    for name, camera in scene.cameras.items():
        full = np.zeros(len(free[name]))
        count = int(free[name].sum())
        full[free[name]] = change[at : at + count]
        cameras[name] = _changed(camera, torch.from_numpy(full))
        at += count
    return replace(scene, cameras=cameras, structure=scene.structure.stepped(blocks))


def _changed(camera: Camera, change: torch.Tensor) -> Camera:
    """The camera after a change of all its numbers, in the order of `parameter_names`."""
    sizes = parameter_sizes(camera)
    changed = Rig({"": camera}).perturbed(dict(zip(sizes, change.split(list(sizes.values())))))[""]
    assert isinstance(changed, Camera)
    return changed


def camera_jacobian(camera: Camera, X: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 p"]:
    """Derivatives of the pixels of world points by the camera's numbers, in the order of `parameter_names`.

    Two reverse passes in which every point has a copy of the intrinsics to itself; the pose's follow by the chain rule.
    """
    local = camera.cam_from_world.apply(torch.from_numpy(X)).detach().requires_grad_()
    sizes = {key: size for key, size in parameter_sizes(camera).items() if key not in (".rotation", ".translation")}
    change = torch.zeros(len(X), sum(sizes.values()), dtype=local.dtype, requires_grad=True)
    copies = Rig({"": camera}).perturbed(dict(zip(sizes, change.split(list(sizes.values()), -1))))[""]
    assert isinstance(copies, Camera)
    x = copies.project_local(local[:, None]).x[:, 0]
    by_point, by_change = zip(*(torch.autograd.grad(v.sum(), (local, change), retain_graph=True) for v in x.unbind(-1)))
    along = torch.stack(by_point, 1)
    turning = torch.linalg.cross((local.detach() - camera.t)[:, None].expand_as(along), along)
    return torch.cat([turning, along, torch.stack(by_change, 1)], -1).numpy()


@dataclass(frozen=True)
class NormalEquations:
    """[H W; W^T B] [cameras; blocks] = [g; h], B block-diagonal (b, d, d), W (b, c, d)."""

    H: Array
    W: Array
    B: Array
    g: Array
    h: Array

    def solved(self, damping: float) -> tuple[Array, Array]:
        """The step of cameras (c,) and blocks (b, d), diagonals raised by the factor 1 + damping."""
        S, Y, inverse = self._reduced(damping)
        scale = 1 / np.sqrt(np.maximum(S.diagonal(), 1e-300))
        change = (
            scale
            * np.linalg.lstsq(
                S * scale[:, None] * scale, scale * (self.g - np.einsum("bcd,bd->c", Y, self.h)), rcond=1e-14
            )[0]
        )
        blocks = np.einsum("bde,be->bd", inverse, self.h - np.einsum("bcd,c->bd", self.W, change))
        return change, blocks

    def information(self) -> Array:
        """The inverse covariance (c, c) of the cameras' numbers, the blocks being unknown too."""
        return self._reduced(0.0)[0]

    def _reduced(self, damping: float) -> tuple[Array, Array, Array]:
        eye = np.eye(self.B.shape[-1])
        raised = self.B * (1 + damping * eye) + 1e-12 * eye
        inverse = np.linalg.inv(raised)
        Y = self.W @ inverse
        H = self.H + damping * np.diag(self.H.diagonal())
        return H - np.tensordot(Y, self.W, axes=([0, 2], [0, 2])), Y, inverse


def normal_equations(scene: Scene, free: Free, sigma: Mapping[str, float]) -> NormalEquations:
    """Gauss-Newton's equations at the scene, for the free numbers of its cameras and all its blocks."""
    d, b, c = scene.structure.width, len(scene.structure), _count(free)
    H, W, B, g, h = np.zeros((c, c)), np.zeros((b, c, d)), np.zeros((b, d, d)), np.zeros(c), np.zeros((b, d))
    at = 0
    for name in scene.cameras:
        mine = slice(at, at := at + int(free[name].sum()))
        r, by_camera, by_block = _linearised(scene, name, sigma[name])
        by_camera = by_camera[..., free[name]]
        H[mine, mine] = np.einsum("nip,niq->pq", by_camera, by_camera)
        g[mine] = np.einsum("nip,ni->p", by_camera, r)
        if (expected := scene.expected.get(name)) is not None:
            H[mine, mine] += expected.information[np.ix_(free[name], free[name])]
            g[mine] += expected.slope(scene.cameras[name])[free[name]]
        block = scene.seen[name].block
        np.add.at(B, block, np.einsum("nid,nie->nde", by_block, by_block))
        np.add.at(h, block, np.einsum("nid,ni->nd", by_block, r))
        np.add.at(W[:, mine], block, np.einsum("nip,nid->npd", by_camera, by_block))
    return NormalEquations(H, W, B, g, h)


def _linearised(scene: Scene, name: str, sigma: float) -> tuple[Array, Array, Array]:
    """One camera's residuals (n, 2) and their derivatives by its numbers and by the blocks', all weighted."""
    camera, seen = scene.cameras[name], scene.seen[name]
    X = scene.structure.world(seen)
    r = seen.x - camera.project(torch.from_numpy(X)).x.numpy()
    by_camera = camera_jacobian(camera, X)
    by_block = by_camera[..., 3:6] @ camera.R.numpy() @ scene.structure.jacobian(seen)
    weight = np.sqrt(_weights(np.linalg.norm(r, axis=-1) / sigma)) / sigma
    return weight[:, None] * r, weight[:, None, None] * by_camera, weight[:, None, None] * by_block


def _covariance(scene: Scene, free: Free, sigma: Mapping[str, float]) -> Array | None:
    """Of the free numbers of the cameras; None if some combination of them changes no pixel."""
    information = normal_equations(scene, free, sigma).information()
    scale = 1 / np.sqrt(np.maximum(information.diagonal(), 1e-300))
    scaled = information * scale[:, None] * scale
    if len(scaled) and np.linalg.eigvalsh(scaled)[0] < 1e-13:
        return None
    return np.linalg.inv(scaled) * scale[:, None] * scale


def _count(free: Free) -> int:
    return sum(int(mask.sum()) for mask in free.values())
