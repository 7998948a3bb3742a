"""Whether a rig has moved: two calibrations of the same cameras compared by their pixels and depths.

Gauge: the whole rig may have been set up elsewhere, so the projections compared are those after the one rigid
motion of space that brings all cameras' pixels together best, in least squares, over a grid of pixels at
several depths. A pose and a lens can stand for one another: the difference of all pixels is tested together,
against what the covariances of both calibrations let it be, and no parameter by itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.special import chdtrc

from arraygeom import Camera, Pose, Rig, triangulate
from arraygeom.pose import cross_matrix

from .bundle import camera_jacobian
from .uncertainty import RigCovariance, beta_covariance, grid_points, worst_deviation

DEPTHS = 3
"""Depths at which projections are compared, at even steps of inverse depth."""
FARTHEST = 50.0
"""The far bound as a multiple of the near one, at most: farther away pixels hardly change."""
LEVEL = 0.001
"""Probability with which a rig that has not moved is said to have moved."""
LEAST = 1e-3
"""Combinations of parameters that change pixels by less (RMS, pixels) are not tested."""
STEP = 1e-3
"""Relative change of depth by which a derivative is taken."""
ITERATIONS, CONVERGED = 5, 1e-6
"""Steps of the motion at most, and the size of a last one (radians, metres)."""


class CameraDifference(NamedTuple):
    """One camera: pixels x of the first rig, depths there (metres), how far the second rig's are from them,
    and the standard deviation of that by both calibrations (pixels, worst direction; NaN if unknown)."""

    x: Float[np.ndarray, "n 2"]
    depth: Float[np.ndarray, " n"]
    change: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, " n"]


class DepthDifference(NamedTuple):
    """Depth by one pair, at pixels x of its alpha: by the second rig over that by the first, minus 1, and its
    standard deviation by both calibrations (NaN if unknown)."""

    x: Float[np.ndarray, "n 2"]
    depth: Float[np.ndarray, " n"]
    change: Float[np.ndarray, " n"]
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

    significance: None without covariances.
    """

    cameras: Mapping[str, CameraDifference]
    depths: Mapping[str, DepthDifference]
    alpha: str
    motion: Pose
    significance: Significance | None

    def as_text(self) -> str:
        """A line for each camera and each pair, and the verdict."""
        lines = ["after the rigid motion of the whole rig that brings all pixels together best:"]
        for name, found in self.cameras.items():
            off = np.linalg.norm(found.change, axis=1)
            lines.append(
                f"{name}: pixels differ by {_rms(off):.3f} (RMS), {off.max():.3f} at "
                f"most{_of(found.sigma, 3)}"
            )
        for name, depth in self.depths.items():
            near, far = depth.depth.min(), depth.depth.max()
            percent = 100 * depth.change
            lines.append(
                f"depth by {self.alpha} and {name}, {near:.3g} to {far:.3g} m: differs by "
                f"{_rms(percent):.3f} % (RMS), "
                f"{np.abs(percent).max():.3f} % at most{_of(100 * depth.sigma, 3)}"
            )
        return "\n".join([*lines, self.verdict])

    @property
    def verdict(self) -> str:
        """One line: whether the rig has moved."""
        found = self.significance
        if found is None:
            return (
                "verdict: none: no deviations are known; "
                "differences may be those of two calibrations of one rig"
            )
        test = f"chi-square {found.chi_square:.1f} of {found.freedom} parameters, p = {found.probability:.2g}"
        if not found.moved:
            return (
                "verdict: the same: the rigs differ no more than their "
                f"calibrations' errors let them ({test})"
            )
        return (
            f"verdict: moved: the rigs differ by more than their calibrations' errors ({test}); "
            f"a rotation of {found.camera} by {found.degrees:.3f} degrees and a shift of "
            f"{1e3 * found.metres:.2f} mm explain {found.share:.0%} of it"
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
    change = np.concatenate([part.change.ravel() for part in parts])
    by_motion, _ = np.linalg.qr(np.concatenate([part.by_motion for part in parts]))
    known = [c if c is not None else other for c, other in zip(covariances, covariances[::-1])]
    spread = None
    if known[0] is not None and known[1] is not None:
        of_a, of_b = _root(known[0]), _root(known[1])
        rows = [np.concatenate([p.of_a(known[0]) @ of_a, p.of_b(known[1]) @ of_b], -1) for p in parts]
        spread = np.concatenate(rows).reshape(len(change), -1)
        spread -= by_motion @ (by_motion.T @ spread)
    significance = None if spread is None else _tested(change, spread, by_motion, b, parts, names)
    cameras = {}
    end = 0
    for (name, (x, _, z)), part in zip(grids.items(), parts):
        start, end = end, end + part.change.size
        sigma = np.full(len(x), np.nan)
        if spread is not None:
            mine = spread[start:end].reshape(len(x), 2, -1)
            sigma = worst_deviation(mine @ mine.swapaxes(-1, -2))
        cameras[name] = CameraDifference(x, z, part.change, sigma)
    alpha, *betas = names
    depths = {name: _depths(a, b, alpha, name, grids[alpha], known) for name in betas}
    return RigDifference(cameras, depths, alpha, motion, significance)


def _same_cameras(a: Rig, b: Rig) -> tuple[str, ...]:
    if set(a.names) != set(b.names):
        listed = f"{', '.join(a.names)}; and {', '.join(b.names)}"
        raise ValueError(f"the rigs are of other cameras ({listed}): give two calibrations of the same")
    for name in a.names:
        for rig in (a, b):
            if not isinstance(rig[name], Camera):
                raise ValueError(
                    f"'{name}' is not calibrated in both rigs: what it sees where cannot be compared"
                )
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
    return tuple(np.concatenate(part) for part in zip(*parts))  # type: ignore[return-value]


class _Part(NamedTuple):
    """One camera: differences (n, 2), derivatives by motion (2 n, 6), by both cameras' numbers (n, 2, p)."""

    name: str
    cameras: tuple[Camera, Camera]
    change: np.ndarray
    by_motion: np.ndarray
    jacobians: tuple[np.ndarray, np.ndarray]

    def of_a(self, covariance: RigCovariance) -> np.ndarray:
        return -self.jacobians[0] @ covariance.of(self.name, self.cameras[0])

    def of_b(self, covariance: RigCovariance) -> np.ndarray:
        return self.jacobians[1] @ covariance.of(self.name, self.cameras[1])


def _projections(a: Rig, b: Rig, motion: Pose, name: str, X: np.ndarray) -> _Part:
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
    return _Part(name, (one, other), change, by_motion.reshape(-1, 6), (J_a, J_b))


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
        change = np.concatenate([part.change.ravel() for part in parts])
        step = np.linalg.lstsq(np.concatenate([part.by_motion for part in parts]), -change, rcond=None)[0]
        motion = motion.perturbed(*(torch.from_numpy(part) for part in np.split(step, 2)))
        if np.abs(step).max() < CONVERGED:
            break
    return motion


def _root(covariance: RigCovariance) -> np.ndarray:
    values, vectors = np.linalg.eigh(covariance.matrix)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))


