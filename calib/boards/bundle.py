"""Bundle adjustment problem: cameras, boards, observations, and its normal equations.

Boards are coupled by the cameras alone: the equations are those of the cameras after the Schur complement of
the boards (Triggs et al. 2000, section 6); derivatives with respect to the camera parameters are automatic,
through `arraygeom`. Pixels are weighted by the noise of their camera, and a residual r beyond k = 3 standard
deviations by (k / r)^2, so that outliers have little influence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from arraygeom import Camera, Pose, Rig, stack
from arraygeom.distortion import lens_derivatives, pinhole_coefficients, term, typical_coefficients
from arraygeom.lenses.central import MODELS, within_bounds
from arraygeom.pixels import map_homogeneous
from arraygeom.pose import rotation_vector
from arraygeom.rig import focal_positions

from .board import Board, KnownPoints
from .deformation import BoardDeformation
from .detect import BoardViews
from .photos import FrameKey

ROBUST = 3.0
"""Standard deviations beyond which residuals are down-weighted."""
POSE = 6
"""Parameters of a board's pose: a rotation vector about the world's axes, and a translation."""
TYPICAL_FOCAL_ERROR, TYPICAL_CENTRE_ERROR = 0.1, 0.1
"""Typical error of a guessed focal length as a share of it, and of a principal point as a share
of the width."""
CENTRE_DEVIATION, ASPECT_DEVIATION = 0.03, 0.01
"""Standard deviations of the principal point from the centre (share of the width), and of the
aspect ratio."""
Array = np.ndarray
Masks = Mapping[str, Bool[np.ndarray, " _"]]
"""Mask of each camera's parameters, in the order of `parameter_names`."""


class Observations(NamedTuple):
    """Board points that one camera observed, of all its images.

    Attributes:
        block: index of each point's board pose in `BundleProblem.boards`.
        p: position of each on the board before it is deformed, in the board's frame, metres.
        x: pixel (x, y) of each.
    """

    block: Int[np.ndarray, " n"]
    p: Float[np.ndarray, "n 3"]
    x: Float[np.ndarray, "n 2"]


