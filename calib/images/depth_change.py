"""The change of depth that a change of the rig causes, and the directions of it that points determine well.

Epipolar distances hardly change under some rotations and shifts that change depth much (a rotation about the
vertical and a shift of the principal point move points along their lines). The points' depth is therefore
split into the modes of its posterior covariance, and the change along a mode is made only if it is
significant, well determined, and clearly better known by the points than by the prior; otherwise that
combination of parameters keeps its value.
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
"""Least change of a mode of depth that counts, in standard deviations."""
KNOWN_BETTER = 0.15
"""Largest posterior deviation of a mode that may change, as a share of its prior deviation."""
LARGEST_DEVIATION = 0.02
"""Largest posterior deviation of a mode that may change, relative to depth."""
NEGLIGIBLE = 5e-4
"""Deviation of depth, relative, below which a mode may change freely."""
LARGE_CHANGE = 0.25
"""Change of depth, relative, that is not accepted unless forced."""
SMALL_CHANGE = 0.03
"""Change of depth, relative, that is accepted where lines come nearer and depth becomes more certain."""
BEYOND = 1.5
"""Factor of depth beyond the rig's depth range at which a point counts as outside."""
UNGAINED_CHANGE = 3.0
"""Largest change of depth as a multiple of the deviation that it removes; a larger one is doubtful."""


class DepthChange(NamedTuple):
    """Relative change of the matched points' depth, and its standard deviations.

    The deviations follow from the stated prior deviations of the parameters.

    Attributes:
        change: median over the points of |depth after / depth before - 1|.
        before: relative deviation of depth by the prior (root mean square over the points).
        after: the same after the refinement, given the matched points where these changed the rig.
        known: the deviation left if the rig had followed the matched points in every direction.
    """

    change: float
    before: float
    after: float
    known: float

    @property
    def doubtful(self) -> bool:
        """True if depth changes considerably, but by less than `SIGNIFICANT_CHANGE` times `known`.

        Considerably means by more than `SMALL_CHANGE`, or by more than `UNGAINED_CHANGE` times the deviation
        that it removes: a mode that was hardly uncertain beforehand then explains another mistake of the rig,
        such as one of a lens.
        """
        if self.change <= NEGLIGIBLE or self.change >= SIGNIFICANT_CHANGE * self.known:
            return False
        gained = max(self.before**2 - self.after**2, 0.0) ** 0.5
        return self.change > SMALL_CHANGE or self.change > UNGAINED_CHANGE * gained

    def objections(self) -> Iterator[str]:
        """Yield a sentence for each reason not to accept the rig's change.

        Yields:
            Text without a full stop; nothing where depth raises no objection.
        """
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
    """Compute how much the depth of matched points differs between two rigs.

    Returns:
        The median of |depth after / depth before - 1| over points observable in `original`; NaN for fewer
        than `FEW`. Points without depth afterwards (behind a camera, too far) count as 1.
    """
    before, after = (observed_depths(rig, pairs) for rig in (original, refined))
    usable = (after / before - 1).abs()[~before.isnan()].nan_to_num(1.0)
    return float(usable.median()) if len(usable) >= FEW else torch.nan


def observed_depths(rig: Rig, pairs: Pairs) -> Float[Tensor, " n"]:
    """Compute the depth in alpha of all points of all pairs.

    Returns:
        Depths in the rig's unit (metres), the pairs' points one after the other, detached; NaN for points
        behind a camera, with too little parallax, or of uncalibrated pairs.
    """
    depth, front, observable = match_depths(rig, pairs)
    return torch.where(front & observable, depth, torch.nan).detach()


def share_outside(rig: Rig, pairs: Pairs) -> float:
    """Compute the share of points behind the cameras or outside the rig's depth range.

    Only points of observable depth count. The depth range, if the rig has one, is widened by `BEYOND`.

    Returns:
        A share in 0..1; 0 without a calibrated pair, NaN for fewer than `FEW` such points.
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
    """Build a function from a change of a rig's parameters to the logarithms of its points' depths.

    Args:
        after: function from a change z of the parameters to the rig after it.
        rigs: rigs in all of which a point's depth must be observable, for the point to be used.
        pairs: matched points by pair of cameras.

    Returns:
        A function of z that returns a list of one tensor, the logarithms of the depths in alpha,
        differentiable in z; None for fewer than `FEW` points.
    """
    observable = ~torch.stack([observed_depths(rig, pairs) for rig in rigs]).isnan().any(0)
    if int(observable.sum()) < FEW:
        return None
    parts = zip(pairs.items(), observable.split([len(matches.alpha) for matches in pairs.values()]))
    kept = {names: matches.only(observed) for (names, matches), observed in parts if bool(observed.any())}
    return lambda z: [match_depths(after(z), kept).depth.clamp(min=torch.finfo(torch.float64).tiny).log()]


class DepthModes(NamedTuple):
    """Modes of the points' depth: uncorrelated parts of z, each of which changes depth in its own pattern.

    Attributes:
        root: columns, one a mode: z = root a.
        a: changes of the modes, in posterior standard deviations.
        deviation: posterior deviation of depth by each mode, relative (root mean square over the points),
            raised to that of a jackknife over parts of the image where that is larger.
        prior: prior deviation of depth by each mode, relative.
        raised: factor, at least 1, by which the jackknife raised each mode's deviation.
    """

    root: Float[Tensor, "n n"]
    a: Float[Tensor, " n"]
    deviation: Float[Tensor, " n"]
    prior: Float[Tensor, " n"]
    raised: Float[Tensor, " n"]

    @property
    def kept(self) -> Bool[Tensor, " n"]:
        """Mask of the modes that may change.

        Those are significant, well determined and better known than by the prior, or negligible in depth.
        """
        significant = self.a.abs() > SIGNIFICANT_CHANGE * self.raised
        determined = (self.deviation < KNOWN_BETTER * self.prior) & (self.deviation < LARGEST_DEVIATION)
        return (significant & determined) | (self.deviation < NEGLIGIBLE)

    def gained(self, kept: Bool[Tensor, " n"]) -> float:
        """Compute the variance of depth that the `kept` modes lose, relative to depth squared (mean over the
        points)."""
        return float((self.prior.square() - self.deviation.square())[kept].sum())

    @property
    def total(self) -> float:
        """Relative posterior deviation of depth by all modes: root mean square over the points."""
        return float(self.deviation.square().sum().sqrt())


def depth_modes(
    G: Float[Tensor, "m n"],
    z: Float[Tensor, " n"],
    covariance: Float[Tensor, "n n"],
    left_out: Float[Tensor, "g n"],
) -> DepthModes:
    """Split a change of parameters into the modes of depth.

    Args:
        G: derivatives of the logarithm of depth by parameters whose prior covariance is 1.
        z: the change, in prior deviations.
        covariance: posterior covariance of z; positive definite.
        left_out: changes of z when one part of the points is left out, one row a part; may be empty.

    Returns:
        The modes, one per parameter.
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
