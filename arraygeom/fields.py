"""Receptive fields: where in beta to look for the point that an alpha pixel sees.

A field is anything that can be called with a `Pair` and alpha pixels x (*n, 2), and answers with `Segments` or
`Positions` over *n. The families here are frozen dataclasses; a plain function serves as well:

>>> def right_here(pair, x):  # the same pixel in beta, and nothing else
...     return Segments(x, x, torch.ones_like(x[..., 0], dtype=torch.bool))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from .epipolar import Track, clip_track, epipolar_lines, segments_between, track
from .homography import apply_homography
from .pixels import HW, pixel_grid, to_homogeneous
from .rig import Pair
from .segments import Positions, Segments

Look = Segments | Positions


@runtime_checkable
class ReceptiveField(Protocol):
    """Where to look in beta for each alpha pixel."""

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Look:
        """Segments or positions in beta's pixels, for alpha's pixels x. Differentiable in the pair's numbers."""
        ...


@dataclass(frozen=True)
class Epipolar:
    """The segment of the epipolar line between the pair's depth bounds; needs calibration.

    `near` and `far` (metres) override the pair's own.
    """

    near: float | None = None
    far: float | None = None

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments:
        """Segments from near to far, inside beta's picture and in front of it."""
        near, far = self.bounds(pair)
        return segments_between(pinhole_track(pair, x), near, far, pair.beta.hw)

    def bounds(self, pair: Pair) -> tuple[Tensor, Tensor]:
        """(near, far): this field's own where given, else the pair's."""
        own = [None if d is None else torch.tensor(d, dtype=torch.float64) for d in (self.near, self.far)]
        near, far = own if None not in own else [o if o is not None else d for o, d in zip(own, pair.depth_range)]
        assert near is not None
        assert far is not None
        return near, far


@dataclass(frozen=True)
class EpipolarLine:
    """The whole epipolar line inside beta; from calibration or F.

    With calibration, the part in front of both cameras, from depth zero to infinity; else all of it, from
    either end. Where an alpha pixel lies on the epipole there is no line, and the segment is invalid.
    """

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments:
        """Segments across beta's picture."""
        if pair.link is None and pair.calibrated:
            zero, infinite = (torch.tensor(d, dtype=torch.float64) for d in (NEAREST, torch.inf))
            return segments_between(pinhole_track(pair, x), zero, infinite, pair.beta.hw)
        line = epipolar_lines(pair.fundamental.to(x.dtype), x)
        h, w = pair.beta.hw
        middle = x.new_tensor([(w - 1) / 2, (h - 1) / 2]).expand_as(x)
        return line_piece(line, middle, x.new_tensor(float(h + w)), pair.beta.hw)


NEAREST = 1e-4
"""Where a line that has no near bound begins, metres from alpha."""


@dataclass(frozen=True)
class HomographyDisplacement:
    """The part of the epipolar line within +-`displacement` pixels of H x; from F and H, or from calibration.

    The paper's homography-based field. For a calibrated pair H is that of the plane at the middle of the depth
    range, and `displacement=None` takes the smallest that covers near to far at every pixel of `x`.
    """

    displacement: float | None = None

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments:
        """Segments centred on the point of the line nearest to H x, then clipped to beta's picture."""
        centre, placed = apply_homography(pair.homography.to(x.dtype), x)
        line = epipolar_lines(pair.fundamental.to(x.dtype), x)
        reach = x.new_tensor(self.displacement) if self.displacement is not None else covering_displacement(pair, x)
        piece = line_piece(line, torch.where(placed[..., None], centre, 0.0), reach, pair.beta.hw)
        return Segments(piece.start, piece.end, piece.valid & placed)


def covering_displacement(pair: Pair, x: Float[Tensor, "*n 2"]) -> Float[Tensor, ""]:
    """The displacement from H x that reaches both near and far for every pixel of x, pixels of beta.

    Of depth-bounded segments as beta's picture clips them. Raises ValueError for an uncalibrated pair.
    """
    exact = Epipolar()(pair, x)
    centre, placed = apply_homography(pair.homography.to(x.dtype), x)
    foot = foot_on_line(epipolar_lines(pair.fundamental.to(x.dtype), x), centre)
    reach = torch.maximum((exact.start - foot).norm(dim=-1), (exact.end - foot).norm(dim=-1))
    return torch.where(exact.valid & placed, reach, 0.0).max()


@dataclass(frozen=True)
class Rectified:
    """A horizontal run of up to `max_disparity` pixels of beta; from nothing but the two sizes (the PAM case).

    Alpha is the "left" or the "right" camera of a rectified pair ("either": the run goes both ways). Without
    `max_disparity`, the whole row.
    """

    max_disparity: float | None = None
    alpha_is: Literal["left", "right", "either"] = "left"

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments:
        """Segments from the largest disparity (near) to none (far)."""
        (ha, wa), (hb, wb) = pair.alpha.hw, pair.beta.hw
        column = (x[..., 0] + 0.5) * (wb / wa) - 0.5
        row = (x[..., 1] + 0.5) * (hb / ha) - 0.5
        near, far = self._run(column, wb)
        low, high = -0.5 if self.max_disparity is not None else 0.0, wb - 0.5
        overlaps = (torch.minimum(near, far) <= high) & (torch.maximum(near, far) >= low)
        start, end = (torch.stack([c.clamp(low, high), row], -1) for c in (near, far))
        return Segments(start, end, overlaps & (row >= -0.5) & (row <= hb - 0.5))

    def _run(self, column: Tensor, width: int) -> tuple[Tensor, Tensor]:
        if self.max_disparity is None:
            return torch.zeros_like(column), torch.full_like(column, width - 1)
        left, right = column - self.max_disparity, column + self.max_disparity
        return {"left": (left, column), "right": (right, column), "either": (left, right)}[self.alpha_is]