@dataclass(frozen=True)
class BundleProblem:
    """Bundle adjustment problem: cameras, board poses and observed points. Tensors are float64 on the CPU.

    Attributes:
        cameras: cameras by name.
        boards: poses `world_from_board`, a batch (b), all of them free.
        seen: observations by camera, at least one point each.
        frames: moment of each board pose, in the order of `boards`.
        free: mask by camera of the parameters that may change, in the order of `parameter_names`.
        sigma: standard deviation of the noise along x or y by camera, pixels; empty before it is estimated.
        priors: priors of parameters by camera; cameras without one are missing.
        deformation: shapes of the boards, adjusted with the cameras; None for boards as specified.
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
        """Free camera parameters, such as "left.focal.0"."""
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
        """Return the points that a camera observed on its deformed boards, in the boards' frames, metres."""
        observed = self.seen[name]
        if self.deformation is None:
            return observed.p
        return self.deformation.deformed(observed.p, self.deformation.part[observed.block])

    def rotated(self, name: str) -> Float[np.ndarray, "n 3"]:
        """Return the points that a camera observed less their board's origin, in the world's axes, metres."""
        return np.einsum("nij,nj->ni", self.boards.R.numpy()[self.seen[name].block], self.on_board(name))

    def world(self, name: str) -> Float[np.ndarray, "n 3"]:
        """Return the points that a camera observed in the world, metres."""
        return self.rotated(name) + self.boards.t.numpy()[self.seen[name].block]

    @cached_property
    def residuals(self) -> dict[str, Float[np.ndarray, "_ 2"]]:
        """Measured minus projected pixels, by camera."""
        residuals = {}
        for name, observed in self.seen.items():
            X = torch.from_numpy(self.world(name))
            residuals[name] = observed.x - self.cameras[name].project(X).x.detach().numpy()
        return residuals

    def rms(self) -> float:
        """Return the root mean square length of all residuals, pixels: OpenCV's reprojection error."""
        lengths = np.concatenate([(r**2).sum(-1) for r in self.residuals.values()])
        return float(np.sqrt(lengths.mean()))

    @cached_property
    def loss(self) -> float:
        """Robust loss that the adjustment minimises, a number without unit.

        A residual of length s, in standard deviations, costs s^2 / 2 up to k = `ROBUST`, and
        k^2 (1/2 + log(s / k)) beyond. The loss is the sum over all points, plus the priors of cameras and of
        board shapes. KeyError where `sigma` lacks a camera.
        """
        total = sum(prior.loss(self.cameras[name]) for name, prior in self.priors.items())
        if self.deformation is not None:
            total += self.deformation.loss()
        for name, r in self.residuals.items():
            s = np.linalg.norm(r, axis=-1) / self.sigma[name]
            far = np.maximum(s, ROBUST)
            total += float(np.where(s < ROBUST, s**2 / 2, ROBUST**2 * (0.5 + np.log(far / ROBUST))).sum())
        return total

    def of_boards(self, kept: Bool[np.ndarray, " b"]) -> BundleProblem:
        """Select board poses, with the points that were observed on them.

        Args:
            kept: mask of the board poses.

        Returns:
            The smaller problem, with the same cameras, of which some may have no points left.
        """
        index, observations = np.cumsum(kept) - 1, {}
        for name, s in self.seen.items():
            mine = kept[s.block]
            observations[name] = Observations(index[s.block[mine]], s.p[mine], s.x[mine])
        return replace(
            self,
            boards=self.boards[torch.from_numpy(kept)],
            seen=observations,
            frames=tuple(key for key, keep in zip(self.frames, kept) if keep),
            deformation=self.deformation and replace(self.deformation, part=self.deformation.part[kept]),
        )

    def stepped(self, change: Float[np.ndarray, " c"], boards: Float[np.ndarray, "b 6"]) -> BundleProblem:
        """Change the free parameters and the boards' poses by a step.

        Args:
            change: steps of the cameras' free parameters in the order of `names`, then of the boards' shapes.
            boards: steps of each board's pose: rotation vector in radians about the world's axes, translation
                in metres.

        Returns:
            The problem after the step (see `changed` and `Pose.perturbed`).
        """
        cameras, offset = {}, 0
        for name, camera in self.cameras.items():
            full = np.zeros(len(self.free[name]))
            count = int(self.free[name].sum())
            full[self.free[name]] = change[offset : offset + count]
            cameras[name] = changed(camera, torch.from_numpy(full))
            offset += count
        rotation, translation = torch.from_numpy(boards).split(3, -1)
        return replace(
            self,
            cameras=cameras,
            boards=self.boards.perturbed(rotation, translation),
            deformation=self.deformation and self.deformation.stepped(change[offset:]),
        )


class InitialRig(NamedTuple):
    """Initial values of a bundle adjustment.

    Attributes:
        cameras: cameras by name.
        boards: `world_from_board` by moment.
        views: detections by camera, numbered consistently.
        left_out: images (camera, moment) that contradict the others and are not in `views`.
        priors: priors by camera, with their roughly known poses; None for priors of ordinary cameras, of
            which the first keeps its pose.
        deformation: shapes of the boards to begin with; None for boards as specified.
    """

    cameras: Mapping[str, Camera]
    boards: Mapping[FrameKey, Pose]
    views: Mapping[str, BoardViews]
    left_out: Sequence[tuple[str, FrameKey]] = ()
    priors: Mapping[str, CameraPrior] | None = None
    deformation: BoardDeformation | None = None

    def problem(self, board: Board) -> BundleProblem:
        """Make the bundle adjustment problem.

        All parameters are free, except the first camera's pose if there are no priors.

        Returns:
            The problem, without noise levels, and with each `typical_prior` if there are no priors.

        Raises:
            KeyError: for a detection at a moment without a board pose, and a camera without views.
            TypeError: for a camera whose views have no detection.
        """
        index, observations, free = {key: i for i, key in enumerate(self.boards)}, {}, {}
        for number, (name, camera) in enumerate(self.cameras.items()):
            detections = self.views[name].seen
            parts = [
                (np.full(len(d.ids), index[key]), board.points[d.ids], d.x) for key, d in detections.items()
            ]
            observations[name] = Observations(*(np.concatenate(arrays) for arrays in zip(*parts)))
            free[name] = np.ones(len(parameter_names(camera)), dtype=bool)
            free[name][:6] = number > 0 or self.priors is not None
        priors = self.priors or {name: typical_prior(camera) for name, camera in self.cameras.items()}
        poses = stack(list(self.boards.values()))
        return BundleProblem(
            self.cameras, poses, observations, tuple(self.boards), free, {}, priors, self.deformation
        )

    def flat(self, board: Board) -> BoardDeformation | None:
        """Make flat shapes of the boards, in the order of the moments; None for points of known position."""
        if isinstance(board, KnownPoints):
            return None
        first = {key: d.ids[0] for v in self.views.values() for key, d in v.seen.items()}
        middle = np.stack([member.middle[:2] for member in board.members])
        return BoardDeformation.flat(middle, board.part[[first[key] for key in self.boards]])


