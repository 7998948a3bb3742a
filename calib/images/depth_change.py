"""What a rig's change does to depth, and which directions of change points determine well enough to make it.

Epipolar distances hardly change under some rotations and shifts that change depth much (a rotation about the
vertical and a shift of the principal point move points along their lines). The points' depth is therefore
split into the modes of its posterior covariance, and the change along a mode is made only if it is
significant, well determined, and clearly better known by the points than by the prior; otherwise that
combination of parameters stays where it was.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Rig

from .matches import Pairs
from .residuals import match_depths

SIGNIFICANT_CHANGE = 3.0
"""Standard deviations by which a mode of depth must change."""
KNOWN_BETTER = 0.15
"""The largest posterior deviation of a mode of depth that changes, as a share of the prior's."""
LARGEST_DEVIATION = 0.02
"""The largest posterior deviation, relative to depth, of a mode that changes."""
NEGLIGIBLE = 5e-4
"""Relative deviation of depth below which a mode is no concern."""
LARGE_CHANGE = 0.25
"""Relative change of depth that is not accepted unasked."""
SMALL_CHANGE = 0.03
"""Relative change of depth of no concern, where lines come nearer and depth becomes more certain."""
UNGAINED_CHANGE = 3.0
"""A change of depth is of concern beyond this many times the deviation of it that it takes away."""
FEW = 10
"""Least number of points whose depth is observable."""


class DepthChange(NamedTuple):
    """Relative change of the matched points' depth (median), and its deviations before and after (rms).

    The deviations are those that the stated deviations of the parameters imply; after, given the matched
    points where these changed the rig. known: the deviation if the rig had followed the matched points in
    everything.
    """

    change: float
    before: float
    after: float
    known: float

    @property
    def doubtful(self) -> bool:
        """Whether depth changes by less than some deviations of what the points determine, and considerably.

        That is by more than a small share, or by far more than it gains in certainty: by a mode of depth that
        was uncertain by so little beforehand, some other mistake of the rig (of a lens, say) is explained.
        """
        if self.change <= NEGLIGIBLE or self.change >= SIGNIFICANT_CHANGE * self.known:
            return False
        gained = max(self.before**2 - self.after**2, 0.0) ** 0.5
        return self.change > SMALL_CHANGE or self.change > UNGAINED_CHANGE * gained

    def __str__(self) -> str:
        return (
            f"depth changes by {self.change:.2%} (median of the points); its standard deviation, "
            f"by the stated ones of the parameters, is {self.before:.2%} before and {self.after:.2%} after"
        )


def relative_change(given: Rig, refined: Rig, pairs: Pairs) -> float:
    """The median of |depth after / depth before - 1| over points observable before; NaN for too few.

    Points that have no depth afterwards (behind a camera, too far) count as 1.
    """
    before, after = (observed_depths(rig, pairs) for rig in (given, refined))
    usable = (after / before - 1).abs()[~before.isnan()].nan_to_num(1.0)
    return float(usable.median()) if len(usable) >= FEW else torch.nan


def observed_depths(rig: Rig, pairs: Pairs) -> Float[Tensor, " n"]:
    """Depths in alpha (metres) of all points of all pairs; NaN behind a camera and where unobservable."""
    parts = []
    for names, matches in pairs.items():
        found = match_depths(rig.pair(*names), matches)
        depth = torch.full((len(matches.alpha),), torch.nan, dtype=torch.float64)
        if found is not None:
            depth = torch.where(found.front & found.observable, found.depth, depth)
        parts.append(depth.detach())
    return torch.cat(parts)


def share_behind(rig: Rig, pairs: Pairs) -> float:
    """The share of points behind a camera, of those whose rays meet anywhere; 0 for too few."""
    found = [match_depths(rig.pair(*names), matches) for names, matches in pairs.items()]
    front = torch.cat(
        [torch.ones(0, dtype=torch.bool), *(f.front[f.observable] for f in found if f is not None)]
    )
    return float((~front).double().mean()) if len(front) >= FEW else 0.0


def log_depths(
    after: Callable[[Tensor], Rig], rigs: Sequence[Rig], pairs: Pairs
) -> Callable[[Tensor], Tensor] | None:
    """The logarithm of depth as a function of the parameters, of points observable in all these rigs.

    None for too few.
    """
    kept = {}
    for names, matches in pairs.items():
        depths = torch.stack([observed_depths(rig, {names: matches}) for rig in rigs])
        kept[names] = matches.only(~depths.isnan().any(0))
    kept = {names: matches for names, matches in kept.items() if len(matches.alpha)}
    if sum(len(matches.alpha) for matches in kept.values()) < FEW:
        return None

    def values(z: Tensor) -> Tensor:
        rig = after(z)
        found = [match_depths(rig.pair(*names), matches) for names, matches in kept.items()]
        return torch.cat([part.depth.clamp(min=1e-6).log() for part in found if part is not None])

    return values


class DepthModes(NamedTuple):
    """Modes of the points' depth: z is a sum of uncorrelated parts, each changing depth in its own pattern.

    root: columns, one a mode; z = root a. a: the modes' changes in posterior standard deviations.
    deviation, prior: the relative deviation of depth by each mode (rms over the points), posterior and prior;
    the posterior's is raised to that of a jackknife over parts of the image where that is larger.
    """

    root: Float[Tensor, "n n"]
    a: Float[Tensor, " n"]
    deviation: Float[Tensor, " n"]
    prior: Float[Tensor, " n"]
    raised: Float[Tensor, " n"]

    @property
    def kept(self) -> Bool[Tensor, " n"]:
        """Which modes may change."""
        significant = self.a.abs() > SIGNIFICANT_CHANGE * self.raised
        known = (self.deviation < KNOWN_BETTER * self.prior) & (self.deviation < LARGEST_DEVIATION)
        return (significant & known) | (self.deviation < NEGLIGIBLE)

    def gained(self, kept: Bool[Tensor, " n"]) -> float:
        """The variance of depth that some modes lose, relative to depth squared (mean over the points)."""
        return float((self.prior.square() - self.deviation.square())[kept].sum())

    @property
    def total(self) -> float:
        """The posterior's relative deviation of depth by all modes: root mean square over the points."""
        return float(self.deviation.square().sum().sqrt())


def depth_modes(
    G: Float[Tensor, "m n"],
    z: Float[Tensor, " n"],
    covariance: Float[Tensor, "n n"],
    left_out: Float[Tensor, "g n"],
) -> DepthModes:
    """The modes, from derivatives G of the logarithm of depth by parameters whose prior covariance is 1.

    `left_out`: the changes of z when a part of the points is left out.
    """
    lower = torch.linalg.cholesky(covariance)
    V = torch.linalg.eigh(lower.T @ G.T @ G @ lower).eigenvectors
    root = lower @ V
    pattern = G @ root
    norm = pattern.norm(dim=0)
    prior = (G.T @ (pattern / norm.clamp(min=1e-300))).norm(dim=0)
    a, jackknife = (
        torch.linalg.solve_triangular(lower, part.T, upper=False).T @ V for part in (z[None], left_out)
    )
    share = (len(left_out) - 1) / max(len(left_out), 1)
    raised = (share * jackknife.square().sum(0)).sqrt().clamp(min=1)
    size = len(G) ** 0.5
    return DepthModes(root, a[0], raised * norm / size, prior / size, raised)
