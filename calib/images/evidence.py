"""Support of matched points for a hypothesis, by their distances and depths, and beyond that of mere drift.

Against drift the residuals are normal with the noise of the points, plus a drift of the cameras whose prior
deviations are those of `parameters.SIGMA` times a scale, plus what lens models leave (`systematic_modes`); to
first order in the drift. A mistake that a drift explains as well is not named.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from scipy.spatial import Delaunay, QhullError
from torch import Tensor

from arraygeom import LensView, Pair, Rig
from arraygeom.robust import cauchy, least_squares, robust_least_squares

from .hypotheses import Hypothesis
from .least_squares import Evaluated, Residuals, jacobian
from .matches import Pairs, PointMatches, cameras_of
from .parameters import SIGMA, UNCERTAIN, apply_change, free_parameters
from .refinement import systematic_columns
from .residuals import (
    FEW,
    lines_basis,
    match_depths,
    residuals_and_depths,
    sampson_of_pairs,
    share,
    stack_key,
    stacked,
    trimmed_square,
)

LARGEST_DISTANCE = 1000.0
"""Upper bound of a match's distance from its line, pixels; also for pixels without a ray."""
OF_TRIMMED = 0.52
"""`trimmed_square` of normal points of variance 1."""
LEAST_NOISE = 0.05
"""Lower bound of the points' noise, pixels."""
WRONG_SIDE_PENALTY = 100.0
"""Penalty, pixels, of points behind the cameras, outside the depth range, or mirrored."""
SCALES = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
"""Drifts tried, in units of the prior deviations."""
RARE = 6.0
"""Factor of log(1 + s^2) in -2 log probability of a drift of scale s: larger drifts are rarer."""
STEPS = 12
"""Most steps of Gauss and Newton to the most probable drift; the best counts, as the first may overshoot."""
NO_BETTER = 0.1
"""Change of the evidence below which these steps end."""
CLIPPED = 30.0
"""Largest residual that counts, pixels."""


class FitStatistics(NamedTuple):
    """Statistics of matched points under a rig, all pairs together; "few" is fewer than `FEW`.

    Attributes:
        off: median distance of an inlier from its epipolar line, pixels of beta.
        misfit: trimmed root mean square of these distances, pixels, beyond that of the matches' noise.
        front: share of the points in front of both cameras, of those whose depth is observable; NaN for few.
        inside: share of those in front whose depth is from half the rig's nearest to twice its farthest; NaN
            without a depth range or for few points.
        handed: share of the triangles of neighbouring points whose orientation in both images (equal, or
            opposite if one is mirrored) is as the rig implies. The mean of the pairs; points without
            triangles count as unmirrored.
        depth: median depth, in the rig's unit, of those in front; NaN for few.
    """

    off: float
    misfit: float
    front: float
    inside: float
    handed: float
    depth: float

    @property
    def penalised_misfit(self) -> float:
        """Misfit in pixels plus `WRONG_SIDE_PENALTY` for each of front, inside and handed that is below a
        half."""
        wrong = (self.front < 0.5) + (self.inside < 0.5) + (self.handed < 0.5)
        return self.misfit + WRONG_SIDE_PENALTY * wrong

    def as_text(self, unit: str = "m") -> str:
        """Return the statistics in words, without those that are NaN, and `handed` only below a half.

        Args:
            unit: unit of the rig's lengths, for depth.
        """
        parts = [f"{self.off:.2f} px from the lines, {self.misfit:.2f} px of it due to the rig"]
        if not math.isnan(self.front):
            parts.append(f"{self.front:.0%} in front")
        if not math.isnan(self.inside):
            parts.append(f"{self.inside:.0%} within twice the depth range")
        if not math.isnan(self.depth):
            parts.append(f"median depth {self.depth:.3g} {unit}")
        if self.handed < 0.5:
            parts.append("one image mirrored relative to the other")
        return ", ".join(parts)


