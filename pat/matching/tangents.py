"""Fields of explicit positions for networks that sample segments: their curves' tangents at a first match.

Where a pixel's positions follow each other along a curve they are labels like those of a segment: semi-global
matching at half the size finds one, among neighbours that agree. Positions without an order (a window, the
nearest pixels, all) have no neighbours to agree with: the best one of each pixel is taken alone. The line
through the match along the curve then is the pixel's search segment, in pixels of arc from its last position,
and all further steps are as for any segment.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import Positions, Segments, sample
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.fields.widened import direction
from arraygeom.pixels import HW, pixel_grid
from arraygeom.runtime.chunks import slices, spans, tiles_of
from arraygeom.runtime.warned import warn

from . import semi_global_numba as kernels
from .cost import planes_of
from .filters import filled, numpy_of
from .normalisation import Normalisation
from .positions import FINE
from .semi_global import DISPARITY_FILL, HALF_SIZE, flat

ORDERED = 0.95
"""Share of pixels whose steps from one position to the next hardly ever go back, from which positions are a
curve: those of a window and of a whole image go back at the end of each row."""
SEAM = 2
"""Number of times that positions of a curve go back: onto the other side of a whole sphere's image, and on
from there."""
LEAST_MARGIN = 0.02
"""Margin of a match to the second best, as of `BetaMatches.facts`, up to which it is filled from its
neighbours. *size*: later steps match again, around it."""
HALF_WINDOW = 8.0
"""Pixels to either side to which the segment of a match in a set of positions extends. *size*"""
AT_ONCE = 1 << 21
"""Number of positions that are evaluated at once."""


def along_tangents(
    alpha: Float[Tensor, "1 1 h w"], guide: Float[Tensor, "1 1 hb wb"], field: FieldOnGrid, name: str = "beta"
) -> FieldOnGrid:
    """Convert a field of positions to straight segments: the tangents of its curves at the matches.

    The positions are matched semi-globally at half the size. Which position is matched is a constant; its
    gradients are kept. Positions without an order along a curve are matched pixel by pixel, with a warning,
    and give horizontal segments around the match, without gradients.

    Args:
        alpha: image of even sides.
        guide: beta's brightness, of even sides.
        field: field of positions, of one rig, not a batch.
        name: beta's name in the warning.

    Returns:
        The field of segments, pixels of beta.

    Raises:
        TypeError: for a field that gives segments, for some pixels or all.
    """
    grid = _BlockCentres(field, (alpha.shape[-2] // FINE, alpha.shape[-1] // FINE))
    ordered = grid.ordered()
    if not ordered:
        warn(f"the field in '{name}' is a set of positions without an order: each pixel is matched alone")
    with torch.no_grad():
        labels = torch.from_numpy(_labels(alpha, guide, grid, ordered=ordered))
    lines = grid.tangents(labels) if ordered else grid.chosen(labels)
    longest = float(torch.where(lines.valid, lines.length.detach(), 0.0).max())
    planes = torch.cat([lines.start, lines.end], -1).movedim(-1, 0)[None]

    def at(x: Tensor) -> Segments:
        there = ((x + 0.5) / FINE - 0.5).to(planes)[None]
        ends = sample(planes, there, extended=True).values.mT
        valid = sample(lines.valid[None, None].to(planes), there, extended=True).values[:, 0] > 0.5
        return Segments(ends[..., :2], ends[..., 2:], valid)

    return FieldOnGrid.evaluated(at, (alpha.shape[-2], alpha.shape[-1]), int(np.ceil(longest)) + 1)


@dataclass(frozen=True)
class _BlockCentres:
    """Positions of the centres of alpha's blocks of two by two pixels, evaluated some rows at a time."""

    field: FieldOnGrid
    hw: HW

    def at(self, rows: slice, columns: slice) -> Positions:
        """Return the positions (h, w, L) of a part.

        Raises:
            TypeError: if the field gives segments there.
        """
        h, w = self.hw
        grid = (pixel_grid((h, w), dtype=torch.float64)[rows, columns] + 0.5) * FINE - 0.5
        locations = self.field.at(grid.reshape(-1, 2))
        if not isinstance(locations, Positions):
            raise TypeError("this field gives segments for some pixels, positions for others: give one kind")
        parts = (locations.xy, 2), (locations.mask, 1)
        return Positions(*(t.reshape(*grid.shape[:2], *t.shape[t.ndim - n :]) for t, n in parts))

    @property
    def rows(self) -> int:
        """Number of rows that are evaluated at once."""
        return max(1, AT_ONCE // (self.hw[1] * self.field.samples))

    def by_rows(self) -> list[slice]:
        """Return the rows that are evaluated at once, in turn."""
        return [slice(*span) for span in spans(self.hw[0], self.rows)]

    def ordered(self) -> bool:
        """Return True if positions follow each other along a curve, for most of every eighth row and column.

        False without three positions in turn that count. A curve may turn back a few times (`SEAM`).
        """
        locations = self.at(slice(None, None, 8), slice(None, None, 8))
        if locations.xy.shape[-2] < 3:
            return False
        steps = locations.xy.detach().diff(dim=-2)
        back = (steps[..., 1:, :] * steps[..., :-1, :]).sum(-1) < 0
        counts = locations.mask[..., 2:] & locations.mask[..., 1:-1] & locations.mask[..., :-2]
        some = counts.any(-1)
        return bool(some.any()) and float(((back & counts).sum(-1) <= SEAM)[some].double().mean()) >= ORDERED

    def tangents(self, labels: Tensor) -> Segments:
        """Return the lines through the labels' positions along the curves, as long as these."""
        parts = [_tangents(self.at(rows, slice(None)), labels[rows]) for rows in self.by_rows()]
        return Segments(*(torch.cat(tensors) for tensors in zip(*parts)))

    def chosen(self, labels: Tensor) -> Segments:
        """Return segments (h, w) along x around the positions of labels (h, w), smoothed by a median and
        detached."""
        parts = []
        for rows in self.by_rows():
            locations = self.at(rows, slice(None))
            index = labels[rows].long().to(locations.mask.device)[..., None]
            xy = locations.xy.gather(-2, index[..., None].expand(*index.shape, 2))[..., 0, :]
            parts.append((xy, locations.mask.gather(-1, index)[..., 0]))
        xy, valid = (torch.cat(tensors) for tensors in zip(*parts))
        smooth = [cv2.medianBlur(numpy_of(plane), 5) for plane in xy.unbind(-1)]
        middle = torch.from_numpy(np.stack(smooth, -1)).to(xy)
        step = middle.new_tensor([HALF_WINDOW, 0.0])
        return Segments(middle - step, middle + step, valid)


def _labels(alpha: Tensor, guide: Tensor, grid: _BlockCentres, *, ordered: bool) -> NDArray:
    """Compute the label of each block of alpha."""
    half_alpha, half_guide = avg_pool2d(alpha, FINE), avg_pool2d(guide, FINE)
    views = Normalisation.from_images(half_alpha, half_guide).views(half_alpha, half_guide)
    a, b = (numpy_of(p[0, 0]) for p in views[:2])
    planes, other_planes = planes_of(a), flat(planes_of(b))
    label, margin = np.zeros((2, *a.shape), np.float32)
    side, halo = (HALF_SIZE.block, HALF_SIZE.margin) if ordered else ((grid.rows, a.shape[1]), 0)
    for tile in tiles_of(a.shape, side, halo):
        inner, outer = map(slices, tile)
        places = _places(grid, outer, b.shape)
        lanes = -(-places.shape[-1] // kernels.LANES) * kernels.LANES
        cost = np.empty((*places.shape[:2], 1, lanes), np.uint8)
        parts = [np.ascontiguousarray(p[outer]) for p in planes]
        kernels.costs_at(flat(parts), other_planes, places, cost)
        total = cost.astype(np.int16)
        if ordered:
            first = np.zeros((*places.shape[:2], 1), np.int32)
            penalties = np.float32(HALF_SIZE.step), np.float32(HALF_SIZE.jump)
            kernels.aggregate(cost, parts[0], first, places.shape[-1], *penalties, total)
        corner = tuple(slice(i.start - o.start, i.stop - o.start) for i, o in zip(inner, outer))
        label[inner], margin[inner] = _best(total[corner][:, :, 0, : places.shape[-1]])
    if not ordered:
        return label
    scale = np.float32(8 * kernels.PARTS * HALF_SIZE.jump)
    weight = np.minimum(margin / scale, 1)
    dense = filled(label[None], weight + np.float32(1e-5), views.guides[0], DISPARITY_FILL)[0]
    return cv2.medianBlur(np.where(weight > LEAST_MARGIN, label, dense).astype(np.float32), 5)


def _places(grid: _BlockCentres, box: tuple[slice, ...], hw: tuple[int, ...]) -> NDArray[np.int32]:
    """Return positions in the reduced beta, pixels counted row by row; -1 for those that do not count."""
    (h, w), (rows, columns) = hw, box
    parts, at_once = [], max(1, AT_ONCE // (w * grid.field.samples))
    for top, bottom in spans(rows.stop - rows.start, at_once):
        locations = grid.at(slice(rows.start + top, rows.start + bottom), columns)
        x, y = ((locations.xy + 0.5) / FINE - 0.5).round().int().unbind(-1)
        inside = locations.mask & (x >= 0) & (y >= 0) & (x < w) & (y < h)
        parts.append(torch.where(inside, y * w + x, -1).int())
    return np.ascontiguousarray(torch.cat(parts).cpu().numpy())


def _best(total: NDArray[np.int16]) -> tuple[NDArray, NDArray]:
    """Return the label of the least sum, and its margin to the least of those not beside it."""
    best = total.argmin(-1)
    beside = np.abs(np.arange(total.shape[-1]) - best[..., None]) <= 1
    second = np.where(beside, np.iinfo(np.int16).max, total).min(-1).astype(np.float32)
    return best.astype(np.float32), second - total.min(-1)


def _tangents(positions: Positions, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return start, end and validity of the lines of a part."""
    xy, mask = positions.xy, positions.mask
    count, labels = mask.shape[-1], labels.to(mask.device)
    number = torch.arange(count, device=mask.device)
    nearest = torch.where(mask, (number - labels[..., None]).abs(), torch.inf).argmin(-1, keepdim=True)

    def taken(index: Tensor) -> Tensor:
        index = index.clamp(0, count - 1)
        counts = mask.gather(-1, index)
        index = torch.where(counts, index, nearest)
        return xy.gather(-2, index[..., None].expand(*index.shape, 2))[..., 0, :]

    here, before, after = (taken(nearest + step) for step in (0, -1, 1))
    step = (before - after) / 2
    towards = direction(step)
    both = mask[..., 1:] & mask[..., :-1]
    lengths = torch.where(both, xy.diff(dim=-2).square().sum(-1).clamp(min=1e-12).sqrt(), 0.0)
    fraction = (labels[..., None] - nearest).clamp(-0.5, 0.5).to(xy)
    beyond = (lengths * (number[:-1] >= nearest)).sum(-1)
    arc = (beyond - fraction[..., 0] * step.norm(dim=-1)).clamp(min=0)
    here = here - fraction * step
    end = here - arc[..., None] * towards
    start = end + lengths.sum(-1, keepdim=True) * towards
    return start, end, mask.any(-1)
