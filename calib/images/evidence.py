"""How well matched points support a rig that may have drifted: the evidence of a mistake against mere drift.

The residuals are normal with the noise of the points, plus a drift of the cameras whose prior deviations are
those of `parameters.SIGMA` times a scale, plus what lens models leave (`systematic_modes`); to first order in
the drift. A mistake that a drift explains as well is not a mistake that can be named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from arraygeom import Camera, Rig

from .least_squares import JoinedResiduals, Residuals, jacobian
from .matches import Pairs
from .parameters import SIGMA, UNCERTAIN, apply_change, free_parameters
from .refinement import systematic_columns
from .residuals import match_depths, sampson_of_pairs

SCALES = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
"""Drifts tried, in units of the prior deviations."""
RARE = 6.0
"""Larger drifts are rarer: -2 log probability of a scale s is this many times log(1 + s^2)."""
STEPS = 4
"""Steps of Gauss and Newton to the most probable drift."""
NO_BETTER = 0.1
"""... which end once the evidence improves by less."""
CLIPPED = 30.0
"""Residuals count as at most so many pixels."""


@dataclass(frozen=True)
class DriftEvidence:
    """A rig with the drift that fits matched points best.

    cost: -2 log evidence of the rig and that drift by the points used. Smaller is better; differences count.
    distances: of all points by a drift, in standard deviations of their noise. z: the drift. r, J, B: the
    distances, were there no drift, and their derivatives by the drift and by what lens models leave; linear
    about z. scale: of the drift. fixed: the part of the cost that does not depend on the distances. clipped:
    the largest distance that counts.
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
    def of(cls, rig: Rig, pairs: Pairs, used: Bool[Tensor, " n"], noise: float) -> DriftEvidence:
        """By those of the points that are used; `noise`: standard deviation of their distances, pixels."""
        names = [name for name in rig.names if any(name in pair for pair in pairs)]
        free = list(UNCERTAIN) if any(isinstance(rig[name], Camera) for name in names) else []
        parameters = tuple(free_parameters(rig, names, free=free))
        distances = JoinedResiduals(
            lambda z: [
                r.nan_to_num() / noise for r in sampson_of_pairs(apply_change(rig, parameters, z), pairs)
            ]
        )
        z = torch.zeros(sum(len(u.sigma) for u in parameters), dtype=torch.float64)
        r, J = jacobian(distances, z)
        B, clipped = systematic_columns(rig, pairs) / noise, CLIPPED / noise
        wrong_side = _rotation_to_plausible_depth(rig, pairs)
        fixed = {scale: RARE * math.log1p(scale**2) + (wrong_side / scale) ** 2 for scale in SCALES}
        best = min(SCALES, key=lambda scale: _Drift.of(r[used], J[used], B[used], scale).cost + fixed[scale])
        found = cls(math.inf, distances, z, r, J, B, best, fixed[best], clipped)
        for _ in range(STEPS):
            cost = found._at(found.z, used)
            if not cost < found.cost - NO_BETTER:
                return replace(found, cost=min(cost, found.cost))
            z = found._refitted(used)
            r, J = jacobian(distances, z)
            found = replace(found, cost=cost, z=z, r=r - J @ z, J=J)
        return found

    def by(self, used: Bool[Tensor, " n"]) -> float:
        """The cost by other points, of this drift or of the best by them to first order: the better."""
        return min(self._at(z, used) for z in (self.z, self._refitted(used)))

    def _refitted(self, used: Bool[Tensor, " n"]) -> Tensor:
        return _Drift.of(self.r[used], self.J[used], self.B[used], self.scale).z

    def _at(self, z: Tensor, used: Bool[Tensor, " n"]) -> float:
        """The cost of a drift by the points' distances as they are then; infinite where there are none."""
        r, J, B = self.distances(z).detach()[used], self.J[used], self.B[used]
        clipped = _Drift.of(r.clamp(-self.clipped, self.clipped), J[:, :0], B, self.scale)
        volume = _Drift.of(r, J, B, self.scale).volume
        cost = clipped.cost - clipped.volume + volume + float((z / self.scale).square().sum()) + self.fixed
        return cost if math.isfinite(cost) else math.inf


class _Drift(NamedTuple):
    """Residuals r + J z + B b; z normal, of deviation `scale`, and b: -2 log evidence, its log determinant.

    z: the most probable one.
    """

    cost: float
    volume: float
    z: Tensor

    @classmethod
    def of(cls, r: Tensor, J: Tensor, B: Tensor, scale: float) -> _Drift:
        columns = torch.cat([scale * J, B], 1)
        information = columns.T @ columns + torch.eye(columns.shape[1], dtype=r.dtype)
        slope = columns.T @ r
        step = torch.linalg.solve(information, slope)
        volume = float(torch.logdet(information))
        return cls(float(r @ r - slope @ step) + volume, volume, -scale * step[: J.shape[1]])


def _rotation_to_plausible_depth(rig: Rig, pairs: Pairs) -> float:
    """The rotation, in prior deviations, that brings half the points in front and into the depth range."""
    found = []
    for names, matches in pairs.items():
        pair = rig.pair(*names)
        depths = match_depths(pair, matches)
        if depths is None:
            continue
        baseline = float(pair.beta_from_alpha.t.norm())
        near, far = (0.0, math.inf) if rig.depth is None else (float(bound) for bound in rig.depth)
        parallax = (baseline / depths.depth).nan_to_num()
        low, high = baseline / (2 * far), baseline / max(near / 2, 1e-12)
        found.append((low - parallax).clamp(min=0) + (parallax - high).clamp(min=0))
    return float(torch.cat(found).median()) / SIGMA["rotation"] if found else 0.0