def fit_statistics(
    tried: Sequence[Hypothesis], pairs: Pairs
) -> tuple[dict[Hypothesis, FitStatistics], Bool[Tensor, " n"], float]:
    """Compute the statistics of every hypothesis: distances by the inliers, shares and depth by all points.

    Inliers, the same for all, are points near the lines of an F that is fitted anew to each pair, under the
    lenses of the hypothesis of kind "nothing" or "distortion" that fits best then.

    Returns:
        Statistics by hypothesis; a mask of the inliers among all points of all pairs; and the standard
        deviation of their distances from the lines of that F, pixels, at least `LEAST_NOISE`.

    Raises:
        ValueError: if `tried` has no "nothing" or "distortion", and as `observations`.
        torch.linalg.LinAlgError: for a link of H alone.
    """
    observed = observations([hypothesis.rig for hypothesis in tried], pairs)
    inliers, floor = _inliers(tried, observed.off, pairs)
    preserved = [_handedness(matches) for matches in pairs.values()]
    statistics = {}
    for hypothesis, off, depth, front in zip(tried, *observed):
        rig, observable = hypothesis.rig, ~depth.isnan()
        ahead = depth[observable & front]
        inside = math.nan
        if rig.depth is not None:
            near, far = (float(bound) for bound in rig.depth)
            inside = share((ahead > 0.5 * near) & (ahead < 2 * far))
        statistics[hypothesis] = FitStatistics(
            off=float(off[inliers].abs().median()),
            misfit=math.sqrt(max(trimmed_square(off[inliers]) - floor, 0.0)),
            front=share(front[observable]),
            inside=inside,
            handed=fmean(abs(kept - _mirrors(rig, names)) for kept, names in zip(preserved, pairs)),
            depth=float(ahead.median()) if len(ahead) >= FEW else math.nan,
        )
    return statistics, inliers, max(math.sqrt(floor / OF_TRIMMED), LEAST_NOISE)


class PointObservations(NamedTuple):
    """All points of all pairs (n) under several rigs (k), float64.

    Attributes:
        off: signed distance from the epipolar line, pixels of beta, within +-`LARGEST_DISTANCE`, which is
            also that of pixels without a ray.
        depth: depth in alpha, in the rig's unit, negative behind it; NaN where unobservable.
        front: mask of the points in front of both cameras.
    """

    off: Float[Tensor, "k n"]
    depth: Float[Tensor, "k n"]
    front: Bool[Tensor, "k n"]


def observations(rigs: Sequence[Rig], pairs: Pairs) -> PointObservations:
    """Observe all points of all pairs under each rig, batched by lens model.

    Args:
        rigs: rigs with the same cameras, one at least.
        pairs: matched points by pair of cameras, one pair at least.

    Returns:
        Distances, depths and masks, detached: one row a rig, the pairs' points one after the other.

    Raises:
        ValueError: for a camera that a rig lacks, and pairs with neither cameras nor F.
    """
    parts = [_observations([rig.pair(*names) for rig in rigs], matches) for names, matches in pairs.items()]
    return PointObservations(*(torch.cat(tensors, 1) for tensors in zip(*parts)))


def _observations(pairs: Sequence[Pair], matches: PointMatches) -> PointObservations:
    """Observe one pair's matches under each of several hypothetical pairs."""
    off, depth = torch.zeros(2, len(pairs), len(matches.alpha), dtype=torch.float64)
    front = torch.zeros(off.shape, dtype=torch.bool)
    groups: dict[object, list[int]] = {}
    for i, pair in enumerate(pairs):
        groups.setdefault(stack_key(pair), []).append(i)
    for group in groups.values():
        pair = stacked([pairs[i] for i in group])
        (_, line, valid), depths = residuals_and_depths(pair, matches)
        line = torch.where(valid, line.detach(), LARGEST_DISTANCE)
        off[group] = line.nan_to_num(LARGEST_DISTANCE).clamp(-LARGEST_DISTANCE, LARGEST_DISTANCE)
        depth[group] = torch.where(depths.observable, depths.depth, torch.nan)
        front[group] = depths.front
    return PointObservations(off, depth, front)


