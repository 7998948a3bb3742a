"""Whether a rig has moved: two calibrations of the same cameras compared by their pixels and depths.

Gauge: the whole rig may have been set up elsewhere, so the projections compared are those after the one rigid
motion of space that brings all cameras' pixels together best, in least squares, over a grid of pixels at
several depths. A pose and a lens can stand for one another: the difference of all pixels is tested together,
against what the covariances of both calibrations let it be, and no parameter by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.special import chdtrc

from arraygeom import Camera, Pose, Rig, triangulate
from arraygeom.pose import cross_matrix
from arraygeom.runtime.text import length_unit

from .bundle import camera_jacobian
from .uncertainty import RigCovariance, beta_covariance, grid_points, worst_deviation

DEPTHS = 3
"""Depths at which projections are compared, at even steps of inverse depth."""
FARTHEST = 50.0
"""The far bound as a multiple of the near one, at most: farther away pixels hardly change."""
LEVEL = 0.001
"""Probability with which a rig that has not moved is said to have moved."""
LEAST = 1e-3
"""Changes of pixels by less (RMS) count as none: their parameters are not tested, a motion is found."""
STEP = 1e-3
"""Relative change of depth by which a derivative is taken."""
ITERATIONS = 5
"""Steps of the motion at most."""


class Difference(NamedTuple):
    """Pixels x, depths there (metres), how much differs, and its standard deviation by both calibrations.

    Of one camera, at pixels of the first rig: how far the second rig's are from them, (n, 2), and the
    deviation in the worst direction, pixels. Of a pair, at pixels of its alpha: depth by the second rig over
    that by the first, minus 1, (n). Deviations are NaN if unknown.
    """

    x: Float[np.ndarray, "n 2"]
    depth: Float[np.ndarray, " n"]
    change: Float[np.ndarray, " n *k"]
    sigma: Float[np.ndarray, " n"]


class Significance(NamedTuple):
    """Chi-square of the difference with so many degrees of freedom, and the probability of more by chance.

    camera: that whose own motion explains most of it. degrees and metres: that motion. share: of chi-square.
    """

    chi_square: float
    freedom: int
    probability: float
    camera: str
    degrees: float
    metres: float
    share: float

    @property
    def moved(self) -> bool:
        """Whether the rigs differ by more than their calibrations' errors."""
        return self.probability < LEVEL


@dataclass(frozen=True)
class RigDifference:
    """Two rigs compared. motion: from the first one's world to the second one's. alpha: that of the depths.

    depths: by the other cameras that see points of alpha. significance: None without covariances.
    """

    cameras: Mapping[str, Difference]
    depths: Mapping[str, Difference]
    alpha: str
    motion: Pose
    significance: Significance | None
    unit: str = "m"
    """Of depths; of rigs of unknown scale, "baselines"."""

    def as_text(self) -> str:
        """A line for each camera and each pair, and the verdict."""
        lines = ["after the rigid motion of the whole rig that brings all pixels together best:"]
        for name, difference in self.cameras.items():
            off = np.linalg.norm(difference.change, axis=1)
            lines.append(f"{name}: pixels differ by {_sizes(off, difference.sigma)}")
        for name, difference in self.depths.items():
            near, far = difference.depth.min(), difference.depth.max()
            sizes = _sizes(100 * difference.change, 100 * difference.sigma, " %")
            lines.append(
                f"depth by {self.alpha} and {name}, {near:.3g} to {far:.3g} {self.unit}: differs by {sizes}"
            )
        return "\n".join([*lines, self.verdict])

    @property
    def verdict(self) -> str:
        """One line: whether the rig has moved."""
        motion = self.significance
        if motion is None:
            return "verdict: none: no deviations are known; one rig calibrated twice may differ so"
        test = (
            f"chi-square {motion.chi_square:.1f} of {motion.freedom} parameters, p = {motion.probability:.2g}"
        )
        if not motion.moved:
            return f"verdict: the same: the rigs differ no more than their calibrations' errors ({test})"
        return (
            f"verdict: moved: the rigs differ by more than their calibrations' errors ({test}); "
            f"a rotation of {motion.camera} by {motion.degrees:.3f} degrees and a shift of "
            f"{1e3 * motion.metres:.2f} mm explain {motion.share:.0%} of it"
        )


