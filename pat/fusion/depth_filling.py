"""Depth beyond single matches: planes where these are uncertain, and medians against outliers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom.runtime.chunks import chunked

from ..matching.inputs import FINE
from ..matching.subpixel import Plane, Planes, repeated
from ..media.filters import nearest_known, numpy_of
from ..support.settings import physics, size, tuned
from .frame import Frame
from .inputs import FrameInputs, Placement


@dataclass(frozen=True)
class FillSettings:
    """Settings of filling in the depth of pixels whose own match has little confidence.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    share: float = tuned(
        0.4,
        "Middlebury, tune half, of .2 to .7: share of the confidence around, below which a plane is taken",
    )
    reach: float = size(
        80.0,
        "Pixels to which matches count where alpha is even and depth has no step. "
        "A change of alpha from black to white is as far. Half or twice as much does as well",
    )
    step: float = size(
        2.0,
        "Change of inverse depth that is as far as `reach` when planes "
        "are first fitted, in half-widths of its interval: its width; half or twice as much does as well",
    )
    one_side: float = physics(
        0.9, "Length of the segments' sum over the sum of their lengths, from which betas are on one side"
    )


SETTINGS = FillSettings()
ROWS, HALO = 512, 128
"""Size: rows of a part, and rows beside it that its planes see: matches there count a sixth of
those nearby."""


def final_depth(frame: Frame, frame_inputs: FrameInputs) -> Float[Tensor, "h w"]:
    """Compute the depth that a frame's result has: filled by planes, and without outliers.

    Returns:
        Depth (H, W), NaN where it was unknown; the frame's own where segments were around a known depth.
    """
    if any(beta.around for beta in frame_inputs.inputs.betas):
        return frame.depth
    return without_outliers(background_filled(frame, frame_inputs))


def without_outliers(depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Replace each known depth by the median of 5 x 5 pixels, of inverse depth.

    Unknown depth (NaN) counts as far away; where that is the median, a pixel keeps its own. Gradients are
    those of the pixel's own inverse depth.

    Returns:
        Depth (H, W), in the same unit, NaN where it was unknown.
    """
    inverse = 1 / depth
    median = torch.from_numpy(cv2.medianBlur(np.nan_to_num(numpy_of(inverse)), 5)).to(depth)
    changed = depth.isfinite() & (median > 0)
    following = torch.where(changed, median + (inverse - inverse.detach()), 1.0)
    return torch.where(changed, 1 / following, depth)


def background_filled(frame: Frame, frame_inputs: FrameInputs) -> Float[Tensor, "h w"]:
    """Replace depth of far less confidence than around it by that of a plane through the background.

    A point that a beta does not see is occluded: farther away than its neighbours along the segments' rows or
    columns. Planes of inverse depth are fitted to matches weighted by confidence; a point beyond an edge of
    alpha or a step of depth is far away (Gastal and Oliveira, Domain transform, 2011). Planes end at the
    bounds that were searched. No gradient passes through planes.

    Returns:
        Depth (H, W), in the rig's unit, NaN where it was unknown; the frame's own if betas on several sides
        see occluded points, for fields of positions, and without any known depth or its half-width.
    """
    depth, confidence, inputs = frame.depth, frame.confidence, frame_inputs.inputs
    steps = [beta.field.pixels for beta in inputs.betas if beta.field.pixels is not None]
    if not steps:
        return depth
    every = (..., slice(None, None, 4), slice(None, None, 4), slice(None))
    apart = torch.stack([(segments.end[every] - segments.start[every]).mean((0, 1, 2)) for segments in steps])
    if apart.sum(0).norm() < SETTINGS.one_side * apart.norm(dim=1).sum():
        return depth
    has_depth = depth.isfinite() & (confidence > 0)
    if not bool(has_depth.any()):
        return depth
    confidence, half_width = confidence.detach(), frame.half_width.detach()
    least = SETTINGS.share * float(confidence[has_depth].mean())
    unit = float(half_width[has_depth & (confidence >= least)].nanmedian())
    if not unit > 0:
        return depth
    farthest, nearest = (inverse / unit for inverse in _searched(frame_inputs.placements))
    fill = partial(_filled_rows, least=least, unit=unit, bounds=(farthest, nearest))
    planes = depth, confidence, inputs.alpha[0, 0, : depth.shape[0], : depth.shape[1]]
    if apart.sum(0).abs().argmax() == 1:
        return chunked(fill, *(plane.mT for plane in planes), rows=ROWS, halo=HALO).mT
    return chunked(fill, *planes, rows=ROWS, halo=HALO)


def _searched(placements: Sequence[Placement]) -> tuple[float, float]:
    """Return the least and the greatest inverse depth that was searched; any where not stated."""
    stated = [place.pair.depth for place in placements if place.pair.calibrated]
    ranges = [(float(far), float(near)) for near, far in filter(None, stated)]
    if not ranges or len(ranges) < len(stated):
        return 0.0, math.inf
    far, near = zip(*ranges)
    return 1 / max(far), 1 / min(near)


def _filled_rows(
    depth: Float[Tensor, "h w"],
    confidence: Float[Tensor, "h w"],
    alpha: Float[Tensor, "h w"],
    least: float,
    unit: float,
    bounds: tuple[float, float],
) -> Float[Tensor, "h w"]:
    """Compute depth by matches and planes, these for every second pixel, in units of inverse depth.

    `least` is the confidence from which matches count before any plane is known; `bounds` are planes', in
    these units.
    """
    (h, w), has_depth = depth.shape, depth.isfinite()
    inverse = torch.where(has_depth, 1 / depth.detach(), 0.0) / unit
    certain = torch.where(has_depth, confidence, 0.0)
    kept = certain >= least
    filled = torch.where(kept, inverse, _background(inverse, kept))
    for apart in (_far_by_depth, _far_by_slope):
        whole = inverse, torch.where(kept, certain, 0.0), alpha, filled
        matched, weight, grey, guess = (numpy_of(t[::FINE, ::FINE]) for t in whole)
        planes = Planes.through(matched, weight, np.stack([grey, *apart(guess)], -1), SETTINGS.reach)
        per_pixel = planes.at_pixels((h, w)), repeated(planes.around, (h, w))
        value, around = (torch.from_numpy(t).to(inverse) for t in per_pixel)
        kept = certain >= SETTINGS.share * around
        filled = torch.where(kept, inverse, value.clamp(*bounds))
    changed = has_depth & ~kept & (filled > 0)
    return torch.where(changed, 1 / torch.where(changed, filled * unit, 1.0), depth)


def _far_by_depth(inverse: Plane) -> list[Plane]:
    """Return a guide whose changes of 1 are steps of depth: points beyond them do not count."""
    return [inverse / SETTINGS.step]


def _far_by_slope(inverse: Plane) -> list[Plane]:
    """Return a guide whose changes of 1 are those of slopes, by a half-width in two pixels."""
    return [np.diff(inverse, axis=axis, append=inverse.take([-1], axis)) for axis in (0, 1)]


def _background(inverse: Float[Tensor, "h w"], kept: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Return the farther of the nearest kept values to either side; the value itself where a row has none."""
    alone = torch.where(kept, inverse, torch.nan)
    beside = torch.fmin(*(nearest_known(alone, kept, -1, back) for back in (False, True)))
    return torch.where(beside.isnan(), inverse, beside)
