"""How well matched points support a rig that may have drifted a little: the evidence of a mistake against mere drift.

The residuals are normal with the noise of the points, plus a drift of the cameras whose prior deviations are those of
`parameters.SIGMA` times a scale, plus what lens models leave (`systematic_modes`); to first order in the drift. A
mistake that a drift explains as well is not a mistake that can be named.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from arraygeom import Camera, Rig

from .least_squares import JoinedResiduals, jacobian
from .matches import Matches
from .parameters import SIGMA, UNCERTAIN, FreeParameter, apply_change, free_parameters
from .refinement import systematic_columns
from .residuals import match_depths, sampson_of_pairs

Pairs = Mapping[tuple[str, str], Matches]

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
    """A rig that may have drifted, and the distances of matched points under it.

    noise: standard deviation of the points' distances, pixels. r, J, B: the distances in units of it, and their
    derivatives by the parameters and by what lens models leave. wrong_side: the rotation, in prior deviations, that
    brings half the points in front and into the depth range.
    """

    rig: Rig
    pairs: Pairs
    noise: float
    parameters: tuple[FreeParameter, ...]
    r: Tensor
    J: Tensor
    B: Tensor
    wrong_side: float

    @classmethod
    def of(cls, rig: Rig, pairs: Pairs, noise: float) -> DriftEvidence:
        """The distances of all points under a rig, to first order in its drift."""
        names = [name for name in rig.names if any(name in pair for pair in pairs)]
        free = list(UNCERTAIN) if any(isinstance(rig[name], Camera) for name in names) else []
        parameters = tuple(free_parameters(rig, names, free=free))
        z = torch.zeros(sum(len(u.sigma) for u in parameters), dtype=torch.float64)
        r, J = _linear(rig, pairs, noise, parameters, z)
        B = systematic_columns(rig, pairs) / noise
        return cls(rig, pairs, noise, parameters, r, J, B, _rotation_to_plausible_depth(rig, pairs))

    def least_surprise(self, used: Bool[Tensor, " n"]) -> float:
        """-2 log evidence of the rig with the drift that fits these points best. Smaller is better."""
        r, J, B = (part[used] for part in (self.r, self.J, self.B))
        fixed = {scale: RARE * math.log1p(scale**2) + (self.wrong_side / scale) ** 2 for scale in SCALES}
        best = min(SCALES, key=lambda scale: _Drift.of(r, J, B, scale).surprise + fixed[scale])
        z, least = torch.zeros(J.shape[1], dtype=torch.float64), math.inf
        for step in range(STEPS):
            if step:
                r, J = (part[used] for part in _linear(self.rig, self.pairs, self.noise, self.parameters, z))
            clipped = _Drift.of(r.clamp(-CLIPPED / self.noise, CLIPPED / self.noise), J[:, :0], B, best)
            volume = _Drift.of(r, J, B, best).volume
            found = clipped.surprise - clipped.volume + volume + float((z / best).square().sum())
            if found > least - NO_BETTER:
                return min(least, found) + fixed[best]
            least, z = found, _Drift.of(r - J @ z, J, B, best).z
        return least + fixed[best]


def _linear(
    rig: Rig, pairs: Pairs, noise: float, parameters: Sequence[FreeParameter], z: Tensor
) -> tuple[Tensor, Tensor]:
    """All points' distances in units of their noise after a drift, and their derivatives by it."""
    parts = JoinedResiduals(
        lambda drift: [r.nan_to_num() / noise for r in sampson_of_pairs(apply_change(rig, parameters, drift), pairs)]
    )
    return jacobian(parts, z)


class _Drift(NamedTuple):
    """Residuals r + J z + B b of normal z, of deviation `scale`, and b: -2 log evidence, and its log determinant.

    z: the most probable one.
    """

    surprise: float
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