def rig_difference(
    a: Rig,
    b: Rig,
    *,
    covariances: tuple[RigCovariance | None, RigCovariance | None] = (None, None),
    depth: tuple[float, float],
) -> RigDifference:
    """Compare two calibrations of the same cameras over their images and a range of depths (metres, along the
    axis of each camera). Where one covariance is None, the other one's serves for both.

    Raises ValueError for rigs of other cameras, and for cameras that are not calibrated.
    """
    names = _same_cameras(a, b)
    a, b = (rig.replace(cameras={name: rig[name].to(torch.float64) for name in names}) for rig in (a, b))
    grids = {name: _points(a[name], b[name], depth) for name in names}
    motion = _best_motion(a, b, grids)
    parts = [_projections(a, b, motion, name, X) for name, (_, X, _) in grids.items()]
    change = np.concatenate([projected.change.ravel() for projected in parts])
    by_motion, _ = np.linalg.qr(np.concatenate([projected.by_motion for projected in parts]))
    by_rig = [c if c is not None else other for c, other in zip(covariances, covariances[::-1])]
    spread = None
    if by_rig[0] is not None and by_rig[1] is not None:
        roots, blocks = [_root(by_rig[0]), _root(by_rig[1])], []
        for projected in parts:
            by_a = -projected.jacobians[0] @ by_rig[0].of(projected.name, a[projected.name]) @ roots[0]
            by_b = projected.jacobians[1] @ by_rig[1].of(projected.name, b[projected.name]) @ roots[1]
            blocks.append(np.concatenate([by_a, by_b], -1))
        spread = np.concatenate(blocks).reshape(len(change), -1)
        spread -= by_motion @ (by_motion.T @ spread)
    significance = None if spread is None else _tested(change, spread, by_motion, b, parts)
    cameras = {}
    for (name, (x, _, z)), projected, rows in zip(grids.items(), parts, _rows(parts)):
        sigma = np.full(len(x), np.nan)
        if spread is not None:
            mine = spread[rows].reshape(len(x), 2, -1)
            sigma = worst_deviation(mine @ mine.swapaxes(-1, -2))
        cameras[name] = Difference(x, z, projected.change, sigma)
    alpha, *betas = names
    depths = {name: _depths(a, b, alpha, name, grids[alpha], by_rig) for name in betas}
    depths = {name: points for name, points in depths.items() if len(points.x)}
    return RigDifference(cameras, depths, alpha, motion, significance, length_unit(a))


def _same_cameras(a: Rig, b: Rig) -> tuple[str, ...]:
    """Their names. Raises ValueError unless both rigs are of the same calibrated cameras, sizes and unit."""
    if set(a.names) != set(b.names):
        listed = f"{', '.join(a.names)}; and {', '.join(b.names)}"
        raise ValueError(f"the rigs are of other cameras ({listed}): give two calibrations of the same")
    if (one := length_unit(a)) != (other := length_unit(b)):
        raise ValueError(
            f"lengths of one rig are in {one}, of the other in {other}, as if found from images: "
            'bring them to one unit, as by `rig.scaled(0.12).replace(name="")`, 0.12 m being its baseline'
        )
    for name in a.names:
        if not all(isinstance(rig[name], Camera) for rig in (a, b)):
            raise ValueError(f"'{name}' is not calibrated in both rigs: what it sees cannot be compared")
        if a[name].hw != b[name].hw:
            (h, w), (h2, w2) = a[name].hw, b[name].hw
            raise ValueError(
                f"'{name}' has {w}x{h} pixels in one rig and {w2}x{h2} in the other: "
                "calibrate again with images as they were, or give a rig that is resized alike"
            )
    return a.names