@dataclass(frozen=True)
class Solved:
    """Solution of a bundle adjustment, its noise estimated from the residuals.

    `adjust` fills the first three fields; the functions around it add the others.

    Attributes:
        problem: the adjusted problem.
        covariance: posterior covariance of the cameras' free parameters (`names`) in their own units; None if
            they are not observable.
        converged: True if the last iteration converged.
        notes: sentences on the solution.
        raised: largest factor by which `with_disagreement` raised a standard deviation; 1 for none.
        views: detections used by camera.
        left_out: images (camera, moment) that contradict other cameras' images or the start rig.
    """

    problem: BundleProblem
    covariance: Float[np.ndarray, "c c"] | None
    converged: bool
    notes: tuple[str, ...] = ()
    raised: float = 1.0
    views: Mapping[str, BoardViews] = field(default_factory=dict)
    left_out: Sequence[tuple[str, FrameKey]] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Free parameters, in the order of the covariance."""
        return self.problem.names

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviation of each free parameter, in its unit, by name; empty without a covariance."""
        if self.covariance is None:
            return {}
        return dict(zip(self.names, np.sqrt(self.covariance.diagonal()).tolist()))


# Linear equations -------------------------------------------------------------------------------------------


class Linearised(NamedTuple):
    """Residuals and derivatives of one camera's pixels, both divided by the noise and weighted robustly.

    Attributes:
        r: residuals, measured minus projected.
        by_shared: derivatives of projections by the camera's free parameters and all boards' deformations.
        by_board: derivatives by the pose of each point's board, rotation vector and translation.
        block: index of each point's board pose.
        columns: row and column of the normal equations' H for each column of `by_shared`.
    """

    r: Float[np.ndarray, "n 2"]
    by_shared: Float[np.ndarray, "n 2 p"]
    by_board: Float[np.ndarray, "n 2 6"]
    block: Int[np.ndarray, " n"]
    columns: Int[np.ndarray, " p"]


def linearised(problem: BundleProblem) -> dict[str, Linearised]:
    """Linearise a problem about its present values; KeyError where `sigma` lacks a camera.

    Returns:
        Residuals and derivatives by camera, weighted by robustness and noise.
    """
    shapes = 0 if problem.deformation is None else len(problem.deformation)
    first, rows = 0, {}
    total = len(problem.names) + shapes
    for name, camera in problem.cameras.items():
        observed, free, sigma = problem.seen[name], problem.free[name], problem.sigma[name]
        last = first + int(free.sum())
        columns = np.array([*range(first, last), *range(total - shapes, total)], dtype=int)
        first = last
        x, by_camera = linear_projection(camera, problem.world(name))
        r = observed.x - x
        by_point = by_camera[..., 3:6] @ camera.R.numpy()
        by_board = np.concatenate([np.cross(problem.rotated(name)[:, None], by_point), by_point], -1)
        by_shared = np.concatenate([by_camera[..., free], by_point @ _by_deformation(problem, name)], -1)
        weight = np.sqrt(robust_weights(np.linalg.norm(r, axis=-1) / sigma)) / sigma
        wide = weight[:, None, None]
        rows[name] = Linearised(
            weight[:, None] * r, wide * by_shared, wide * by_board, observed.block, columns
        )
    return rows