def _tested(
    change: np.ndarray,
    spread: np.ndarray,
    by_motion: np.ndarray,
    b: Rig,
    parts: list[_Part],
    names: tuple[str, ...],
) -> Significance:
    """The difference in directions in which calibrations' errors move pixels, in standard deviations."""
    U, s, _ = np.linalg.svd(spread, full_matrices=False)
    counts = s > LEAST * np.sqrt(len(change) / 2)
    U, s = U[:, counts], s[counts]
    z = U.T @ change / s
    total, freedom = float(z @ z), int(counts.sum())
    best, motion, gain, end = names[0], np.zeros(6), -1.0, 0
    for part in parts:
        start, end = end, end + part.change.size
        own = np.zeros((len(change), 6))
        own[start:end] = part.jacobians[1][..., :6].reshape(-1, 6)
        own -= by_motion @ (by_motion.T @ own)
        by_own = U.T @ own / s[:, None]
        found = np.linalg.lstsq(by_own, z, rcond=None)[0]
        explained = total - float(np.square(z - by_own @ found).sum())
        if explained > gain:
            best, motion, gain = part.name, found, explained
    pose = b[best].cam_from_world
    shift = pose.perturbed(*(torch.from_numpy(p) for p in np.split(motion, 2))).inverse().t - pose.inverse().t
    return Significance(
        total,
        freedom,
        float(chdtrc(freedom, total)),
        best,
        float(np.degrees(np.linalg.norm(motion[:3]))),
        float(shift.norm()),
        gain / max(total, 1e-300),
    )


