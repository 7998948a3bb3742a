"""How well matched points support a rig that may have drifted a little: the evidence of a mistake against mere drift.

The residuals are normal with the noise of the points, plus a drift of the cameras whose prior deviations are those of
`parameters.SIGMA` times a scale, plus what lens models leave (`systematic_modes`); to first order in the drift. A
mistake that a drift explains as well is not a mistake that can be named.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from arraygeom import Camera, Rig

from .least_squares import jacobian
from .matches import Matches
from .parameters import SIGMA, UNCERTAIN, apply_change, free_parameters
from .refinement import systematic_columns
from .residuals import match_depths, sampson

Pairs = Mapping[tuple[str, str], Matches]

SCALES = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
"""Drifts tried, in units of the prior deviations."""
RARE = 6.0
"""Larger drifts are rarer: -2 log probability of a scale s is this many times log(1 + s^2)."""
STEPS = 4
"""Steps of Gauss and Newton to the most probable drift."""
CLIPPED = 30.0
"""Residuals count as at most so many pixels."""


def least_surprise(rig: Rig, pairs: Pairs, inliers: Bool[Tensor, " n"], noise: float, *, mirrored: bool) -> float:
    """-2 log evidence of a rig with the drift that fits best; infinite if images are mirrored against the rig.

    `noise`: standard deviation of the points' distances, pixels. Smaller is better; differences count.
    """
    if mirrored:
        return math.inf
    names = [name for name in rig.names if any(name in pair for pair in pairs)]
    free = list(UNCERTAIN) if any(isinstance(rig[name], Camera) for name in names) else []
    parameters = free_parameters(rig, names, free=free)
    count = sum(len(u.sigma) for u in parameters)
    B = systematic_columns(rig, pairs)[inliers] / noise

    def residuals(z: Tensor) -> Tensor:
        return sampson(apply_change(rig, parameters, z), pairs)[inliers].nan_to_num() / noise

    r, J = jacobian(residuals, torch.zeros(count, dtype=torch.float64))
    wrong_side = _rotation_to_plausible_depth(rig, pairs)
    fixed = {scale: RARE * math.log1p(scale**2) + (wrong_side / scale) ** 2 for scale in SCALES}
    best = min(SCALES, key=lambda scale: _Drift.of(r, J, B, scale).surprise + fixed[scale])
    z, found = torch.zeros(count, dtype=torch.float64), []
    for _ in range(STEPS):
        clipped = _Drift.of(r.clamp(-CLIPPED / noise, CLIPPED / noise), J[:, :0], B, best)
        volume = _Drift.of(r, J, B, best).volume
        found.append(clipped.surprise - clipped.volume + volume + float((z / best).square().sum()))
        z = _Drift.of(r - J @ z, J, B, best).z
        r, J = jacobian(residuals, z)
    return min(found) + fixed[best]


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
