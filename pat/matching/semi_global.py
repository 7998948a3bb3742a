"""Semi-global matching along the search segments, before attention samples around the matches.

Attention decides for each alpha pixel alone. Where a surface has little texture that is not enough: there,
semi-global matching (Hirschmüller 2008) prefers depths that change little from one pixel to the next. Its
labels are positions along each pixel's own segment, so it works for any rig with straight fields, rectified
or not: all labels of a segment at half the size, and at full size those of a window around these matches.
Without gradients.

Fields of explicit positions become fields of segments (`along_tangents`). Where a pixel's positions follow
each other along a curve they are labels like those of a segment. Positions without an order (a window, the
nearest pixels, all) have no neighbours to agree with: the best one of each pixel is taken alone. The line
through the match along the curve then is the pixel's search segment, in pixels of arc from its last position,
and all further steps are as for any segment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import NamedTuple

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
from arraygeom.runtime.chunks import Box, Tile, area, slices, spans, tiles_of
from arraygeom.runtime.threads import in_parallel
from arraygeom.runtime.warned import warn
from arraygeom.sampling import SLACK

from ..media.filters import filled, numpy_of
from ..support.memory import how_many_fit
from ..support.settings import size, tuned
from . import kernels
from .cost import planes_of
from .inputs import CONSISTENT, FINE, Extent
from .normalisation import ComparedViews, Normalisation


@dataclass(frozen=True)
class SemiGlobalSettings:
    """Settings of a run of semi-global matching; penalties are in the unit of `cost`.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    step: float = tuned(12.0, "Middlebury, tune half: penalty of neighbours' labels that differ by one")
    jump: float = tuned(100.0, "Middlebury, tune half: of those that differ by more, where alpha has no edge")
    margin: int = size(64, "What is matched around a block, pixels")
    block: int = size(320, "Sides of a block, pixels")
    long_block: int = size(640, "The longer side of the blocks of large images, along the segments")
    most_costs: int = size(2**25, "Costs up to which a block is as high as the image, which saves margins")
    pixel_bytes: int = size(128, "What a block takes for each pixel")
    label_bytes: int = size(3, "What it takes for each label of each pixel: cost, and sum of costs")
    fill: tuple[float, float] = tuned(
        (50.0, 4.0),
        "Middlebury, tune half: strength, and 8-bit difference of an edge, of smoothing (Min et al. 2014)",
    )


HALF_SIZE = SemiGlobalSettings()
DISPARITY_FILL = HALF_SIZE.fill


