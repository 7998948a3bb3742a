"""Fields of points that move, and tolerance of fields to calibration errors and to motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Real
from torch import Tensor

from ..camera import Camera
from ..checks import check_above, check_field
from ..multiview import world_rays
from ..pair import Pair
from ..pixels import HW, floating, pixel_grid, shift_matrix, within
from ..rig import Rig
from ..sampling import sample
from ..segments import Positions, Segments, clip_to_image, sample_fractions
from ..uncertainty import Covariance, bands
from .curved import Curved, ThroughLenses
from .default import default_field
from .protocol import ReceptiveField, SamplingLocations, answered
from .straight import Epipolar, EpipolarLine, HomographyDisplacement


@dataclass(frozen=True, eq=False)
class Moved:
    """Field that evaluates another one where alpha's pixels are when beta records, for cameras that are not
    synchronised.

    The displacement is interpolated bilinearly (with gradient), and extended by the nearest pixel outside
    alpha's image. `Widened` allows for its error.

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
            ValueError: if alpha has another size than the displacement, or the field's result is invalid; the
                field's own errors pass.
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
        step = sample(self.displacement[None].to(x), x.reshape(1, -1, 2), extended=True).values[0]
        return x + step.mT.reshape(x.shape)


@dataclass(frozen=True)
class Widened:
    """Field that widens another one by `across` pixels to either side and `along` at either end.

    Uncertain calibration moves lines sideways: `across` alone. Motion between cameras that are not
    synchronised moves points anywhere: `across` and `along`. Segments that are only longer stay segments.
    Wider ones become positions, on rows at most one pixel apart, the rows following one another (the first
    `across` to the left of the way from start to end). Positions (of `Curved`) are taken as ordered along a
    curve; each is stretched and widened about its own tangent. A segment of no length widens to a window with
    sides along x and y. Samples off beta's image are masked.

    Attributes:
        field: the field to widen.
        across: pixels of beta to either side, at least 0.
        along: pixels of beta at either end, at least 0.
        samples: number of positions along a segment that becomes wider, at least 1.
        margins: pixels to add, of each alpha pixel its own, as `from_covariance` finds them; None for none.

    Raises:
        ValueError: for numbers below these bounds, infinity or NaN.
        TypeError: for an object that is no field, or values that are no numbers, or no whole one.
    """

    field: ReceptiveField
    across: float = 0.0
    along: float = 0.0
    samples: int = 96
    margins: Margins | None = None

    def __post_init__(self) -> None:
        check_field(self.field)
        check_above(0, across=self.across, along=self.along)
        check_above(1, whole=True, samples=self.samples)

    @classmethod
    def from_covariance(
        cls,
        rig: Rig,
        covariance: Covariance,
        alpha: str,
        beta: str,
        *,
        field: ReceptiveField | None = None,
        confidence: float = 0.95,
        samples: int = 96,
    ) -> Widened:
        """Widen a field by the uncertainty of a rig's calibration, at each pixel of alpha by its own.

        Args:
            rig: rig with a depth range.
            covariance: covariance of parameters of the rig, as `calib` writes it beside the rig.
            alpha: name of a calibrated camera of the rig, and `beta` of another.
            field: field to widen; None for the pair's `default_field`.
            confidence: probability that the band holds the point, across and along each, for normal errors.
            samples: number of positions along a segment.

        Returns:
            The field of this pair alone (not checked), also after its images are resized or undistorted.

        Raises:
            ValueError: as `arraygeom.uncertainty.bands`, such as for a rig without a depth range or a camera
                that it has not, for one camera given twice, and if beta sees nothing within the depth range.
        """
        camera, pair = rig[rig.require(alpha)], rig.pair(alpha, beta)
        (h, w), (rows, columns) = camera.hw, GRID
        x = pixel_grid(GRID, dtype=torch.float64) * torch.tensor(
            [(w - 1) / (columns - 1), (h - 1) / (rows - 1)]
        )
        band = bands(rig, covariance, alpha, beta, x.reshape(-1, 2), confidence)
        grid = torch.cat([band.across, band.along], -1)
        if not bool(grid.isfinite().any()):
            raise ValueError(
                f"'{beta}' sees nothing that '{alpha}' sees within the depth range: check the rig"
            )
        most = torch.where(grid.isfinite(), grid, 0.0).amax(0)
        grid = torch.where(grid.isfinite(), grid, most).T.reshape(1, 4, rows, columns)
        widest = float(most[:2].max()), float(most[2:].max())
        margins = Margins(pair.cameras[0], pair.cameras[1].K, grid, widest)
        return cls(default_field(pair) if field is None else field, samples=samples, margins=margins)

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> SamplingLocations:
        """Compute the field's sampling locations, widened and on beta's image.

        Returns:
            In beta's pixels, segments if the field gives segments and neither `across` nor margins widen
            them, else positions (*n, rows * samples, 2), row after row; masked ones are 0.

        Raises:
            ValueError: for an invalid result of the field, or whatever the field raises for this pair.
        """
        across, along = self._widths(pair, x)
        most_across, most_along = self._most
        locations = self._evaluated(pair, x, math.ceil(most_across + most_along))
        if isinstance(locations, Segments):
            way = direction(locations.end - locations.start)
            start, end = locations.start - along[..., :1] * way, locations.end + along[..., 1:] * way
            longer = Segments(start, end, locations.valid)
            if most_across == 0:
                clipped = clip_to_image(longer.start, longer.end, pair.beta.hw)
                return Segments(clipped.start, clipped.end, clipped.valid & locations.valid)
            locations = longer.positions(self.samples)
        else:
            steps = _between(-along[..., :1], along[..., 1:], locations.xy)
            locations = Positions(locations.xy + steps[..., None] * tangents(locations), locations.mask)
        return self._band(locations, pair.beta.hw, across)

    def _widths(self, pair: Pair, x: Tensor) -> tuple[Tensor, Tensor]:
        """Widths across and along at each pixel's start and end, (*n or none, 2)."""
        across, along = (floating(x).new_full((2,), width) for width in (self.across, self.along))
        if self.margins is None:
            return across, along
        more = self.margins.at(pair, x)
        return across + more[..., :2], along + more[..., 2:]

    @property
    def _most(self) -> tuple[float, float]:
        """Largest widths across and along."""
        more = (0.0, 0.0) if self.margins is None else self.margins.most
        return self.across + more[0], self.along + more[1]

    @property
    def rows(self) -> int:
        """Number of rows of samples of a band."""
        return 2 * math.ceil(self._most[0]) + 1

    def _evaluated(self, pair: Pair, x: Tensor, margin: int) -> SamplingLocations:
        """Evaluate the field around beta's image too, as far as widening may bring in, unless by sizes."""
        if margin == 0 or not _follows_beta(self.field, pair):
            return answered(self.field, pair, x)
        h, w = pair.beta.hw
        padded = pair.transform_beta(shift_matrix(-margin, -margin), (h + 2 * margin, w + 2 * margin))
        locations = answered(self.field, padded, x)
        if isinstance(locations, Segments):
            return Segments(locations.start - margin, locations.end - margin, locations.valid)
        return Positions(locations.xy - margin, locations.mask)

    def _band(self, p: Positions, hw: HW, across: Tensor) -> Positions:
        tangent = tangents(p)
        left = torch.stack([tangent[..., 1], -tangent[..., 0]], -1)
        rows = torch.linspace(1, -1, self.rows, dtype=p.xy.dtype, device=p.xy.device)
        steps = _between(across[..., :1], across[..., 1:], p.xy)[..., None] * left
        xy = p.xy[..., None, :, :] + rows[:, None, None] * steps[..., None, :, :]
        xy = xy.flatten(-3, -2)
        mask = within(xy, hw) & p.mask[..., None, :].expand(*p.mask.shape[:-1], len(rows), -1).flatten(-2, -1)
        return Positions(torch.where(mask[..., None], xy, 0.0), mask)


