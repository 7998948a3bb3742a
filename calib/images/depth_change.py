"""The change of depth that a change of a rig causes, and whether matched points determine it.

Epipolar distances hardly change under some rotations and shifts that change depth much (a rotation about the
vertical and a shift of the principal point move points along their lines), and poses stand in for mistakes of
lenses: on stereo pairs with a k1 that was .05 off, poses fitted to the lines changed depth by 12 to 16 per
cent, seven of their deviations and more, and made it worse. Depth, as given, is therefore evidence, and lines
are mended by changes that keep it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig

from .matches import Pairs
from .residuals import FEW, match_depths, share

DEPTH_KEPT = 0.003
"""Relative standard deviation of depth, as given, as evidence."""
SMALL = 0.015
"""Change of depth, relative, up to which depth counts as kept: rotations of .2 degrees change it by nearly as
much on the rigs for tuning."""
BEYOND = 1.5
"""Factor of depth beyond the rig's depth range at which a point counts as outside."""


class DepthChange(NamedTuple):
    """Relative change of the matched points' depth, and the change that their lines suggest.

    Attributes:
        change: median over the points of |depth after / depth before - 1|.
        suggested: the same if the rig followed the lines in every direction.
    """

    change: float
    suggested: float

    def objections(self) -> Iterator[str]:
        """Yield a sentence, without a full stop, for each reason not to accept the rig's change, if any."""
        if self.change > SMALL:
            yield f"depth would change by {self.change:.1%}, which matched points do not determine"

    def __str__(self) -> str:
        return (
            f"depth not determined: it changes by {self.change:.2%} (median); the lines alone suggest "
            f"{self.suggested:.1%}, but poses stand in for lenses there"
        )


def relative_change(original: Rig, refined: Rig, pairs: Pairs) -> float:
    """Compute how much the depth of matched points differs between two rigs of the same cameras.

    Returns:
        The median of |depth after / depth before - 1| over points with a depth in `original`; NaN for fewer
        than `FEW`. Points without depth afterwards (behind a camera, too far) count as 1.

    Raises:
        ValueError, TypeError: as `match_depths`.
    """
    before, after = (observed_depths(rig, pairs) for rig in (original, refined))
    usable = (after / before - 1).abs()[~before.isnan()].nan_to_num(1.0)
    return float(usable.median()) if len(usable) >= FEW else torch.nan


def observed_depths(rig: Rig, pairs: Pairs) -> Float[Tensor, " n"]:
    """Compute the depth in alpha of all points of all pairs.

    Returns:
        Depths in the rig's unit (metres), the pairs' points one after the other, detached; NaN for points
        behind a camera, with too little parallax or without rays, and for pairs with a link.

    Raises:
        ValueError, TypeError: as `match_depths`.
    """
    depth, front, observable = match_depths(rig, pairs)
    return torch.where(front & observable, depth, torch.nan).detach()


def share_outside(rig: Rig, pairs: Pairs) -> float:
    """Compute the share of points behind the cameras or outside the rig's depth range.

    Only points of observable depth count. The depth range, if the rig has one, is widened by the factor
    `BEYOND` at both ends.

    Returns:
        A share in 0..1; 0 if no point has a depth (as all pairs have links), else NaN for fewer than `FEW`
        points of observable depth.

    Raises:
        ValueError, TypeError: as `match_depths`.
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
        A function of z that returns a list of one tensor, the logarithms of the depths in alpha (of the
        least positive number for points that are then behind), differentiable in z; None for fewer than `FEW`
        points.

    Raises:
        ValueError, TypeError: as `match_depths`.
    """
    observable = ~torch.stack([observed_depths(rig, pairs) for rig in rigs]).isnan().any(0)
    if int(observable.sum()) < FEW:
        return None
    parts = zip(pairs.items(), observable.split([len(matches.alpha) for matches in pairs.values()]))
    kept = {names: matches.only(observed) for (names, matches), observed in parts if bool(observed.any())}
    return lambda z: [match_depths(after(z), kept).depth.clamp(min=torch.finfo(torch.float64).tiny).log()]
