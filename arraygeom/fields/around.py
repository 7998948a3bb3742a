"""Fields around what is known from elsewhere: a depth map of alpha, or matches of its pixels in beta."""

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
    """The segment from depth / (1 + tolerance) to depth * (1 + tolerance) of a known map; needs calibration.

    `depth` (H, W) is z in metres at the pixels of `view`, alpha as it was recorded (None: the pair's alpha,
    without a lens). Where it is not positive and finite, the segment is that between the pair's depth bounds,
    which it needs to have only if there is such a pixel.
    """

    depth: Float[Tensor, "h w"]
    tolerance: float = 0.05
    view: LensView | None = None

    def __post_init__(self) -> None:
        check_above(0, tolerance=self.tolerance)
        _check_size(self.depth, self.view)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Segments:
        """Segments from near to far, inside beta's image and in front of it. Raises ValueError for lenses."""
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
"""Pixels by which a match may be off its segment beyond the tolerance: rigs and matches are seldom better."""


@dataclass(frozen=True, eq=False)
class AroundMatches:
    """The parts of another field's segments within `tolerance` pixels of known matches.

    `positions` (H, W, 2) are where the pixels of alpha are in beta (x, y), NaN where it is not known; both as
    recorded, by `views` (None: as the pair has them, without lenses). Where no match is known, or it is off
    its segment by more than `tolerance` and a pixel, the segment is the whole one of `field` (default: the
    pair's default field).
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
        """Of points (x, y) of an alpha of size `hw` and the same in beta; each is known in 3 x 3 pixels, as
        far as no other is nearer."""
        positions = torch.full((*hw, 2), torch.nan, dtype=torch.float32, device=alpha.device)
        column, row = alpha.round().long().unbind(-1)
        displacement = (beta - alpha).float()
        nearest_last = sorted(product((-1, 0, 1), repeat=2), key=lambda step: -math.hypot(*step))
        for down, across in nearest_last:
            x, y = column + across, row + down
            inside = (x >= 0) & (y >= 0) & (x < hw[1]) & (y < hw[0])
            here = torch.stack([x, y], -1)[inside]
            positions[here[:, 1], here[:, 0]] = here + displacement[inside]
        return cls(positions, tolerance, views, field)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Segments:
        """Parts of the segments of `field`. Raises ValueError unless it is of straight segments."""
        x = floating(x)
        _check_size(self.positions, pair.alpha if self.views is None else self.views[0])
        whole = (self.field or straight_field(pair))(pair, x)
        if not isinstance(whole, Segments):
            raise ValueError(
                "matches are parts of straight segments: give a field of segments, such as Epipolar"
            )
        alpha, beta = self.views or (None, None)
        there = _at_nearest(self.positions, x, pair.alpha, alpha).to(x)
        matched = there.isfinite().all(-1)
        there = torch.where(matched[..., None], there, 0.0)
        if beta is not None:
            there, placed = straight_pixels(there.double(), pair.beta, beta)
            there, matched = there.to(x), matched & placed
        fraction, length = whole.fraction(there).clamp(0, 1), whole.length
        matched = (
            matched & whole.valid & ((whole.at(fraction) - there).norm(dim=-1) <= self.tolerance + BESIDE)
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
    """Values (H, W, ...) of the recorded pixels nearest to pixels `x` of alpha as it is now; no gradients.

    Between two pixels of different depth there is no depth: values are not interpolated.
    """
    with torch.no_grad():
        if recorded is not None:
            x, _ = recorded_pixels(x.double(), now, recorded)
        h, w = plane.shape[:2]
        column = x[..., 0].round().long().clamp(0, w - 1)
        row = x[..., 1].round().long().clamp(0, h - 1)
        return plane.to(x.device)[row, column]