GRID = 12, 16
"""Rows and columns of alpha's pixels at which `Margins` are computed."""


class Margins(NamedTuple):
    """Half-widths for each pixel, interpolated between the nodes of a grid over alpha's image.

    Attributes:
        alpha: the camera to whose pixels the grid belongs.
        K: intrinsics of beta, of whose pixels the widths are.
        grid: half-widths (1, 4, rows, columns): across at the near and the far bound, then along at both.
        most: the largest of them, across and along.
    """

    alpha: Camera
    K: Float[Tensor, "3 3"]
    grid: Float[Tensor, "1 4 r c"]
    most: tuple[float, float]

    def at(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> Float[Tensor, "*n 4"]:
        """Return the half-widths at alpha's pixels (across near, far, along near, far), pixels of the pair's
        beta; outside the grid those at its border.

        Raises:
            ValueError: for a pair that is not calibrated.
        """
        view, beta = pair.cameras
        x = floating(x)
        centre, directions, _ = world_rays(view, x.to(view.K))
        there = self.alpha.project(centre + directions).x
        (h, w), (rows, columns) = self.alpha.hw, self.grid.shape[2:]
        cells = there * there.new_tensor([(columns - 1) / max(w - 1, 1), (rows - 1) / max(h - 1, 1)])
        widths = sample(self.grid.to(cells), cells.reshape(1, -1, 2), extended=True).values[0]
        scale = (beta.K[..., :2, :2].det().abs() / self.K[:2, :2].det().abs().to(beta.K)).sqrt()
        return (scale * widths.mT).reshape(*x.shape[:-1], 4).to(x)


def _between(first: Tensor, last: Tensor, like: Tensor) -> Tensor:
    """Values (*n, l) that lead evenly from first to last (*n, 1) over the positions (*n, l, 2)."""
    share = sample_fractions(like.shape[-2], like=like) if like.shape[-2] > 1 else like.new_zeros(1)
    return first + (last - first) * share


def _follows_beta(field: ReceptiveField, pair: Pair) -> bool:
    """Return True if the field of a padded beta is the same in its pixels: by F or calibration, not sizes."""
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
