"""Semi-global matching along the search segments, before attention samples around the matches.

Attention decides for each alpha pixel alone. Where a surface has little texture that is not enough: there,
semi-global matching (Hirschmüller 2008) asks for depths that change little from one pixel to the next. Its labels
are positions along each pixel's own segment, so it works for any rig with straight fields, rectified or not. Here it
is computed on images of half the size; `matching` goes on from there to the full size. Without gradients.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from arraygeom import Segments
from arraygeom.chunks import Box
from arraygeom.fields.protocol import compilable
from arraygeom.sampling import on_image
from arraygeom.threads import in_parallel

from ..media.colour import to_bytes
from ..support.memory import how_many_fit
from . import semi_global_numba as kernels
from .normalisation import Normalisation, Normalisations, blurred, equalising_blurs  # noqa: F401

FINE = 2
"""Matching is done on images this many times smaller."""
BLOCK = 320
"""Sides of what is processed at a time, in pixels of the reduced images."""
LONG_BLOCK = 640
"""The longer side of the blocks of large images, along the segments."""
MARGIN = 64
"""What is matched around a block."""
PIXEL_BYTES, LABEL_BYTES = 128, 3
"""What a block takes for each pixel, and for each label of each pixel: cost, and sum of costs."""
MOST_COSTS = 2**25
"""Costs up to which a block is as high as the image: without margins above and below there is less to compute."""
CONSISTENT = 0.2
"""A match is consistent if matching back from beta ends less than this (times 8 pixels) from it."""
DISPARITY_FILL = (50.0, 4.0)
"""Strength, and 8-bit difference that counts as an edge, of the smoothing that fills (Min et al. 2014)."""


class SemiGlobalMatches(NamedTuple):
    """The matches of images of H x W.

    disparity: (B, 1, H, W), how far from its segment's end the match is, pixels of beta; where the match is not
        consistent, diffused from where it is.
    facts: (B, 3, H / 2, W / 2), how far matching back from beta disagrees, by how much the match is better than
        others, and its cost; each 0 to 1.
    matched: (B, C, H, W), beta's bands minus alpha at the match, with the detail that alpha has and beta has not.
    colour: (B, fills, C, H, W), the same diffused from pixels of high weight to the others.
    """

    disparity: Tensor
    facts: Tensor
    matched: Tensor
    colour: Tensor

    def cut(self, box: Box) -> SemiGlobalMatches:
        """The part at alpha's (top, bottom, left, right), all even."""
        top, bottom, left, right = box
        half = (..., slice(top // FINE, bottom // FINE), slice(left // FINE, right // FINE))
        whole = (..., slice(top, bottom), slice(left, right))
        return SemiGlobalMatches(self.disparity[whole], self.facts[half], self.matched[whole], self.colour[whole])

    def stored(self) -> SemiGlobalMatches:
        """The same with colours as float16; differences from alpha are rounded by 1e-4 at most."""
        return self._replace(matched=self.matched.half(), colour=self.colour.half())


class HalfSizeMatches(NamedTuple):
    """Matches at half the size: `disparity` (B, 1, H / 2, W / 2) in pixels of beta; facts as of `SemiGlobalMatches`."""

    disparity: Tensor
    facts: Tensor

    def cut(self, box: Box) -> HalfSizeMatches:
        """The part at alpha's (top, bottom, left, right), all even."""
        top, bottom, left, right = (n // FINE for n in box)
        return HalfSizeMatches(*(part[..., top:bottom, left:right] for part in self))


class _Geometry(NamedTuple):
    """Segments as the kernels want them, in pixels of the reduced beta: (B, h, w, ...), float32.

    `cut` is 1 where a segment may go on beyond beta's edge.
    """

    end: NDArray[np.float32]
    along: NDArray[np.float32]
    length: NDArray[np.float32]
    cut: NDArray[np.float32]


def matched_at_half_size(
    alpha: Float[Tensor, "b 1 h w"], guide: Float[Tensor, "b 1 hb wb"], blocks: Segments, normalisation: Normalisation
) -> HalfSizeMatches:
    """Matches of images at half the size; `normalisation` is that of half the size."""
    own, other = avg_pool2d(alpha, FINE), avg_pool2d(guide, FINE)
    own, other = normalisation.equally_sharp(own, normalisation.normalised(other))
    geometry = geometry_of(blocks, len(alpha), (guide.shape[-2], guide.shape[-1]))
    del guide, blocks
    found, measured = _matched_blocks(numpy_of(own[:, 0]), numpy_of(other[:, 0]), geometry)
    consistent = (measured[..., 0] < CONSISTENT).astype(np.float32)
    planes = zip(found, consistent, to_bytes(avg_pool2d(alpha, FINE)[:, 0]))
    dense = np.stack([filled(r[None], c + 1e-5, g, DISPARITY_FILL)[0] for r, c, g in planes])
    smooth = np.stack([cv2.medianBlur(r, 5) for r in np.where(consistent > 0, found, dense)])
    disparity = FINE * torch.from_numpy(smooth)[:, None].to(alpha)
    return HalfSizeMatches(disparity, torch.from_numpy(measured).movedim(-1, 1).to(alpha))


def geometry_of(segments: Segments, batch: int, hw: tuple[int, int], factor: int = FINE) -> _Geometry:
    """In pixels of a beta that is so many times smaller. An invalid segment's length is negative: it has no pixel.

    Segments that start within a pixel of beta's edge may have been cut there.
    """
    length = length_of(segments)
    cut = segments.valid & ~on_image(segments.start - 0.5, (hw[0] - 1, hw[1] - 1))
    end, towards = (segments.end + 0.5) / factor - 0.5, along(segments, length)
    length = torch.where(segments.valid, length / factor, -1.0)
    planes = (numpy_of(x.expand(batch, *x.shape[1:])) for x in (end, towards, length, cut))
    return _Geometry(*planes)


def _matched_blocks(own: NDArray, other: NDArray, geometry: _Geometry) -> tuple[NDArray, NDArray]:
    """Reach (B, h, w) in pixels of the reduced beta, and facts (B, h, w, 3)."""
    labels = int(max(geometry.length.max(), 0)) + 2
    disparity = np.zeros(own.shape, np.float32)
    facts = np.ones((*own.shape, 3), np.float32)
    bits = [np.empty(x.shape, np.uint64) for x in (own, other)]
    in_parallel([partial(kernels.census, p, o) for x, out in zip((own, other), bits) for p, o in zip(x, out)])
    tasks, nbytes = [], 1.0
    label, place = np.empty((2, *own.shape), np.int32)
    claims: list[list[NDArray[np.int32]]] = [[] for _ in own]
    for i, (a, b) in enumerate(zip(own, other)):
        views = a, bits[0][i], b, bits[1][i], *(g[i] for g in geometry)
        small = a.shape[0] * (BLOCK + 2 * MARGIN) * labels <= MOST_COSTS
        across = np.abs(geometry.along[i]).max((0, 1))
        large = (BLOCK, LONG_BLOCK) if across[0] > across[1] else (LONG_BLOCK, BLOCK)
        boxes = list(inner_and_outer(a.shape, MARGIN, *((a.shape[0], BLOCK) if small else large)))
        found = disparity[i], facts[i], label[i], place[i]
        tasks += [partial(_block, views, box, labels, claims[i], found) for box in boxes]
        largest = max(_pixels_in(outer, a.shape) for _, outer in boxes)
        nbytes = max(nbytes, largest * (PIXEL_BYTES + LABEL_BYTES * labels))
    in_parallel(tasks, most=how_many_fit(nbytes))
    for unlike, tables, own_label, its in zip(facts[..., 0], claims, label, place):
        claimed = np.minimum.reduce(tables)[its] & 0xFFFF
        apart = np.abs(claimed - own_label) / kernels.FARTHEST
        np.minimum(apart, 1, out=unlike, where=its < other[0].size)
    return disparity, facts


def _pixels_in(box: tuple[slice, slice], hw: tuple[int, ...]) -> int:
    return math.prod(min(s.stop, n) - s.start for s, n in zip(box, hw))


def inner_and_outer(
    hw: tuple[int, ...], margin: int, rows: int = BLOCK, columns: int = BLOCK
) -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Inner and outer blocks of so many rows and columns: the result, and what is computed for it."""
    for top in range(0, hw[0], rows):
        for left in range(0, hw[1], columns):
            inner = slice(top, min(top + rows, hw[0])), slice(left, min(left + columns, hw[1]))
            yield inner, tuple(slice(max(s.start - margin, 0), s.stop + margin) for s in inner)


def _block(views: tuple, box: tuple, labels: int, claims: list[NDArray[np.int32]], found: Sequence[NDArray]) -> None:
    """What is found of a block. What its pixels claim of beta goes into one of the tables, of which each is of one
    thread at a time; what all claim is the least of them."""
    own, own_bits, other, other_bits, end, along, length, cut = views
    inner, outer = box
    planes = (own, own_bits, end, along, length, cut)
    a, a_bits, e, u, n, c = (np.ascontiguousarray(x[outer]) for x in planes)
    cost = np.empty((*a.shape, labels), np.uint8)
    kernels.costs(a, a_bits, other, other_bits, e, u, n, c, cost)
    total = np.empty(cost.shape, np.int16)
    kernels.aggregate(cost, a, total)
    try:
        table = claims.pop()
    except IndexError:
        table = np.full(other.size + 1, 2**31 - 1, np.int32)
    parts = [np.ascontiguousarray(plane[inner]) for plane in found]
    corner = (i.start - o.start for i, o in zip(inner, outer))
    kernels.winners(total, e, u, n, c, *other.shape, *corner, table, *parts)
    claims.append(table)
    for plane, part in zip(found, parts):
        plane[inner] = part


def matches(
    segments: Segments,
    disparity: Float[Tensor, "b 1 _ _"],
    *,
    beyond_edge: bool = False,
    extent: Extent | None = None,
) -> Float[Tensor, "b h w 2"]:
    """Where the alpha pixels of segments (B or 1, H, W) have their matches `disparity` from the ends, beta's pixels.

    Disparity may be at half the size. Not beyond the segments' near ends, unless `beyond_edge`. `extent` is the
    segments', if it is known.
    """
    length, towards = extent or Extent.of(segments)
    if disparity.shape[-2:] != length.shape[-2:]:
        disparity = interpolate(disparity, scale_factor=FINE, mode="bilinear")
    far = disparity[:, 0].to(length).clamp(min=0)
    return segments.end + (far if beyond_edge else far.minimum(length))[..., None] * towards


class Extent(NamedTuple):
    r"""Lengths of segments (\*n), and unit vectors from end to start (\*n, 2)."""

    length: Tensor
    towards: Tensor

    @classmethod
    def of(cls, segments: Segments) -> Extent:
        """That of segments."""
        length = length_of(segments)
        return cls(length, along(segments, length))


def length_of(segments: Segments) -> Float[Tensor, "*n"]:
    """The segments' lengths in pixels; of plain numbers in half the time of `Segments.length`, which is the same."""
    step = segments.end - segments.start
    if step.requires_grad or not compilable(step):
        return segments.length
    x, y = step.unbind(-1)
    return (x * x).add_(y * y).sqrt_()


def along(segments: Segments, length: Tensor | None = None) -> Float[Tensor, "*n 2"]:
    """Unit vectors from end to start; zero where a segment is a point. `length` is the segments', if it is known."""
    length = length_of(segments) if length is None else length
    step, divisor = segments.start - segments.end, torch.where(length > 0, length, 1.0)
    if step.requires_grad or not compilable(step):
        return step / divisor[..., None]
    for part in step.unbind(-1):
        part.div_(divisor)
    return step


def reduced(segments: Segments, factor: int) -> Segments:
    """The same segments in pixels of a beta that is `factor` times smaller."""
    start, end = ((x + 0.5) / factor - 0.5 for x in (segments.start, segments.end))
    return Segments(start, end, segments.valid)


def enlarged(x: Tensor) -> Tensor:
    """From half the size, each value four times."""
    return x.repeat_interleave(FINE, -1).repeat_interleave(FINE, -2)


def filled(planes: NDArray, weight: NDArray, guide: NDArray, how: tuple[float, float]) -> NDArray:
    """The weighted mean of planes (c, h, w) over what is connected in the guide. Weights are positive."""

    total, *sums = smoothed([weight, *(plane * weight for plane in planes)], guide, how)
    return np.stack([plane / total for plane in sums])


def smoothed(planes: Sequence[NDArray], guide: NDArray[np.uint8], how: tuple[float, float]) -> list[NDArray]:
    """Planes smoothed where the guide shows no edge. One after the other: the smoother is not for several threads, but
    has its own."""
    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, *how)
    return [smoother.filter(np.ascontiguousarray(plane, np.float32)) for plane in planes]


def numpy_of(x: Tensor) -> NDArray[np.float32]:
    """A float32 copy on the CPU, in one piece."""
    return np.ascontiguousarray(x.detach().cpu().numpy(), np.float32)