@dataclass(frozen=True)
class NearestVoxels:
    """The `count` integer pixels of beta nearest the epipolar line, within +-`window` of H x; from F.

    The paper's own construction. Distances are to the line; ties go to the smaller row, then column.
    """

    count: int = 96
    window: int = 80

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Positions:
        """Positions (*n, count, 2), in beta's pixels; where fewer lie on the picture the rest are masked."""
        line = epipolar_lines(pair.fundamental.to(x.dtype), x)
        centre, placed = apply_homography(pair.homography.to(x.dtype), x)
        candidates = self._candidates(line, torch.where(placed[..., None], centre, 0.0).round())
        inside = pair.beta.contains(candidates) & placed[..., None] & line.any(-1)[..., None]
        distance = (to_homogeneous(candidates) * line[..., None, :]).sum(-1).abs()
        distance = torch.where(inside, distance, torch.inf)
        nearest = distance.topk(min(self.count, distance.shape[-1]), largest=False, sorted=False).indices
        xy = candidates.gather(-2, nearest[..., None].expand(*nearest.shape, 2))
        mask = inside.gather(-1, nearest)
        return Positions(torch.where(mask[..., None], xy, 0.0), mask)

    def _candidates(self, line: Tensor, centre: Tensor) -> Tensor:
        """Integer pixels around the line in the window: in every column (or row, if steep) the nearest few."""
        steps = torch.arange(-self.window, self.window + 1, dtype=line.dtype, device=line.device)
        beside = 2 + self.count // len(steps)
        across = torch.arange(-beside, beside + 1, dtype=line.dtype, device=line.device)
        steep = line[..., 0].abs() > line[..., 1].abs()
        along_centre = torch.where(steep, centre[..., 1], centre[..., 0])[..., None] + steps
        slope, other = (torch.where(steep, line[..., i], line[..., j])[..., None] for i, j in ((1, 0), (0, 1)))
        safe = torch.where(other == 0, 1.0, other)
        on_line = -(slope * along_centre + line[..., 2:]) / safe
        v = on_line.round()[..., None] + across
        u = along_centre[..., None].expand_as(v)
        within = (v - torch.where(steep, centre[..., 0], centre[..., 1])[..., None, None]).abs() <= self.window
        v = torch.where(within, v, OUTSIDE)
        xy = torch.where(steep[..., None, None, None], torch.stack([v, u], -1), torch.stack([u, v], -1))
        return xy.flatten(-3, -2)


OUTSIDE = -1e6
"""A coordinate on no picture."""


@dataclass(frozen=True)
class Local:
    """A `size` x `size` window around H x; from H only (the CNN-like case)."""

    size: int = 5

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Positions:
        """Positions (*n, size^2, 2), row by row, on a grid of whole pixels' spacing centred on H x."""
        centre, placed = apply_homography(pair.homography.to(x.dtype), x)
        offsets = pixel_grid((self.size, self.size), dtype=x.dtype, device=x.device) - (self.size - 1) / 2
        xy = torch.where(placed[..., None], centre, 0.0)[..., None, :] + offsets.reshape(-1, 2)
        return Positions(xy, pair.beta.contains(xy) & placed[..., None])


@dataclass(frozen=True)
class Dense:
    """Every `stride`-th pixel of beta; from nothing (small pictures, and the unphysical control)."""

    stride: int = 1

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Positions:
        """Positions (*n, H W / stride^2, 2), the same for every alpha pixel."""
        grid = pixel_grid(pair.beta.hw, dtype=x.dtype, device=x.device)[:: self.stride, :: self.stride]
        xy = grid.reshape(-1, 2).expand(*x.shape[:-1], -1, 2)
        return Positions(xy, torch.ones_like(xy[..., 0], dtype=torch.bool))


def pinhole_track(pair: Pair, x: Float[Tensor, "*n 2"]) -> Track:
    """The track in beta of alpha's pixels. Raises ValueError unless both cameras are pinholes."""
    alpha, beta = pair.cameras
    if alpha.distortion is not None or beta.distortion is not None:
        raise ValueError("a straight field needs pinhole cameras: use Curved, or undistort the pictures first")
    return track(alpha.K, beta.K, pair.beta_from_alpha, x)


def foot_on_line(line: Float[Tensor, "*n 3"], point: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
    """The point of a line (scaled as `epipolar_lines` does) nearest to a point."""
    return point - (to_homogeneous(point) * line).sum(-1, keepdim=True) * line[..., :2]


def line_piece(line: Float[Tensor, "*n 3"], point: Float[Tensor, "*n 2"], reach: Float[Tensor, ""], hw: HW) -> Segments:
    """The piece of each line within `reach` of the foot of `point`, clipped to the picture; invalid without line."""
    foot = foot_on_line(line, point)
    along = torch.stack([line[..., 1], -line[..., 0]], -1)
    pieces = clip_track(Track(to_homogeneous(foot), torch.nn.functional.pad(along, (0, 1))), reach, -reach, hw)
    return Segments(pieces.start, pieces.end, pieces.valid & line.any(-1))


def look(field: ReceptiveField, pair: Pair, x: Float[Tensor, "*n 2"] | None = None) -> Look:
    """The field over given pixels, or over alpha's whole picture (H, W)."""
    return field(pair, pixel_grid(pair.alpha.hw) if x is None else x)


def lazily(field: ReceptiveField, pair: Pair) -> Callable[[Tensor], Look]:
    """The field as a function of alpha pixels alone, which attention calls chunk by chunk."""
    return lambda x: field(pair, x)