def _by_deformation(problem: BundleProblem, name: str) -> Float[np.ndarray, "n 3 s"]:
    """Derivatives of a camera's world points by the boards' deformations."""
    observed = problem.seen[name]
    if problem.deformation is None:
        return np.zeros((len(observed.block), 3, 0))
    on_board = problem.deformation.jacobian(observed.p, problem.deformation.part[observed.block])
    return problem.boards.R.numpy()[observed.block] @ on_board


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations [H W; W^T B] [cameras; boards] = [g; h].

    Attributes:
        H: block of the cameras' free parameters and then the deformations (c, c).
        W: coupling with each board pose (b, c, 6).
        B: block of each board pose (b, 6, 6).
        g: right-hand side of the cameras and deformations (c).
        h: right-hand side of the board poses (b, 6).
        shapes: number of the last rows of H that belong to deformations.
    """

    H: Array
    W: Array
    B: Array
    g: Array
    h: Array
    shapes: int = 0

    def solve(self, damping: float) -> tuple[Array, Array]:
        """Solve for a step, with diagonals multiplied by 1 + damping.

        Returns:
            Steps of the cameras and deformations (c), where not determined the shortest once `reduced`'s
            diagonal is scaled to 1, and of the board poses (b, 6), as `BundleProblem.stepped` takes them.
        """
        S, Y, inverse = self.reduced(damping)
        scale = 1 / np.sqrt(np.maximum(S.diagonal(), 1e-300))
        right = scale * (self.g - np.einsum("bcd,bd->c", Y, self.h))
        change = scale * np.linalg.lstsq(S * scale[:, None] * scale, right, rcond=1e-14)[0]
        boards = np.einsum("bde,be->bd", inverse, self.h - np.einsum("bcd,c->bd", self.W, change))
        return change, boards

    def information(self) -> Array:
        """Compute the cameras' inverse covariance (c, c), marginalised over boards and deformations."""
        S, _, _ = self.reduced(0.0)
        c = len(S) - self.shapes
        return S[:c, :c] - S[:c, c:] @ np.linalg.solve(S[c:, c:], S[c:, :c])

    def reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """Eliminate the boards, after diagonals are multiplied by 1 + `damping`.

        Returns:
            The Schur complement (c, c), W B^-1 (b, c, 6), and B^-1 (b, 6, 6), all damped.
        """
        eye = np.eye(POSE)
        inverse = np.linalg.inv(self.B * (1 + damping * eye) + 1e-12 * eye)
        Y = self.W @ inverse
        H = self.H + damping * np.diag(self.H.diagonal())
        return H - np.tensordot(Y, self.W, axes=([0, 2], [0, 2])), Y, inverse


def normal_equations(problem: BundleProblem, parts: Mapping[str, Linearised]) -> NormalEquations:
    """Assemble the Gauss-Newton equations of free camera parameters, board shapes and board poses.

    Args:
        parts: result of `linearised`; ValueError for a camera without points.

    Returns:
        The equations, with the priors of cameras and of board shapes.
    """
    shapes = 0 if problem.deformation is None else len(problem.deformation)
    b, c = len(problem.frames), len(problem.names) + shapes
    H, g = np.zeros((c, c)), np.zeros(c)
    W, B, h = np.zeros((b, c, POSE)), np.zeros((b, POSE, POSE)), np.zeros((b, POSE))
    for name, linear in parts.items():
        columns = linear.columns
        rows = linear.by_shared.reshape(2 * len(linear.r), len(columns))
        H[np.ix_(columns, columns)] += rows.T @ rows
        g[columns] += np.einsum("nip,ni->p", linear.by_shared, linear.r)
        if (prior := problem.priors.get(name)) is not None:
            free, camera_columns = problem.free[name], columns[: len(columns) - shapes]
            information, slope = prior.equations(problem.cameras[name])
            H[np.ix_(camera_columns, camera_columns)] += information[np.ix_(free, free)]
            g[camera_columns] += slope[free]
        B += block_sums(linear.block, linear.by_board.swapaxes(1, 2) @ linear.by_board, b)
        h += block_sums(linear.block, np.einsum("nid,ni->nd", linear.by_board, linear.r), b)
        W[:, columns] += block_sums(linear.block, linear.by_shared.swapaxes(1, 2) @ linear.by_board, b)
    if problem.deformation is not None:
        H[range(c - shapes, c), range(c - shapes, c)] += problem.deformation.information
        g[c - shapes :] -= problem.deformation.information * problem.deformation.values.ravel()
    return NormalEquations(H, W, B, g, h, shapes)