Grid = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Pixels (n, 2), world points (n, 3) and depths (n)."""


def _points(camera: Camera, other: Camera, depth: tuple[float, float]) -> Grid:
    near, far = depth
    parts = []
    for inverse in np.linspace(1 / near, max(1 / far, 1 / (FARTHEST * near)), DEPTHS):
        x, X = grid_points(camera, 1 / inverse)
        local = torch.from_numpy(X) @ camera.R.T + camera.t
        kept = other.project_local(local).valid.numpy()
        parts.append((x[kept], X[kept], np.full(int(kept.sum()), 1 / inverse)))
    return tuple(np.concatenate(arrays) for arrays in zip(*parts))  # type: ignore[return-value]


class _Part(NamedTuple):
    """One camera: differences (n, 2), derivatives by motion (2 n, 6), by both cameras' numbers (n, 2, p)."""

    name: str
    change: np.ndarray
    by_motion: np.ndarray
    jacobians: tuple[np.ndarray, np.ndarray]


def _projections(a: Rig, b: Rig, motion: Pose, name: str, X: np.ndarray) -> _Part:
    """How the pixels of points change from a to b, and by what: the rig's motion, each rig's parameters."""
    one, other, points = a[name], b[name], torch.from_numpy(X)
    moved = other.replace(cam_from_world=other.cam_from_world @ motion)
    J_a, J_b = camera_jacobian(one, X), camera_jacobian(moved, X)
    if _same_lens(one, other):  # the mean of both: the difference is linear in the parameters to third order
        J_a = J_b = (J_a + J_b) / 2
    along = J_b[..., 3:6] @ other.R.numpy()
    by_motion = np.concatenate([-along @ cross_matrix(points @ motion.R.T).numpy(), along], -1)
    # a rotation of the camera in its own world moves its translation in the first rig's
    lever = J_b[..., 3:6] @ cross_matrix(other.R @ motion.t).numpy()
    J_b = np.concatenate([J_b[..., :3] - lever, J_b[..., 3:]], -1)
    change = (moved.project(points).x - one.project(points).x).numpy()
    return _Part(name, change, by_motion.reshape(-1, 6), (J_a, J_b))


def _same_lens(a: Camera, b: Camera) -> bool:
    if a.distortion is None or b.distortion is None:
        return a.distortion is b.distortion
    same = a.distortion.model == b.distortion.model
    return same and a.distortion.coefficients.shape == b.distortion.coefficients.shape


def _best_motion(a: Rig, b: Rig, grids: Mapping[str, Grid]) -> Pose:
    """From the first rig's world to the second's: least squares of all pixels, by Gauss and Newton."""
    first = a.names[0]
    motion = b[first].cam_from_world.inverse() @ a[first].cam_from_world
    for _ in range(ITERATIONS):
        parts = [_projections(a, b, motion, name, X) for name, (_, X, _) in grids.items()]
        change = np.concatenate([projected.change.ravel() for projected in parts])
        by_motion = np.concatenate([projected.by_motion for projected in parts])
        step = np.linalg.lstsq(by_motion, -change, rcond=None)[0]
        motion = motion.perturbed(*(torch.from_numpy(p) for p in np.split(step, 2)))
        if np.abs(by_motion @ step).max() < LEAST:
            break
    return motion


def _root(covariance: RigCovariance) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance.matrix)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))


def _rows(parts: list[_Part]) -> list[slice]:
    """The rows of each camera among the coordinates of all."""
    ends = np.cumsum([0, *(projected.change.size for projected in parts)]).tolist()
    return [slice(start, end) for start, end in pairwise(ends)]


def _tested(
    change: np.ndarray, spread: np.ndarray, by_motion: np.ndarray, b: Rig, parts: list[_Part]
) -> Significance:
    """The difference in directions in which calibrations' errors move pixels, in standard deviations."""
    U, s, _ = np.linalg.svd(spread, full_matrices=False)
    counts = s > LEAST * np.sqrt(len(change) / 2)
    U, s = U[:, counts], s[counts]
    z = U.T @ change / s
    total, freedom = float(z @ z), int(counts.sum())
    best, motion, gain = "", np.zeros(6), -1.0
    for projected, rows in zip(parts, _rows(parts)):
        jacobian = np.zeros((len(change), 6))
        jacobian[rows] = projected.jacobians[1][..., :6].reshape(-1, 6)
        jacobian -= by_motion @ (by_motion.T @ jacobian)
        whitened = U.T @ jacobian / s[:, None]
        solution = np.linalg.lstsq(whitened, z, rcond=None)[0]
        explained = total - float(np.square(z - whitened @ solution).sum())
        if explained > gain:
            best, motion, gain = projected.name, solution, explained
    pose = b[best].cam_from_world
    shift = pose.perturbed(*(torch.from_numpy(p) for p in np.split(motion, 2))).inverse().t - pose.inverse().t
    probability, degrees = float(chdtrc(freedom, total)), float(np.degrees(np.linalg.norm(motion[:3])))
    share = gain / max(total, 1e-300)
    return Significance(total, freedom, probability, best, degrees, float(shift.norm()), share)


