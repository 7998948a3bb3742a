"""Where alpha's pixels are in beta: semi-global matching at half the size, then at full size over few labels around it.

At half the size an object's edge is some two pixels off and a slope is in steps. Here each pixel chooses, at full
size, between labels around the least and around the greatest disparity of its neighbourhood at half the size.
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from arraygeom import Segments
from arraygeom.threads import in_parallel

from ..media.colour import to_bytes
from ..support.memory import how_many_fit
from . import window_numba as kernels
from .colour_transfer import at_matches, box_mean
from .semi_global import (
    BLOCK,
    CONSISTENT,
    DISPARITY_FILL,
    FINE,
    Extent,
    HalfSizeMatches,
    Normalisation,
    Normalisations,
    filled,
    geometry_of,
    inner_and_outer,
    matched_at_half_size,
    numpy_of,
)
from .semi_global_numba import census

NEIGHBOURHOOD = 5
"""Side of the neighbourhood at half the size, pixels."""
PENALTIES = np.float32(20.0), np.float32(80.0)
"""Of labels that differ by one and by more; half the size, where a label is two pixels, has others."""
SAME = 0.7
"""Matches at half and at full size that are less than this many pixels apart are of the same surface."""
STEP_RADIUS, STEP_FLOOR, MOST_STEP = 3, 2e-5, 0.25
"""Window and regulariser (variance of brightness) of the step to a fraction of a pixel, and its most pixels."""
FLAT, LEAST_WEIGHT = 3e-6, 0.01
"""Slope of brightness (its square) along the segment at which a match weighs half in the smoothing of surfaces, and
what any consistent match weighs."""
SURFACE, PIXEL = (30.0, 4.0), 8.0
"""Strength of that smoothing, and the 8-bit difference that counts as an edge; how many such levels a pixel of
disparity counts. These, `PENALTIES`, `SAME` and `FLAT` are chosen on Middlebury's pairs of the tune half."""
MARGIN = 48
"""What is matched around a block, pixels."""
BLOCK_BYTES = 120.0 * (BLOCK + 2 * MARGIN) ** 2
"""What a block takes with its margin."""


@torch.no_grad()
def matched(
    alpha: Float[Tensor, "b 1 h w"],
    guide: Float[Tensor, "b 1 hb wb"],
    segments: Segments,
    blocks: Segments | None,
    normalisations: Normalisations,
    half: HalfSizeMatches | None = None,
) -> tuple[Float[Tensor, "b 1 h w"], Float[Tensor, "b 3 h2 w2"]]:
    """Agree on where the pixels of alpha are in beta, whose brightness is `guide`: `disparity` and `facts` of
    `SemiGlobalMatches`.

    `segments` (B or 1, H, W) are those of alpha's pixels and `blocks` (B or 1, H / 2, W / 2) those of the centres
    of its 2x2 pixels, in beta's pixels. All sides are even. `normalisations` are those of the whole images if these
    are parts, and `half` what is known of these parts from the whole images. On the CPU, with as many threads as torch
    may use; the same whatever their number.
    """
    if half is None:
        assert blocks is not None, "matching without blocks begins with matches at half the size"
        half = matched_at_half_size(alpha, guide, blocks, normalisations.half)
    rough, facts = half
    disparity, unlike = matched_at_full_size(alpha, guide, segments, rough, normalisations.whole)
    rough = interpolate(rough, scale_factor=FINE, mode="bilinear")
    disparity = precise(alpha, guide, segments, disparity, unlike, rough, normalisations.whole)
    return disparity, torch.cat([avg_pool2d(unlike, FINE), facts[:, 1:]], 1)


def matched_at_full_size(
    alpha: Float[Tensor, "b 1 h w"],
    guide: Float[Tensor, "b 1 hb wb"],
    segments: Segments,
    disparity: Float[Tensor, "b 1 h2 w2"],
    normalisation: Normalisation,
) -> tuple[Float[Tensor, "b 1 h w"], Float[Tensor, "b 1 h w"]]:
    """Disparity from that at half the size, and how far matching back from beta disagrees, 0 to 1.

    Where it disagrees, disparity is diffused from where it does not. `normalisation` is that of whole images.
    """
    own, other = normalisation.equally_sharp(alpha, normalisation.normalised(guide))
    geometry = geometry_of(segments, len(alpha), (guide.shape[-2], guide.shape[-1]), factor=1)
    planes = [numpy_of(x[:, 0]) for x in (own, other)]
    bits = [np.empty(x.shape, np.uint64) for x in planes]
    in_parallel([partial(census, p, o) for x, out in zip(planes, bits) for p, o in zip(x, out)])
    found, unlike = np.empty((2, *planes[0].shape), np.float32)
    tasks = []
    for i, half in enumerate(numpy_of(disparity[:, 0])):
        views = planes[0][i], bits[0][i], planes[1][i], bits[1][i], *(g[i] for g in geometry), *_runs(half)
        tasks += [partial(_block, views, box, found[i], unlike[i]) for box in inner_and_outer(found.shape[1:], MARGIN)]
    in_parallel(tasks, most=how_many_fit(BLOCK_BYTES))
    smooth = np.stack([_smoothed(*one) for one in zip(found, unlike, to_bytes(alpha[:, 0]))])
    return torch.from_numpy(smooth)[:, None].to(alpha), torch.from_numpy(unlike)[:, None].to(alpha)


