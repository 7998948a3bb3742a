"""Comparison of two calibrations of the same cameras, by pixels and depths: has the rig moved?

Gauge: the whole rig may have been set up elsewhere, so projections are compared after the one rigid motion of
space that aligns all cameras' pixels best, in least squares, over a grid of pixels at several depths. A pose
and a lens can stand for one another: the difference of all pixels is tested together against the covariances
of both calibrations, and no parameter by itself.
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
from arraygeom.pair import depth_range
from arraygeom.pose import cross_matrix
from arraygeom.runtime.text import length_unit

from .bundle import camera_jacobian, parameter_names
from .uncertainty import RigCovariance, beta_covariance, grid_points, worst_deviation

DEPTHS = 3
"""Number of depths at which projections are compared, in even steps of inverse depth."""
FARTHEST = 50.0
"""Largest ratio of far to near bound: farther away pixels hardly change."""
LEVEL = 0.001
"""Probability of a false alarm for a rig that has not moved."""
LEAST = 1e-3
"""Change of pixels (RMS) that counts as none: such parameters are not tested, and the motion has
converged."""
STEP = 1e-3
"""Relative change of depth for a numerical derivative."""
ITERATIONS = 5
"""Largest number of steps for the motion."""


class Difference(NamedTuple):
    """Difference of one camera's pixels, or of one pair's depths.

    Attributes:
        x: pixels of the first rig's camera, or of the pair's alpha.
        depth: their depths, metres or the rigs' own unit.
        change: of a camera, offset of the second rig's pixels (n, 2); of a pair, depth by the second rig over
            depth by the first, minus 1 (n).
        sigma: standard deviation of the change (in the worst direction) by both calibrations, in the change's
            unit; NaN without covariances.
    """

    x: Float[np.ndarray, "n 2"]
    depth: Float[np.ndarray, " n"]
    change: Float[np.ndarray, " n *k"]
    sigma: Float[np.ndarray, " n"]


class Significance(NamedTuple):
    """Test of two rigs' difference against their calibrations' covariances.

    Attributes:
        chi_square: chi-square of the difference.
        freedom: degrees of freedom of chi-square.
        probability: probability of a larger chi-square by chance; NaN without degrees of freedom.
        camera: camera whose motion explains most of the difference.
        degrees: rotation of that camera, degrees.
        metres: shift of that camera's centre, metres or the rigs' own unit.
        share: share of chi-square that this motion explains, 0..1.
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
        """True if the rigs differ by more than their calibrations' errors."""
        return self.probability < LEVEL


@dataclass(frozen=True)
class RigDifference:
    """Comparison of two rigs.

    Attributes:
        cameras: difference of pixels by camera.
        depths: relative difference of depths by alpha and another camera, by that camera's name; cameras that
            see none of alpha's points are missing.
        alpha: camera of the depths, the first of the first rig.
        motion: rigid motion from the first rig's world to the second's that is taken out before comparing
            pixels.
        significance: result of the test; None without covariances.
        unit: unit of `Difference.depth` and of lengths: "m", or "baselines" for rigs of unknown scale.
    """

    cameras: Mapping[str, Difference]
    depths: Mapping[str, Difference]
    alpha: str
    motion: Pose
    significance: Significance | None
    unit: str = "m"

    def as_text(self) -> str:
        """Format a heading, a line for each camera (pixels) and pair (depths, percent), and the verdict.

        Each line has RMS, maximum and, where known, standard deviation of the differences.
        """
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
        """Verdict in one line: moved, the same, or none without covariances, or for ones of 0."""
        motion = self.significance
        if motion is None or not motion.freedom:
            return "verdict: none: no deviations are known; one rig calibrated twice may differ so"
        test = (
            f"chi-square {motion.chi_square:.1f} of {motion.freedom} parameters, p = {motion.probability:.2g}"
        )
        if not motion.moved:
            return f"verdict: the same: the rigs differ no more than their calibrations' errors ({test})"
        shift = f"{1e3 * motion.metres:.2f} mm" if self.unit == "m" else f"{motion.metres:.3g} {self.unit}"
        return (
            f"verdict: moved: the rigs differ by more than their calibrations' errors ({test}); "
            f"a rotation of {motion.camera} by {motion.degrees:.3f} degrees and a shift of "
            f"{shift} explain {motion.share:.0%} of it"
        )