def _depths(
    a: Rig, b: Rig, alpha: str, beta: str, grid: Grid, covariances: list[RigCovariance | None]
) -> Difference:
    """Depth of points by the second rig, found from the pixels at which the first one has them."""
    x, X, z = grid
    there = a[beta].project(torch.from_numpy(X))
    kept = (there.valid & a[beta].contains(there.x)).numpy()
    x, z, y = x[kept], z[kept], there.x[torch.from_numpy(kept)]
    triangulated = triangulate([b[alpha], b[beta]], torch.stack([torch.from_numpy(x), y]), residual=np.inf)
    valid = triangulated.valid.numpy()
    change = b[alpha].cam_from_world.apply(triangulated.X)[:, 2].numpy() / z - 1
    farther = a[alpha].unproject(torch.from_numpy(x), torch.from_numpy(z * (1 + STEP)))
    slope = (a[beta].project(farther).x - y).numpy() / STEP  # pixels of beta by relative depth
    along = slope / np.square(slope).sum(1, keepdims=True)
    variance = np.zeros(len(z))
    for d in np.unique(z):
        for covariance in covariances:
            at_depth = z == d
            of_y = (
                np.nan
                if covariance is None
                else beta_covariance(a, covariance, alpha, beta, x[at_depth], float(d))
            )
            variance[at_depth] += np.einsum(
                "ni,nij,nj->n", along[at_depth], of_y * np.ones((1, 2, 2)), along[at_depth]
            )
    return Difference(x[valid], z[valid], change[valid], np.sqrt(variance)[valid])


def _sizes(values: np.ndarray, sigma: np.ndarray, unit: str = "") -> str:
    """How large values are, and their standard deviations, if known."""
    rms, most = np.sqrt(np.square(values).mean()), np.abs(values).max()
    stated, finite = "", sigma[np.isfinite(sigma)]
    if len(finite):
        stated = f" (both calibrations' deviations: {np.sqrt(np.square(finite).mean()):.3f})"
    return f"{rms:.3f}{unit} (RMS), {most:.3f}{unit} at most{stated}"


def draw_difference(difference: RigDifference) -> Figure:
    """How far two rigs' pixels differ, at nearest and farthest depth, and depths by each pair, in percent."""
    maps = [(f"{n}: pixels", c, np.linalg.norm(c.change, axis=1)) for n, c in difference.cameras.items()]
    maps += [
        (f"depth by {difference.alpha} and {n}: %", d, 100 * d.change) for n, d in difference.depths.items()
    ]
    figure = Figure(figsize=(9, 2.7 * len(maps)), layout="constrained")
    for row, (title, points, values) in zip(figure.subplots(len(maps), 2, squeeze=False), maps):
        for axes, depth in zip(row, (points.depth.min(), points.depth.max())):
            x, shown = points.x[points.depth == depth], values[points.depth == depth]
            most = float(np.nanquantile(np.abs(shown), 0.98))
            cmap, least = ("viridis", 0.0) if points.change.ndim > 1 else ("RdBu", -most)
            drawn = axes.scatter(*x.T, c=shown, s=22, marker="s", cmap=cmap, vmin=least, vmax=most)
            figure.colorbar(drawn, ax=axes)
            axes.set_title(f"{title}, {depth:.3g} {difference.unit}".replace("$", r"\$"), fontsize=9)
            axes.set(aspect="equal", xticks=[], yticks=[])
            axes.invert_yaxis()
    return figure