def block_sums(
    block: Int[np.ndarray, " n"], values: Float[np.ndarray, " n *k"], count: int
) -> Float[np.ndarray, " b *k"]:
    """Sum values that belong to the same block.

    Args:
        block: block of each value, 0 to `count` - 1.
        values: values (n, *k), n at least 1.
        count: number of blocks.

    Returns:
        Sums (count, *k); 0 for a block without values.

    Raises:
        ValueError: for no values, and a block out of range.
    """
    marks = csr_array((np.ones(len(block)), (block, np.arange(len(block)))), (count, len(block)))
    return np.asarray(marks @ values.reshape(len(values), -1)).reshape(count, *values.shape[1:])


def robust_weights(lengths: Array) -> Array:
    """Compute the robust weights, 0..1, of residual lengths in standard deviations."""
    return np.minimum(1.0, (ROBUST / np.maximum(lengths, ROBUST)) ** 2)


# Cameras' parameters ----------------------------------------------------------------------------------------


def parameter_sizes(camera: Camera) -> dict[str, int]:
    """Return the length of each of a camera's parameter vectors, by name: ".rotation" and so on."""
    lens = {} if camera.distortion is None else {".distortion": camera.distortion.coefficients.shape[-1]}
    return {".rotation": 3, ".translation": 3, ".focal": 2, ".centre": 2} | lens


def parameter_names(camera: Camera) -> list[str]:
    """List a camera's parameters in the order of `Rig.parameters`: "rotation.0", ..., "distortion.4"."""
    return [
        f"{key.removeprefix('.')}.{i}" for key, size in parameter_sizes(camera).items() for i in range(size)
    ]


def intrinsic_values(camera: Camera) -> Float[np.ndarray, " p"]:
    """Return a camera's parameter values in the order of `parameter_names`; 0 for the pose's."""
    lens = () if camera.distortion is None else camera.distortion.coefficients.tolist()
    K = camera.K.detach()[:2]
    focal = K[:, :2].abs().amax(0)  # beside the diagonal if the image is rotated
    return np.array([*(0.0,) * 6, *focal.tolist(), *K[:, 2].tolist(), *lens])


def changed(camera: Camera, change: torch.Tensor) -> Camera:
    """Change a camera's parameters.

    Args:
        change: changes of all parameters, float64, in the order of `parameter_names`; the rotation is a
            vector in radians about the camera's axes, the others are added.

    Returns:
        The camera; lens coefficients stay within their model's bounds, such as 0 for unified's xi.
    """
    sizes = parameter_sizes(camera)
    moved = Rig({"": camera}).perturbed(dict(zip(sizes, change.split(list(sizes.values())))))[""]
    assert isinstance(moved, Camera)
    lens = moved.distortion
    if lens is None or lens.model not in MODELS:
        return moved
    bounded = within_bounds(MODELS[lens.model], lens.coefficients)
    return moved.replace(distortion=lens.with_coefficients(bounded))