def rig_difference(
    a: Rig,
    b: Rig,
    *,
    covariances: tuple[RigCovariance | None, RigCovariance | None] = (None, None),
    depth: tuple[float, float],
) -> RigDifference:
    """Compare two calibrations of the same cameras over their images and a range of depths.

    Args:
        a: first rig.
        b: second rig.
        covariances: covariances of both; where one is None the other serves for both, without any nothing is
            tested.
        depth: (near, far) along each camera's axis, metres, or the rigs' own unit. Far counts as `FARTHEST`
            times near at most, infinity too.

    Returns:
        Differences of pixels and depths, and the test's result.

    Raises:
        ValueError: for rigs of other cameras, sizes or units, cameras that are not calibrated, a covariance
            of parameters that the first rig has not, and depths unless 0 < near <= far.
    """
    depth_range(*depth)
    names = _same_cameras(a, b)
    a, b = (rig.replace(cameras={name: rig[name].to(torch.float64) for name in names}) for rig in (a, b))
    grids = {name: _points(a[name], b[name], depth) for name in names}
    motion = _best_motion(a, b, grids)
    parts = [_projections(a, b, motion, name, X) for name, (_, X, _) in grids.items()]
    change = np.concatenate([projected.change.ravel() for projected in parts])
    by_motion, _ = np.linalg.qr(np.concatenate([projected.by_motion for projected in parts]))
    by_rig = [c if c is not None else other for c, other in zip(covariances, covariances[::-1])]
    own = {f"{name}.{entry}" for name in names for entry in parameter_names(a[name])}
    if unknown := {name for c in by_rig if c is not None for name in c.names} - own:
        raise ValueError(f"the rig has no parameter {min(unknown)}: give the covariance of this rig")
    spread = None
    if by_rig[0] is not None and by_rig[1] is not None:
        roots, blocks = [_root(by_rig[0]), _root(by_rig[1])], []
        for projected in parts:
            by_a = -projected.jacobians[0] @ by_rig[0].selection(projected.name, a[projected.name]) @ roots[0]
            by_b = projected.jacobians[1] @ by_rig[1].selection(projected.name, b[projected.name]) @ roots[1]
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
    """Names of the cameras; ValueError unless both rigs have the same ones, calibrated, sizes and unit."""
    if set(a.names) != set(b.names):
        listed = f"{', '.join(a.names)}; and {', '.join(b.names)}"
        raise ValueError(f"the rigs are of other cameras ({listed}): give two calibrations of the same")
    if (unit_a := length_unit(a)) != (unit_b := length_unit(b)):
        raise ValueError(
            f"lengths of one rig are in {unit_a}, of the other in {unit_b}, as if found from images: "
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
        seen = other.project_local(local).valid.numpy()
        parts.append((x[seen], X[seen], np.full(int(seen.sum()), 1 / inverse)))
    return tuple(np.concatenate(arrays) for arrays in zip(*parts))  # type: ignore[return-value]


class _Part(NamedTuple):
    """One camera's differences (n, 2), derivatives by motion (2 n, 6) and both rigs' camera (n, 2, p)."""

    name: str
    change: np.ndarray
    by_motion: np.ndarray
    jacobians: tuple[np.ndarray, np.ndarray]


def _projections(a: Rig, b: Rig, motion: Pose, name: str, X: np.ndarray) -> _Part:
    """Changes of points' pixels from a to b, with derivatives by the rig's motion and each rig's camera."""
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
    """Motion from the first rig's world to the second's: Gauss-Newton least squares of all pixels."""
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
    """Rows of each camera among the coordinates of all."""
    ends = np.cumsum([0, *(projected.change.size for projected in parts)]).tolist()
    return [slice(start, end) for start, end in pairwise(ends)]


def _tested(
    change: np.ndarray, spread: np.ndarray, by_motion: np.ndarray, b: Rig, parts: list[_Part]
) -> Significance:
    """Test the difference in the directions that calibration errors move pixels in."""
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
    """Depths of points by the second rig, triangulated from the first rig's pixels."""
    x, X, z = grid
    projected = a[beta].project(torch.from_numpy(X))
    seen = (projected.valid & a[beta].contains(projected.x)).numpy()
    x, z, y = x[seen], z[seen], projected.x[torch.from_numpy(seen)]
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
    """Format RMS and maximum of values, and their standard deviation if known."""
    rms, most = np.sqrt(np.square(values).mean()), np.abs(values).max()
    deviations, finite = "", sigma[np.isfinite(sigma)]
    if len(finite):
        deviations = f" (both calibrations' deviations: {np.sqrt(np.square(finite).mean()):.3f})"
    return f"{rms:.3f}{unit} (RMS), {most:.3f}{unit} at most{deviations}"


def draw_difference(difference: RigDifference) -> Figure:
    """Draw differences of pixels by camera and of depths by pair, at each one's nearest and farthest depth.

    Returns:
        The figure, a row for each camera and pair: lengths of offsets in pixels, depths in percent.
    """
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
