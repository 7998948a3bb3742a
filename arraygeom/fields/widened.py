"""Fields of points that move, and tolerance of fields to calibration errors and to motion."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Real
from torch import Tensor

from ..checks import check_above, check_field
from ..pair import Pair
from ..pixels import HW, floating, shift_matrix
from ..sampling import sample
from ..segments import Positions, Segments, clip_to_image
from .curved import Curved, ThroughLenses
from .protocol import ReceptiveField, SamplingLocations, answered
from .straight import Epipolar, EpipolarLine, HomographyDisplacement


@dataclass(frozen=True, eq=False)
class Moved:
    """Any field, for cameras that are not synchronised, evaluated where alpha's pixels are when beta records.

    The displacement is interpolated bilinearly, and extended by the nearest pixel outside alpha's image.
    `Widened` allows for its error.

    Attributes:
        field: field of the point after it has moved.
        displacement: (2, H, W), motion in x and y of each of alpha's pixels from alpha's exposure to beta's,
            pixels of alpha, for instance by optical flow between alpha's own frames.

    Raises:
        ValueError: for a displacement of another shape.
        TypeError: for an object that is no field.
    """

    field: ReceptiveField
    displacement: Float[Tensor, "2 h w"]

    def __post_init__(self) -> None:
        check_field(self.field)
        if self.displacement.ndim != 3 or len(self.displacement) != 2:
            raise ValueError(
                f"displacement has shape {tuple(self.displacement.shape)}; wanted (2, height, width)"
            )

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> SamplingLocations:
        """Compute the field's sampling locations for the points to which alpha's pixels x move.

        Returns:
            Segments or positions in beta's pixels, as `field` gives them.

        Raises:
            ValueError: if alpha has another size than the displacement, or the field's result is invalid.
        """
        self.require(pair.alpha.hw)
        return answered(self.field, pair, self.points(x))

    def require(self, hw: HW) -> None:
        """Raise ValueError unless the displacement is of an alpha of this size."""
        if tuple(self.displacement.shape[1:]) != tuple(hw):
            (h, w), (height, width) = self.displacement.shape[1:], hw
            raise ValueError(
                f"displacement is of {w}x{h} pixels, alpha has {width}x{height}: give it at alpha's pixels"
            )

    def points(self, x: Real[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        """Return the positions in alpha of alpha's pixels when beta records."""
        x = floating(x)
        h, w = self.displacement.shape[-2:]
        inside = torch.minimum(x.clamp(min=0), x.new_tensor([w - 1, h - 1]))
        step = sample(self.displacement[None].to(x), inside.reshape(1, -1, 2)).values[0]
        return x + step.mT.reshape(x.shape)