class HalfSizeMatches(NamedTuple):
    """Matches of alpha's pixels at half the size.

    Attributes:
        disparity: distance of the match from the segment's end (B, 1, H / 2, W / 2), pixels of the full-size
            beta.
        facts: left-right error (1 for 8 pixels of half the size), margin and cost (B, 3, H / 2, W / 2), each
            0 to 1, as in `BetaMatches`.
    """

    disparity: Tensor
    facts: Tensor

    def cut(self, box: Box) -> HalfSizeMatches:
        """Return the part at alpha's (top, bottom, left, right), all even."""
        half = (..., *slices([n // FINE for n in box]))
        return HalfSizeMatches(*(plane[half] for plane in self))


class Windows(NamedTuple):
    """Labels (positions along its segment) to compare at each pixel: one or two runs of consecutive ones.

    Runs do not overlap.

    Attributes:
        first: first labels (B, h, w, runs), int32; label l is l pixels from the segment's end.
        labels: labels per run; at most 5 if there are two runs.
    """

    first: NDArray[np.int32]
    labels: int

    @classmethod
    def all(cls, geometry: _Geometry) -> Windows:
        """Return all labels of the longest segment, and one more."""
        first = np.broadcast_to(np.int32(0), (*geometry.length.shape, 1))
        return cls(first, int(max(geometry.length.max(), 0)) + 2)

    @property
    def lanes(self) -> tuple[int, int]:
        """Number of runs, and number of lanes in which each is computed."""
        runs = self.first.shape[-1]
        return runs, kernels.NARROW if runs == 2 else -(-self.labels // kernels.LANES) * kernels.LANES


class _Geometry(NamedTuple):
    """Segments in the form of the kernels, in pixels of the reduced beta: (B, h, w, ...), float32.

    `cut` is 1 where a segment may go on beyond beta's edge.
    """

    end: NDArray[np.float32]
    along: NDArray[np.float32]
    length: NDArray[np.float32]
    cut: NDArray[np.float32]


def matched_at_half_size(views: ComparedViews, blocks: Segments) -> HalfSizeMatches:
    """Match views semi-globally at half the size.

    Args:
        views: alpha and beta at half the size, equally bright and sharp.
        blocks: segments of alpha's pixels at half the size, in pixels of the full-size beta.

    Returns:
        The matches, detached.
    """
    alpha, beta = views.alpha, views.beta
    geometry = geometry_of(blocks, len(alpha), (FINE * beta.shape[-2], FINE * beta.shape[-1]))
    del blocks
    disparity, facts = matched_by_labels(views, geometry, Windows.all(geometry), HALF_SIZE)
    return HalfSizeMatches(FINE * disparity[:, None].to(alpha), facts.movedim(-1, 1).to(alpha))


def geometry_of(segments: Segments, batch: int, hw: tuple[int, int], factor: int = FINE) -> _Geometry:
    """Convert segments to pixels of a beta `factor` times smaller, for the kernels.

    An invalid segment's length is negative: it has no pixel. Segments that start beyond the centres of beta's
    outermost pixels may have been cut there.

    Args:
        segments: segments (1 or batch, h, w).
        batch: number of images.
        hw: height and width of the beta in pixels of the segments.
        factor: whole number by which beta is reduced.

    Returns:
        Arrays (batch, h, w, ...), float32: ends, unit vectors from end to start, lengths, and 1 where the
        start may have been cut.
    """
    length, towards = Extent.from_segments(segments)
    last = segments.start.new_tensor([hw[1] - 1, hw[0] - 1])
    at_edge = (segments.start < -SLACK) | (segments.start > last + SLACK)
    cut = segments.valid & at_edge.any(-1)
    end = (segments.end + 0.5) / factor - 0.5
    length = torch.where(segments.valid, length / factor, -1.0)
    planes = (numpy_of(x.expand(batch, *x.shape[1:])) for x in (end, towards, length, cut))
    return _Geometry(*planes)


def matched_by_labels(
    views: ComparedViews,
    geometry: _Geometry,
    windows: Windows,
    settings: SemiGlobalSettings,
    facts: int = 3,
) -> tuple[Float[Tensor, "b h w"], Float[Tensor, "b h w facts"]]:
    """Match views semi-globally over the labels in each pixel's window.

    Where matching back from beta disagrees, disparity is diffused from where it agrees, within connected
    regions of alpha; then it is smoothed by a median.

    Args:
        views: alpha and beta, equally bright and sharp.
        geometry: segments in pixels of that beta (`geometry_of`).
        windows: labels to compare at each pixel.
        settings: settings of the run.
        facts: number of statistics to compute: 1 (left-right error), or 3 (margin and cost too).

    Returns:
        Disparity, pixels of the beta given, from the segments' ends; and the statistics in the last axis, 0
        to 1, as in `BetaMatches`. Both are float32, on the CPU, detached.
    """
    alpha, beta = (numpy_of(image[:, 0]) for image in (views.alpha, views.beta))
    disparity, measured = _matched_blocks(alpha, beta, geometry, windows, settings, facts)
    consistent = (measured[..., 0] < CONSISTENT).astype(np.float32)
    smooth = []
    for d, c, guide in zip(disparity, consistent, views.guides):
        dense = filled(d[None], c + 1e-5, guide, settings.fill)[0]
        smooth.append(cv2.medianBlur(np.where(c > 0, d, dense), 5))
    return torch.from_numpy(np.stack(smooth)), torch.from_numpy(measured)


class _Image(NamedTuple):
    """Inputs and outputs of the blocks of one image.

    `views` are planes of alpha's size: brightness, first labels, geometry, and the planes of `cost`; `other`
    are the flat planes with which it compares them, of a beta of `hw`. `results`: disparity, facts, and
    pixels of beta. `claims` are tables of `winners`.
    """

    views: tuple[NDArray, ...]
    other: tuple[NDArray, ...]
    hw: tuple[int, int]
    results: tuple[NDArray, ...]
    claims: list[NDArray[np.int32]]


def _matched_blocks(
    alpha: NDArray,
    beta: NDArray,
    geometry: _Geometry,
    windows: Windows,
    settings: SemiGlobalSettings,
    facts: int,
) -> tuple[NDArray, NDArray]:
    """Return disparity (B, h, w) in pixels of the beta given, and so many facts (B, h, w, facts)."""
    (_, *hw), (_, rows, columns) = alpha.shape, beta.shape
    disparity, place = np.empty(alpha.shape, np.float32), np.empty(alpha.shape, np.int32)
    measured = np.empty((*alpha.shape, facts), np.float32)
    planes = in_parallel([partial(planes_of, image) for image in (*alpha, *beta)])
    images, tasks, nbytes = [], [], 1.0
    for i, (mine, its) in enumerate(zip(planes[: len(alpha)], planes[len(alpha) :])):
        views = alpha[i], windows.first[i], *(g[i] for g in geometry), *mine
        images.append(_Image(views, _flat(its), (rows, columns), (disparity[i], measured[i], place[i]), []))
        boxes = _boxes(hw, geometry.along[i], windows.first.shape[-1] * windows.labels, settings)
        tasks += [partial(_block, images[-1], box, windows, settings) for box in boxes]
        for_each = settings.pixel_bytes + settings.label_bytes * math.prod(windows.lanes)
        nbytes = max(nbytes, for_each * max(area(box.outer) for box in boxes))
    in_parallel(tasks, most=how_many_fit(nbytes))
    for image, fact, its in zip(images, measured[..., 0], place):
        label = (reduce(np.minimum, image.claims)[its] & 0xFFFF).astype(np.float32)
        apart = np.minimum(np.abs(label - fact) / kernels.FARTHEST, 1)
        fact[:] = np.where(its < rows * columns, apart, 1)
    return disparity, measured


def _flat(planes: Sequence[NDArray]) -> tuple[NDArray, ...]:
    """Return planes (h, w, ...) as lists of pixels."""
    return tuple(plane.reshape(-1, *plane.shape[2:]) for plane in planes)


def _boxes(hw: Sequence[int], along: NDArray, labels: int, settings: SemiGlobalSettings) -> list[Tile]:
    """Return blocks with margins: as high as an image with few costs, else longer along the segments."""
    side, margin = settings.block, settings.margin
    if hw[0] * (side + 2 * margin) * labels <= settings.most_costs:
        return list(tiles_of(hw, (hw[0], side), margin))
    across, down = np.abs(along).max((0, 1))
    sides = (side, settings.long_block) if across > down else (settings.long_block, side)
    return list(tiles_of(hw, sides, margin))


def _block(image: _Image, box: Tile, windows: Windows, settings: SemiGlobalSettings) -> None:
    """Match a block and write its results.

    The claims of its pixels on beta go into one of the tables, each of which is used by one thread at a time;
    the least of them is the claim of all.
    """
    inner, outer = map(slices, box)
    guide, first, end, along, length, cut, *alpha_planes = (
        np.ascontiguousarray(x[outer]) for x in image.views
    )
    labels, segments = (first, windows.labels), (end, along, length, cut)
    cost = np.empty((*length.shape, *windows.lanes), np.uint8)
    kernels.costs(_flat(alpha_planes), image.other, *labels, *segments, *image.hw, cost)
    total = np.empty(cost.shape, np.int16)
    step, jump = np.float32(settings.step), np.float32(settings.jump)
    kernels.aggregate(cost, guide, *labels, step, jump, total)
    try:
        claims = image.claims.pop()
    except IndexError:
        claims = np.full(math.prod(image.hw) + 1, 2**31 - 1, np.int32)
    parts = tuple(np.ascontiguousarray(plane[inner]) for plane in image.results)
    corner = inner[0].start - outer[0].start, inner[1].start - outer[1].start
    kernels.winners(total, *labels, segments, image.hw, corner, jump, claims, parts)
    image.claims.append(claims)
    for plane, result in zip(image.results, parts):
        plane[inner] = result


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
    planes, other_planes = planes_of(a), _flat(planes_of(b))
    label, margin = np.zeros((2, *a.shape), np.float32)
    side, halo = (HALF_SIZE.block, HALF_SIZE.margin) if ordered else ((grid.rows, a.shape[1]), 0)
    for tile in tiles_of(a.shape, side, halo):
        inner, outer = map(slices, tile)
        places = _places(grid, outer, b.shape)
        lanes = -(-places.shape[-1] // kernels.LANES) * kernels.LANES
        cost = np.empty((*places.shape[:2], 1, lanes), np.uint8)
        parts = [np.ascontiguousarray(p[outer]) for p in planes]
        kernels.costs_at(_flat(parts), other_planes, places, cost)
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
