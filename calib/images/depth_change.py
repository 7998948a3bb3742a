"""What a rig's change does to depth, and which directions of change points determine well enough to make it.

Epipolar distances hardly change under some rotations and shifts that change depth much (a rotation about the
vertical and a shift of the principal point move points along their lines). The points' depth is therefore
split into the modes of its posterior covariance, and the change along a mode is made only if it is
significant, well determined, and clearly better known by the points than by the prior; otherwise that
combination of parameters stays where it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Rig

from .matches import Pairs
from .residuals import FEW, match_depths, share

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
BEYOND = 1.5
"""Points are outside the depth range by more than this factor."""
UNGAINED_CHANGE = 3.0
"""A change of depth is of concern beyond this many times the deviation of it that it takes away."""


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

    def objections(self) -> Iterator[str]:
        """Why the rig's change should not be accepted."""
        if self.after > self.before:
            yield "depth would be less certain than before"
        if self.doubtful:
            yield (
                f"depth would change by {self.change:.1%} but these points "
                f"determine it to {self.known:.1%} only"
            )
        elif self.change > LARGE_CHANGE:
            yield f"depth would change by {self.change:.0%}: a rig so far off is better calibrated anew"

    def __str__(self) -> str:
        return (
            f"depth changes by {self.change:.2%} (median of the points); its standard deviation, "
            f"by the stated ones of the parameters, is {self.before:.2%} before and {self.after:.2%} after"
        )


def relative_change(original: Rig, refined: Rig, pairs: Pairs) -> float:
    """The median of |depth after / depth before - 1| over points observable before; NaN for too few.

    Points that have no depth afterwards (behind a camera, too far) count as 1.
    """
    before, after = (observed_depths(rig, pairs) for rig in (original, refined))
    usable = (after / before - 1).abs()[~before.isnan()].nan_to_num(1.0)
    return float(usable.median()) if len(usable) >= FEW else torch.nan


def observed_depths(rig: Rig, pairs: Pairs) -> Float[Tensor, " n"]:
    """Depths in alpha (metres) of all points of all pairs; NaN behind a camera and where unobservable."""
    depth, front, observable = match_depths(rig, pairs)
    return torch.where(front & observable, depth, torch.nan).detach()


def share_outside(rig: Rig, pairs: Pairs) -> float:
    """The share of points of observable depth that are behind the cameras or outside the rig's depth range.

    Points of calibrated pairs only: 0 where there is no such pair, NaN for few points. The depth range, if
    the rig has one, counts with a margin.
    """
    depth, front, observable = match_depths(rig, pairs)
    if bool(depth.isnan().all()):
        return 0.0
    if rig.depth is not None:
        near, far = (float(bound) for bound in rig.depth)
        front = front & (depth >= near / BEYOND) & (depth <= far * BEYOND)
    return share(~front[observable])


def log_depths(
    after: Callable[[Tensor], Rig], rigs: Sequence[Rig], pairs: Pairs
) -> Callable[[Tensor], list[Tensor]] | None:
    """The logarithm of depth as a function of the parameters, of points observable in all these rigs.

    None for too few.
    """
    observable = ~torch.stack([observed_depths(rig, pairs) for rig in rigs]).isnan().any(0)
    if int(observable.sum()) < FEW:
        return None
    parts = zip(pairs.items(), observable.split([len(matches.alpha) for matches in pairs.values()]))
    kept = {names: matches.only(observed) for (names, matches), observed in parts if bool(observed.any())}
    return lambda z: [match_depths(after(z), kept).depth.clamp(min=torch.finfo(torch.float64).tiny).log()]


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
        determined = (self.deviation < KNOWN_BETTER * self.prior) & (self.deviation < LARGEST_DEVIATION)
        return (significant & determined) | (self.deviation < NEGLIGIBLE)

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
        torch.linalg.solve_triangular(lower, changes.T, upper=False).T @ V for changes in (z[None], left_out)
    )
    share = (len(left_out) - 1) / max(len(left_out), 1)
    raised = (share * jackknife.square().sum(0)).sqrt().clamp(min=1)
    size = len(G) ** 0.5
    return DepthModes(root, a[0], raised * norm / size, prior / size, raised)