def camera_jacobian(camera: Camera, X: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2 p"]:
    """Compute the derivatives (n, 2, p) of world points' pixels by a camera's `parameter_names`."""
    return linear_projection(camera, X)[1]


def linear_projection(
    camera: Camera, X: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 p"]]:
    """Project world points, and differentiate by the camera's parameters.

    Returns:
        Pixels (n, 2), and derivatives (n, 2, p) in the order of `parameter_names`. Validity is not checked:
        points behind the camera get numbers that mean nothing.
    """
    local = camera.cam_from_world.apply(torch.from_numpy(X)).detach()
    plane, *slopes = lens_derivatives(camera.distortion, local)
    by_point, by_lens = (camera.K[:2, :2] @ slope for slope in slopes)
    rotational = torch.linalg.cross((local - camera.t)[:, None].expand_as(by_point), by_point)
    by_focal = focal_positions(camera.K) * plane[:, None]
    by_centre = torch.eye(2).to(plane).expand(len(X), 2, 2)
    x = map_homogeneous(camera.K[:2], plane)
    return x.numpy(), torch.cat([rotational, by_point, by_focal, by_centre, by_lens], -1).numpy()


def with_default(camera: Camera, entry: str) -> tuple[Camera, str]:
    """Reset one intrinsic parameter: a principal point to the centre, a lens term to no effect.

    Args:
        entry: "centre.0" (x), "centre.1" (y), or a term such as "distortion.2" of the camera's lens; no
            others.

    Returns:
        The camera, and a sentence on what was done.
    """
    kind, index = entry.split(".")[0], int(entry.split(".")[1])
    if kind == "centre":
        K = camera.K.clone()
        K[index, 2] = (camera.hw[1 - index] - 1) / 2
        return camera.replace(K=K), f"the principal point's {'xy'[index]} is fixed at the image's centre"
    lens = camera.distortion
    assert lens is not None
    coefficients = lens.coefficients.clone()
    coefficients[index] = pinhole_coefficients(lens)[index]
    words = f"the lens's {term(lens, index)} is fixed at {float(coefficients[index]):g}"
    return camera.replace(distortion=lens.with_coefficients(coefficients)), words


# Priors -----------------------------------------------------------------------------------------------------


class CameraPrior(NamedTuple):
    """Normal prior of a camera's parameters.

    Attributes:
        mean: mean in the order of `parameter_names`; 0 for the pose.
        information: inverse covariance, 0 where nothing is known; the pose's part is for a rotation vector
            about the camera's axes and the optical centre in the world (not the translation), metres.
        pose: mean of the pose; None for no prior of it.
    """

    mean: Float[np.ndarray, " p"]
    information: Float[np.ndarray, "p p"]
    pose: Pose | None = None

    def equations(self, camera: Camera) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
        """Return the prior's part of the equations: inverse covariance (p, p) and negative gradient (p)."""
        derivatives = np.eye(len(self.mean))
        if self.pose is not None:
            derivatives[3:6, :6] = camera.cam_from_world.centre_jacobian.numpy()
        weighted = derivatives.T @ self.information
        return weighted @ derivatives, weighted @ self.residual(camera)

    def loss(self, camera: Camera) -> float:
        """Return half the squared Mahalanobis distance of a camera from the mean."""
        offset = self.residual(camera)
        return float(offset @ self.information @ offset) / 2

    def residual(self, camera: Camera) -> Float[np.ndarray, " p"]:
        """Return the mean minus the camera's values, in the prior's parameters."""
        offset = self.mean - intrinsic_values(camera)
        if self.pose is not None:
            offset[:3] = rotation_vector(self.pose.R @ camera.R.T).numpy()
            offset[3:6] = (self.pose.inverse().t - camera.centre).numpy()
        return offset


def typical_sizes(camera: Camera) -> Float[np.ndarray, " p"]:
    """Return typical errors of a camera's parameters before any measurement.

    Returns:
        Errors in the order of `parameter_names`: radians, metres, pixels, and the lens's own units.
    """
    lens = camera.distortion
    coefficients = () if lens is None else typical_coefficients(lens)
    scaled = lens is not None and term(lens, 0) == "xi"  # in the middle, by 1 / (1 + xi)
    focal = (coefficients[0] if scaled else TYPICAL_FOCAL_ERROR) * _mean_focal(camera)
    return np.array(
        [3.0] * 3 + [100.0] * 3 + [focal] * 2 + [TYPICAL_CENTRE_ERROR * camera.hw[1]] * 2 + [*coefficients]
    )


def typical_prior(camera: Camera) -> CameraPrior:
    """Make the prior of an ordinary camera: square pixels, principal point near the centre, moderate
    distortion.

    It is negligible where boards were observed at many positions and tilts; elsewhere it keeps a camera
    plausible.

    Returns:
        The prior, without a pose; of the focal lengths only their equality is known.
    """
    h, w = camera.hw
    deviation = typical_sizes(camera)
    deviation[8:10] = CENTRE_DEVIATION * w
    mean = np.zeros(len(deviation))
    mean[8:10] = (w - 1) / 2, (h - 1) / 2
    mean[10:] = (
        () if camera.distortion is None else np.array(pinhole_coefficients(camera.distortion).tolist())
    )
    information = np.diag(deviation**-2.0)
    information[:8, :8] = 0.0
    information[6:8, 6:8] = np.array([[1, -1], [-1, 1]]) / (ASPECT_DEVIATION * _mean_focal(camera)) ** 2
    return CameraPrior(mean, information)


def _mean_focal(camera: Camera) -> float:
    return camera.K[:2, :2].det().abs().sqrt().item()