def precise(
    alpha: Float[Tensor, "b 1 h w"],
    guide: Float[Tensor, "b 1 hb wb"],
    segments: Segments,
    disparity: Float[Tensor, "b 1 h w"],
    unlike: Float[Tensor, "b 1 h w"],
    rough: Float[Tensor, "b 1 h w"],
    normalisation: Normalisation,
) -> Float[Tensor, "b 1 h w"]:
    """Disparity to a fraction of a pixel: where that of half the size (`rough`) is near, the mean of both; from there
    a step of least squares of the brightness around each pixel (Lucas and Kanade 1981); and the result smoothed within
    surfaces, where brightness says little of the position more than elsewhere."""
    own, other = normalisation.equally_sharp(alpha, normalisation.normalised(guide))
    consistent = unlike < CONSISTENT
    near = consistent & ((disparity - rough).abs() < SAME)
    start = torch.where(near, (disparity + rough) / 2, disparity)
    across, down = (torch.gradient(other, dim=side)[0] for side in (3, 2))
    extent = Extent.of(segments)
    seen, across, down = at_matches(torch.cat([other, across, down], 1), segments, start, extent)[0].split(1, 1)
    towards = extent.towards.movedim(-1, 1).to(other)
    mean = partial(box_mean, radius=2 * STEP_RADIUS)
    rise, rest = across * towards[:, :1] + down * towards[:, 1:], own - seen
    rise, rest = rise - mean(rise), rest - mean(rest)
    common, slope = box_mean(torch.cat([rise * rest, rise.square()], 1), STEP_RADIUS).split(1, 1)
    step = (common / (slope + STEP_FLOOR)).clamp(-MOST_STEP, MOST_STEP)
    weight = torch.where(consistent, slope / (slope + FLAT) + LEAST_WEIGHT, 0.0) + 1e-5
    planes = zip(numpy_of(torch.where(near, start + step, start)), numpy_of(weight[:, 0]), to_bytes(alpha[:, 0]))
    smooth = np.stack([filled(d, w, _surfaces(d[0], brightness), SURFACE) for d, w, brightness in planes])
    return torch.from_numpy(smooth).to(disparity)


def _surfaces(disparity: NDArray[np.float32], brightness: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A guide (h, w, 3) whose edges are those of disparity and of brightness. Disparity as two triangular waves, one of
    which has a slope where the other turns: it may be larger than 8 bits hold."""
    levels = (disparity * PIXEL).astype(np.int32)
    waves = ((n ^ -(n >> 8 & 1)).astype(np.uint8) for n in (levels, levels + 128))
    return np.stack([brightness, *waves], -1)


def _runs(half: NDArray[np.float32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """First labels of both runs at full size, from disparity at half the size: around the least of its neighbourhood
    and around the greatest, or, where these are near each other, one beside the other."""
    window, run = np.ones((NEIGHBOURHOOD, NEIGHBOURHOOD), np.uint8), kernels.RUN
    low, high = (np.rint(_doubled(f(half, window))).astype(np.int32) - run // 2 for f in (cv2.erode, cv2.dilate))
    low = np.maximum(np.where(high < low + run, (low + high) // 2 - run // 2, low), 0)
    return low, np.maximum(high, low + run)


def _doubled(plane: NDArray) -> NDArray:
    return plane.repeat(FINE, 0).repeat(FINE, 1)


def _block(views: tuple, box: tuple, found: NDArray, unlike: NDArray) -> None:
    own, own_bits, other, other_bits, end, along, length, cut, low, high = views
    inner, outer = box
    planes = (own, own_bits, end, along, length, cut, low, high)
    a, a_bits, e, u, n, c, lo, hi = (np.ascontiguousarray(x[outer]) for x in planes)
    cost = np.empty((*a.shape, kernels.LANES), np.uint8)
    kernels.band_costs(a, a_bits, other, other_bits, e, u, n, c, lo, hi, cost)
    total = np.empty(cost.shape, np.float32)
    kernels.band_aggregate(cost, a, lo, hi, *PENALTIES, total)
    d, f = np.empty(a.shape, np.float32), np.empty(a.shape, np.float32)
    kernels.band_winners(total, total.view(np.int32), lo, hi, e, u, n, *other.shape, d, f)
    inside = tuple(slice(i.start - o.start, i.stop - o.start) for i, o in zip(inner, outer))
    found[inner], unlike[inner] = d[inside], f[inside]


def _smoothed(found: NDArray, unlike: NDArray, guide: NDArray) -> NDArray[np.float32]:
    consistent = (unlike < CONSISTENT).astype(np.float32)
    dense = filled(found[None], consistent + 1e-5, guide, DISPARITY_FILL)[0]
    return np.asarray(cv2.medianBlur(np.where(consistent > 0, found, dense), 5), np.float32)