def _inliers(tried: Sequence[Hypothesis], off: Tensor, pairs: Pairs) -> tuple[Tensor, float]:
    """Select the points consistent with some pose of the cameras, by an F fitted robustly to each pair.

    Of the cameras only their lenses matter. Returns a mask, and their mean square distance, square pixels.
    """
    lengths = [len(matches.alpha) for matches in pairs.values()]
    fits = []
    for hypothesis, distances in zip(tried, off):
        if hypothesis.kind in ("nothing", "distortion"):
            parts = zip(pairs.items(), distances.split(lengths))
            fits.append(torch.cat([_beyond_pose(hypothesis.rig.pair(*n), m, r) for (n, m), r in parts]))
    left_over = min(fits, key=lambda e: float(e.abs().median()))
    inliers = left_over.abs() <= max(4 * float(left_over.abs().median()), 0.2)
    return inliers, trimmed_square(left_over[inliers])


def _beyond_pose(pair: Pair, matches: PointMatches, off: Tensor) -> Tensor:
    """Return the residual of the distances after a robust first-order fit of F."""
    terms = lines_basis(pair, matches).T

    def weigh(rest: Tensor) -> Tensor:
        return cauchy(rest, 2 * max(float(rest.abs().median()), 1e-3)).square()

    start = least_squares(terms, off, torch.ones_like(off))
    return robust_least_squares(terms, off, start, weigh, steps=7).rest


def _handedness(matches: PointMatches) -> float:
    """Return the share of Delaunay triangles of alpha's points that keep their orientation; 1 without any."""
    try:
        corners = torch.from_numpy(Delaunay(matches.alpha.numpy()).simplices).long()
    except QhullError:
        return 1.0
    areas = [(points[corners[:, 1:]] - points[corners[:, :1]]).det() for points in matches]
    return float((areas[0] * areas[1] > 0).double().mean())


def _mirrors(rig: Rig, names: tuple[str, str]) -> bool:
    """Return True if exactly one of two cameras is that of a mirrored image."""
    views = [rig[name] for name in names]
    return sum(isinstance(v, LensView) and bool(v.K[:2, :2].det() < 0) for v in views) == 1