def _depths(
    a: Rig, b: Rig, alpha: str, beta: str, grid: Grid, known: list[RigCovariance | None]
) -> DepthDifference:
    """Depth of points by the second rig, found from the pixels at which the first one has them."""
    x, X, z = grid
    there = a[beta].project(torch.from_numpy(X))
    kept = (there.valid & a[beta].contains(there.x)).numpy()
    x, z, y = x[kept], z[kept], there.x[torch.from_numpy(kept)]
    found = triangulate([b[alpha], b[beta]], torch.stack([torch.from_numpy(x), y]), residual=np.inf)
    valid = found.valid.numpy()
    change = b[alpha].cam_from_world.apply(found.X)[:, 2].numpy() / z - 1
    farther = a[alpha].unproject(torch.from_numpy(x), torch.from_numpy(z * (1 + STEP)))
    slope = (a[beta].project(farther).x - y).numpy() / STEP  # pixels of beta by relative depth
    along = slope / np.square(slope).sum(1, keepdims=True)
    variance = np.zeros(len(z))
    for d in np.unique(z):
        for covariance in known:
            at = z == d
            of_y = (
                np.nan if covariance is None else beta_covariance(a, covariance, alpha, beta, x[at], float(d))
            )
            variance[at] += np.einsum("ni,nij,nj->n", along[at], of_y * np.ones((1, 2, 2)), along[at])
    return DepthDifference(x[valid], z[valid], change[valid], np.sqrt(variance)[valid])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean())) if len(values) else float("nan")


def _of(sigma: np.ndarray, digits: int) -> str:
    return (
        ""
        if np.isnan(sigma).all()
        else f" (both calibrations' deviations: {_rms(sigma[np.isfinite(sigma)]):.{digits}f})"
    )


def draw_difference(found: RigDifference) -> Figure:
    """How far two rigs' pixels differ, at nearest and farthest depth, and depths by each pair, in percent."""
    panels = []
    for name, camera in found.cameras.items():
        for depth in (camera.depth.min(), camera.depth.max()):
            at = camera.depth == depth
            panels.append(
                (f"{name}, {depth:.3g} m: pixels", camera.x[at], np.linalg.norm(camera.change[at], axis=1))
            )
    for name, by_pair in found.depths.items():
        for depth in (by_pair.depth.min(), by_pair.depth.max()):
            at = by_pair.depth == depth
            title = f"depth by {found.alpha} and {name}, {depth:.3g} m: %"
            panels.append((title, by_pair.x[at], 100 * by_pair.change[at]))
    figure = Figure(figsize=(9, 2.7 * len(panels) / 2), layout="constrained")
    for i, (title, x, values) in enumerate(panels, 1):
        axes: Any = figure.add_subplot(len(panels) // 2, 2, i)
        signed = "%" in title
        most = float(np.nanquantile(np.abs(values), 0.98)) if len(values) else 1.0
        shown = axes.scatter(
            *x.T,
            c=values,
            s=22,
            marker="s",
            cmap="RdBu" if signed else "viridis",
            vmin=-most if signed else 0,
            vmax=most,
        )
        figure.colorbar(shown, ax=axes)
        axes.set_title(title.replace("$", r"\$"), fontsize=9)
        axes.set(aspect="equal", xticks=[], yticks=[])
        axes.invert_yaxis()
    return figure