@dataclass(frozen=True)
class Widened:
    """Any field with `across` pixels to either side of it and `along` more pixels at either end.

    Uncertain calibration moves lines sideways: `across` alone. Motion between cameras that are not
    synchronised moves points anywhere: `across` and `along`. Segments that are only longer stay segments.
    Wider ones become positions, on rows at most one pixel apart, the rows following one another (the first
    `across` to the left of the way from start to end). Positions (of `Curved`) are taken as ordered along a
    curve; each is stretched and widened about its own tangent. A segment of no length widens to a window with
    sides along x and y.

    Attributes:
        field: the field to widen.
        across: pixels of beta to either side, at least 0.
        along: pixels of beta at either end, at least 0.
        samples: number of positions along a segment that becomes wider, at least 1.

    Raises:
        ValueError: for numbers below these bounds, infinity or NaN.
        TypeError: for an object that is no field, or values that are no numbers.
    """

    field: ReceptiveField
    across: float = 0.0
    along: float = 0.0
    samples: int = 96

    def __post_init__(self) -> None:
        check_field(self.field)
        check_above(0, across=self.across, along=self.along)
        check_above(1, whole=True, samples=self.samples)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> SamplingLocations:
        """Compute the field's sampling locations, widened and on beta's image.

        Returns:
            Segments if `across` is 0 and the field gives segments, else positions (*n, rows * samples, 2), in
            beta's pixels.

        Raises:
            ValueError: for an invalid result of the field, or whatever the field raises for this pair.
        """
        locations = self._evaluated(pair, x)
        if isinstance(locations, Segments):
            more = self.along * direction(locations.end - locations.start)
            longer = Segments(locations.start - more, locations.end + more, locations.valid)
            if self.across == 0:
                clipped = clip_to_image(longer.start, longer.end, pair.beta.hw)
                return Segments(clipped.start, clipped.end, clipped.valid & locations.valid)
            locations = longer.positions(self.samples)
        else:
            xy, along = locations.xy, self.along
            steps = torch.linspace(-along, along, xy.shape[-2], dtype=xy.dtype, device=xy.device)
            locations = Positions(xy + steps[:, None] * tangents(locations), locations.mask)
        return self._band(locations, pair.beta.hw)

    def _evaluated(self, pair: Pair, x: Tensor) -> SamplingLocations:
        """Evaluate the field around beta's image too, as far as widening may bring it in; by sizes alone on
        the image."""
        margin = math.ceil(self.across + self.along)
        if margin == 0 or not _follows_beta(self.field, pair):
            return answered(self.field, pair, x)
        h, w = pair.beta.hw
        padded = pair.transform_beta(shift_matrix(-margin, -margin), (h + 2 * margin, w + 2 * margin))
        locations = answered(self.field, padded, x)
        if isinstance(locations, Segments):
            return Segments(locations.start - margin, locations.end - margin, locations.valid)
        return Positions(locations.xy - margin, locations.mask)

    @property
    def rows(self) -> int:
        """Number of rows of samples of a band."""
        return 2 * math.ceil(self.across) + 1

    def _band(self, p: Positions, hw: HW) -> Positions:
        tangent = tangents(p)
        left = torch.stack([tangent[..., 1], -tangent[..., 0]], -1)
        rows = torch.linspace(self.across, -self.across, self.rows, dtype=p.xy.dtype, device=p.xy.device)
        xy = p.xy[..., None, :, :] + rows[:, None, None] * left[..., None, :, :]
        xy = xy.flatten(-3, -2)
        inside = ((xy >= -0.5) & (xy <= xy.new_tensor([hw[1] - 0.5, hw[0] - 0.5]))).all(-1)
        mask = inside & p.mask[..., None, :].expand(*p.mask.shape[:-1], self.rows, -1).flatten(-2, -1)
        return Positions(torch.where(mask[..., None], xy, 0.0), mask)


def _follows_beta(field: ReceptiveField, pair: Pair) -> bool:
    """Return True if the field of a padded beta is the same in its pixels: by F or calibration it is, by
    sizes not."""
    if isinstance(field, ThroughLenses | Moved):
        return _follows_beta(field.field, pair)
    if isinstance(field, HomographyDisplacement):
        calibrated = pair.calibrated if pair.link is None else pair.link.H is not None
        return field.displacement is not None and calibrated
    return isinstance(field, Epipolar | EpipolarLine | Curved)


def direction(step: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
    """Return unit vectors of steps; along x for steps shorter than 1e-3 pixels."""
    squared = step.square().sum(-1, keepdim=True)
    moves = squared > 1e-6
    return torch.where(moves, step / torch.where(moves, squared, 1.0).sqrt(), step.new_tensor([1.0, 0.0]))


def tangents(p: Positions) -> Float[Tensor, "*n l 2"]:
    """Return the direction of the curve at each position, from those of its neighbours that count."""
    if p.xy.shape[-2] < 2:
        return direction(torch.zeros_like(p.xy))
    here, counts = p.xy, p.mask[..., None]
    after = torch.where(counts[..., 1:, :], here[..., 1:, :], here[..., :-1, :])
    before = torch.where(counts[..., :-1, :], here[..., :-1, :], here[..., 1:, :])
    return direction(torch.cat([after, here[..., -1:, :]], -2) - torch.cat([here[..., :1, :], before], -2))
