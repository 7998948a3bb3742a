"""Depth at alpha's pixels from the positions that a network returns for the betas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Segments, depth_from_track, pixel_grid
from arraygeom.epipolar import Depth, Track
from arraygeom.pixels import HW
from arraygeom.runtime.chunks import ROWS, Tile, assembled, tiles_of
from arraygeom.runtime.threads import in_order

from ..matching.inputs import FINE, Beta, Inputs, Matches
from ..networks.protocol import FusionOutput
from ..support.settings import size
from .inputs import Placement


@dataclass(frozen=True)
class DepthSettings:
    """Settings of the depth of fused pixels.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    unseen: float = size(1e-4, "Confidence up to which beta does not see the point, and gives no depth")


SETTINGS = DepthSettings()
DEVIATIONS = 1.645
"""Physics: standard deviations to either side of a normal distribution's mean that hold 9 of 10 cases."""


def _within(
    where: Float[Tensor, "n 2"], segments: Segments, which: Bool[Tensor, "h w"]
) -> Float[Tensor, "n 2"]:
    """Move positions of some of alpha's pixels along their segment to its end if beyond it."""
    h, w = which.shape
    start, end, valid = (t[0, :h, :w][which] for t in (segments.start, segments.end, segments.valid))
    start, end = start.to(where), end.to(where)
    way = end - start
    length2 = way.square().sum(-1)
    share = ((where - start) * way).sum(-1) / length2.clamp(min=1e-12)
    beyond = valid & (length2 > 1e-6) & ((share < 0) | (share > 1))
    moved = where + (share.clamp(0, 1) - share)[..., None] * way
    return torch.where(beyond[..., None], moved, where)


def certain(output: FusionOutput, matches: Matches | None, inputs: Inputs) -> FusionOutput:
    """Replace a network's confidence and deviation by those of the matches that it was given, where known.

    Where segments are around a known depth of each pixel, the higher confidence counts: a match there is
    hardly better than the few other candidates, which the confidence network takes for doubt.

    Args:
        output: the network's output.
        matches: matches that it was given; None for none.

    Returns:
        The output with these (confidence 0 off a segment, or where the network's is), and `overall`, if it
        had one, by `FusionOutput.with_overall`; unchanged without matches.
    """
    if matches is None:
        return output
    confidence, deviation = list(output.confidence), list(output.deviation)
    for i, (of_beta, beta) in enumerate(zip(matches.betas, inputs.betas)):
        if of_beta.certainty is not None:
            whole = interpolate(of_beta.certainty.float(), scale_factor=FINE, mode="bilinear").to(
                confidence[i]
            )
            valid = beta.field.straight.valid & (output.confidence[i] > 0)
            stated, half_width = torch.where(valid, whole[:, 0], 0.0), whole[:, 1]
            kept = (confidence[i] > stated) & beta.around
            confidence[i] = torch.where(kept, confidence[i], stated)
            deviation[i] = torch.where(kept, deviation[i], half_width / DEVIATIONS)
    known = output._replace(confidence=confidence, deviation=deviation)
    return known if output.overall is None else known.with_overall(inputs.betas)


def measured_depth(
    output: FusionOutput, inputs: Inputs, placements: list[Placement], hw: HW, corner: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute depth from the calibrated betas: the mean of inverse depths, weighted by their confidences.

    Depth beyond the bounds that were searched becomes that of the segment's end; for a pair with a link it is
    clipped; with lenses it is as of `Placement.depth`; from explicit positions of other pinholes it stays.

    Args:
        hw: size of the inputs without padding.
        corner: (x, y) of the inputs' first pixel in alpha.

    Returns:
        Depth (h, w) along alpha's axis, or along its rays where a placement's `bounds` are distances, in the
        rig's unit, NaN where unknown; the half-width (h, w) of the interval of its inverse, as in `Frame`;
        and the image's confidence (h, w), 0 to 1: `overall`, or the least of the betas'.

    Raises:
        ValueError: as `Placement.depth`, for calibrated betas; others give no depth.
    """

    def of_rows(tile: Tile) -> tuple[Tensor, ...]:
        (top, bottom), (left, above) = tile.inner, corner
        box = top, bottom, 0, hw[1]
        betas = tuple(replace(beta, field=beta.field.cut(box)) for beta in inputs.betas)
        return _measured(output.cut(box), betas, placements, (bottom - top, hw[1]), (left, above + top))

    tiles = list(tiles_of(hw[:1], ROWS, 0))
    made = in_order(of_rows, tiles) if output.image.device.type == "cpu" else map(of_rows, tiles)
    return assembled(hw[:1], zip(tiles, made), axes=[-2])


def _measured(
    output: FusionOutput,
    betas: Sequence[Beta],
    placements: list[Placement],
    hw: HW,
    corner: tuple[int, int],
) -> tuple[Tensor, ...]:
    """Compute `measured_depth` of some rows."""
    h, w = hw
    like = output.position[0]
    x = (pixel_grid(hw, dtype=like.dtype, device=like.device) + like.new_tensor(corner)).reshape(-1, 2)
    total, widths, weights = like.new_zeros(3, h, w)
    found_in_betas = zip(output.position, output.deviation, output.confidence)
    for beta, place, (position, deviation, confidence) in zip(betas, placements, found_in_betas):
        if not place.pair.calibrated:
            continue
        pair, offset = place.pair, like.new_tensor(beta.offset)
        where = position[0, :, :h, :w].movedim(0, -1)
        half_width = DEVIATIONS * deviation[0, :h, :w].reshape(-1)
        triangulated = place.depth(x, (where + offset).reshape(-1, 2), half_width)
        if beta.field.pixels is not None and pair.depth is not None and place.has_track:
            track = place.track(x)
            near, far = (bound.to(triangulated.depth) for bound in pair.depth)
            beyond = ~(triangulated.valid & (triangulated.depth >= near) & (triangulated.depth <= far))
            if bool(beyond.any()):
                moved = _within(where.reshape(-1, 2)[beyond], beta.field.pixels, beyond.view(h, w))
                some = Track(*(v.expand_as(track.a)[beyond] for v in track))
                there = depth_from_track(some, moved + offset, half_width[beyond])
                triangulated = Depth(
                    *(t.masked_scatter(beyond, values) for t, values in zip(triangulated, there))
                )
        elif pair.link is not None and pair.depth is not None:
            near, far = (bound.to(triangulated.depth) for bound in pair.depth)
            triangulated = triangulated._replace(depth=triangulated.depth.clamp(near, far))
        valid = triangulated.valid.reshape(h, w)
        weight = torch.where(valid & (confidence[0, :h, :w] > SETTINGS.unseen), confidence[0, :h, :w], 0.0)
        inverse = (1 / torch.where(triangulated.valid, triangulated.depth, 1.0)).reshape(h, w)
        total = total + weight * inverse
        widths = widths + weight * triangulated.deviation.reshape(h, w) * inverse.square()
        weights = weights + weight
    has_depth = weights > 0
    depth = torch.where(has_depth, weights / torch.where(has_depth, total, 1.0), torch.nan)
    overall = torch.stack(output.confidence).amin(0) if output.overall is None else output.overall
    half_width = torch.where(has_depth, widths / torch.where(has_depth, weights, 1.0), torch.nan)
    return depth.to(output.image), half_width.to(output.image), overall[0, :h, :w]