@dataclass(frozen=True)
class DriftEvidence:
    """The drift of a rig that fits matched points best, with its evidence.

    Attributes:
        cost: -2 log evidence of the rig and that drift by the points used; smaller is better, and only
            differences count; infinite where the drift leaves points without distances.
        distances: function from a drift to all points' distances, one tensor a pair, in standard deviations
            of their noise.
        z: the drift (k), in prior deviations.
        r: distances (n) without drift, by the linear model about z, in the same unit, as are J and B.
        J: derivatives (n, k) of the distances by the drift.
        B: derivatives (n, s) of the distances by what lens models leave.
        scale: scale of the drift's prior deviations.
        fixed: part of the cost that does not depend on the distances.
        clipped: largest distance that counts.
    """

    cost: float
    distances: Residuals
    z: Tensor
    r: Tensor
    J: Tensor
    B: Tensor
    scale: float
    fixed: float
    clipped: float

    @classmethod
    def from_points(
        cls, rig: Rig, pairs: Pairs, used: Bool[Tensor, " n"], noise: float, prior: float = 0.0
    ) -> DriftEvidence:
        """Fit the drift of a rig to some of its matched points.

        Args:
            rig: the rig.
            pairs: matched points by pair of cameras.
            used: mask of the points to use, among all points of all pairs.
            noise: standard deviation of the points' distances, pixels.
            prior: -2 log probability of the rig without any points.

        Returns:
            The rig's drift with its evidence.

        Raises:
            ValueError: for a camera that the rig lacks, and pairs with neither cameras nor F.
        """
        parameters = free_parameters(rig, cameras_of(rig, pairs), free=UNCERTAIN)

        def distances(z: Tensor) -> list[Tensor]:
            return [r.nan_to_num() / noise for r in sampson_of_pairs(apply_change(rig, parameters, z), pairs)]

        z = torch.zeros(sum(len(u.sigma) for u in parameters), dtype=torch.float64)
        r, J = jacobian(distances, z)
        B = systematic_columns(rig, pairs) / noise
        wrong_side = _rotation_to_plausible_depth(rig, pairs)
        rare = {scale: RARE * math.log1p(scale**2) for scale in SCALES}
        fixed = {scale: prior + rare[scale] + (wrong_side / scale) ** 2 for scale in SCALES}

        def cost_of(scale: float) -> float:
            explained, volume, _ = _drift(r[used], J[used], B[used], scale)
            return explained + volume + fixed[scale]

        scale = min(SCALES, key=cost_of)
        evidence = cls(math.inf, distances, z, r, J, B, scale, fixed[scale], CLIPPED / noise)
        tried = []
        for _ in range(STEPS):
            tried.append(replace(evidence, cost=evidence._at(evidence.z, used)))
            if len(tried) > 1 and abs(tried[-1].cost - tried[-2].cost) < NO_BETTER:
                break
            z = evidence._refitted(used)
            r, J = jacobian(distances, z)
            evidence = replace(evidence, z=z, r=r - J @ z, J=J)
        return min(tried, key=lambda fitted: fitted.cost)

    def by(self, used: Bool[Tensor, " n"]) -> float:
        """Return the cost by other points, of this drift or of the best by them to first order: the lower
        one."""
        return min(self._at(z, used) for z in (self.z, self._refitted(used)))

    def _refitted(self, used: Bool[Tensor, " n"]) -> Tensor:
        return _drift(self.r[used], self.J[used], self.B[used], self.scale)[2]

    def _at(self, z: Tensor, used: Bool[Tensor, " n"]) -> float:
        """Return the cost of a drift by the points' distances then; infinite where there are none."""
        r, J, B = Evaluated.at(z, self.distances).values[used], self.J[used], self.B[used]
        left = _drift(r.clamp(-self.clipped, self.clipped), J[:, :0], B, self.scale)[0]
        volume = _drift(r, J, B, self.scale)[1]
        cost = left + volume + float((z / self.scale).square().sum()) + self.fixed
        return cost if math.isfinite(cost) else math.inf


def _drift(r: Tensor, J: Tensor, B: Tensor, scale: float) -> tuple[float, float, Tensor]:
    """Compute -2 log evidence by residuals r + J z + B b with z normal, of deviation `scale`, and b.

    Returns the part left in the residuals, the log determinant, and the most probable z.
    """
    columns = torch.cat([scale * J, B], 1)
    information = columns.T @ columns + torch.eye(columns.shape[1], dtype=r.dtype)
    slope = columns.T @ r
    step = torch.linalg.solve(information, slope)
    return float(r @ r - slope @ step), float(torch.logdet(information)), -scale * step[: J.shape[1]]


def _rotation_to_plausible_depth(rig: Rig, pairs: Pairs) -> float:
    """Return the rotation (prior deviations) that brings half the points into the range; 0 without poses."""
    near, far = (0.0, math.inf) if rig.depth is None else (float(bound) for bound in rig.depth)
    rotations = []
    for names, matches in pairs.items():
        if (pair := rig.pair(*names)).calibrated and pair.link is None:
            baseline = float(pair.beta_from_alpha.t.norm())
            parallax = (baseline / match_depths(rig, {names: matches}).depth).nan_to_num()
            low, high = baseline / (2 * far), 2 * baseline / near if near else math.inf
            rotations.append((low - parallax).clamp(min=0) + (parallax - high).clamp(min=0))
    return float(torch.cat(rotations).median()) / SIGMA["rotation"] if rotations else 0.0
