"""Fields around knowledge from another source: a depth map of alpha, or matches of its pixels in beta."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Float, Real
from torch import Tensor

from ..camera import LensView, View
from ..checks import check_above, check_field
from ..epipolar import beside, segments_between
from ..pair import Pair
from ..pixels import HW, floating
from ..segments import Segments
from ..undistortion import recorded_pixels, straight_pixels
from .default import straight_field
from .protocol import ReceptiveField, segments_by_rows
from .straight import pinhole_track, require_pinholes


@dataclass(frozen=True, eq=False)
class AroundDepth:
    """Field of the segments from depth / (1 + tolerance) to depth * (1 + tolerance) of a known depth map.

    Needs a calibrated pair without lenses, of which a link does not count. Only where the depth is not
    positive and finite, the segment is between the pair's own depth bounds, which are needed then.

    Attributes:
        depth: map (H, W) of depth z in the rig's unit (metres), at the pixels of `view`.
        tolerance: relative tolerance of the depth, at least 0.
        view: alpha as it was recorded, before it was undistorted, resized or cropped to the pair's alpha;
            None for the pair's alpha itself.

    Raises:
        ValueError: for a tolerance that is negative, infinite or NaN, or a depth map of another size than
            `view`.
        TypeError: for a tolerance that is no number.
    """

    depth: Float[Tensor, "h w"]
    tolerance: float = 0.05
    view: LensView | None = None

    def __post_init__(self) -> None:
        check_above(0, tolerance=self.tolerance)
        _check_size(self.depth, self.view)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Segments:
        """Compute the segments of alpha's pixels from near to far, inside beta's image and in front of it.

        The depth is that of the map's pixel nearest to each of x, not interpolated.

        Returns:
            Segments in beta's pixels, differentiable in the pair's numbers but not in the depth map.

        Raises:
            ValueError: for a pair that is not calibrated or has lenses, a depth map of another size, or a
                pixel without depth in a pair without a depth range.
        """
        require_pinholes(pair)
        _check_size(self.depth, self.view or pair.alpha)

        def around(x: Tensor) -> Segments:
            depth = _at_nearest(self.depth, x, pair.alpha, self.view).to(x)
            has_depth = depth.isfinite() & (depth > 0)
            near = far = depth
            if pair.depth is not None or not bool(has_depth.all()):
                near, far = (beside(bound.to(x), x.ndim - 1) for bound in pair.depth_range)
            near = torch.where(has_depth, depth / (1 + self.tolerance), near)
            far = torch.where(has_depth, depth * (1 + self.tolerance), far)
            return segments_between(pinhole_track(pair, x), near, far, pair.beta.hw)

        return segments_by_rows(around, pair, floating(x))


BESIDE = 1.0
"""Pixels, beyond the tolerance, by which a match may be off its segment: rigs and matches are
seldom better."""


@dataclass(frozen=True, eq=False)
class AroundMatches:
    """Field of the parts of another field's segments within `tolerance` pixels of known matches.

    Where no match is known, or it is off its segment by more than `tolerance` and a pixel, the segment is the
    whole one of `field`.

    Attributes:
        positions: (H, W, 2), positions (x, y) in beta of alpha's pixels; NaN or infinite where unknown.
        tolerance: pixels of beta, at least 0.
        views: alpha and beta as they were recorded, to whose pixels `positions` refers; None for the pair's
            views.
        field: field of straight segments; None for the pair's default field without lenses.

    Raises:
        ValueError: for a tolerance that is negative, infinite or NaN, or positions of another size than the
            first view.
        TypeError: for a tolerance that is no number, or an object that is no field.
    """

    positions: Float[Tensor, "h w 2"]
    tolerance: float = 1.0
    views: tuple[LensView, LensView] | None = None
    field: ReceptiveField | None = None

    def __post_init__(self) -> None:
        check_above(0, tolerance=self.tolerance)
        _check_size(self.positions, None if self.views is None else self.views[0])
        if self.field is not None:
            check_field(self.field)

    @classmethod
    def from_points(
        cls,
        alpha: Float[Tensor, "n 2"],
        beta: Float[Tensor, "n 2"],
        hw: HW,
        tolerance: float = 1.0,
        views: tuple[LensView, LensView] | None = None,
        field: ReceptiveField | None = None,
    ) -> AroundMatches:
        """Build the field from matched points (x, y) of an alpha of size `hw` and of beta.

        The displacement of each match is taken for the 3 x 3 pixels of alpha around it, as far as no other
        match is nearer.

        Args:
            alpha: points of alpha, pixels; of one by the border the pixels within `hw` count.
            beta: their matches in beta, pixels.
            hw: height and width of alpha.
            tolerance: pixels of beta, at least 0.
            views: alpha and beta as recorded; None for the pair's.
            field: field of straight segments; None for the pair's default field without lenses.

        Returns:
            The field, its positions in float32 on alpha's device; elsewhere its segments are whole.

        Raises:
            ValueError: for unequal numbers of points, and as the class.
            TypeError: as the class.
        """
        if alpha.shape != beta.shape:
            raise ValueError(f"{len(alpha)} points of alpha and {len(beta)} of beta: give a match of each")
        positions = torch.full((*hw, 2), torch.nan, dtype=torch.float32, device=alpha.device)
        column, row = alpha.round().long().unbind(-1)
        displacement = (beta - alpha).float()
        nearest_last = sorted(product((-1, 0, 1), repeat=2), key=lambda step: -math.hypot(*step))
        for down, across in nearest_last:
            x, y = column + across, row + down
            inside = (x >= 0) & (y >= 0) & (x < hw[1]) & (y < hw[0])
            pixels = torch.stack([x, y], -1)[inside]
            positions[pixels[:, 1], pixels[:, 0]] = pixels + displacement[inside]
        return cls(positions, tolerance, views, field)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Segments:
        """Compute the parts of the segments of `field` near the matches.

        Returns:
            Segments in beta's pixels; no gradients reach `positions`.

        Raises:
            ValueError: for positions of another size than alpha, a field that gives no straight segments, and
                `views` of a pair whose views have no K; the field's own errors pass, such as for lenses.
        """
        x = floating(x)
        _check_size(self.positions, pair.alpha if self.views is None else self.views[0])
        whole = (self.field or straight_field(pair))(pair, x)
        if not isinstance(whole, Segments):
            raise ValueError(
                "matches are parts of straight segments: give a field of segments, such as Epipolar"
            )
        alpha, beta = self.views or (None, None)
        match = _at_nearest(self.positions, x, pair.alpha, alpha).to(x)
        matched = match.isfinite().all(-1)
        match = torch.where(matched[..., None], match, 0.0)
        if beta is not None:
            match, placed = straight_pixels(match.double(), pair.beta, beta)
            match, matched = match.to(x), matched & placed
        fraction, length = whole.fraction(match).clamp(0, 1), whole.length
        matched = (
            matched & whole.valid & ((whole.at(fraction) - match).norm(dim=-1) <= self.tolerance + BESIDE)
        )
        reach = self.tolerance / length.clamp(min=1e-6)
        low, high = ((fraction + step).clamp(0, 1) for step in (-reach, reach))
        start = torch.where(matched[..., None], whole.at(low), whole.start)
        end = torch.where(matched[..., None], whole.at(high), whole.end)
        return Segments(start, end, whole.valid)


def _check_size(plane: Tensor, view: View | None) -> None:
    """Raise ValueError for a plane of another size than its view."""
    if view is not None and tuple(plane.shape[:2]) != tuple(view.hw):
        (h, w), (height, width) = plane.shape[:2], view.hw
        raise ValueError(
            f"the known depth or matches have {w}x{h} pixels, alpha has {width}x{height}: "
            "give them at alpha's pixels"
        )


def _at_nearest(plane: Tensor, x: Float[Tensor, "*n 2"], now: View, recorded: LensView | None) -> Tensor:
    """Look up values (H, W, ...) of the recorded pixels nearest to pixels `x` of alpha, without gradient."""
    # Not interpolated: between two pixels of different depth there is no depth.
    with torch.no_grad():
        if recorded is not None:
            x, _ = recorded_pixels(x.double(), now, recorded)
        h, w = plane.shape[:2]
        column = x[..., 0].round().long().clamp(0, w - 1)
        row = x[..., 1].round().long().clamp(0, h - 1)
        return plane.to(x.device)[row, column]
