"""From views to what a network is given: padded images, and each field evaluated once for every pixel of alpha."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from arraygeom import Moved, Pair, Segments, depth_from_track, pixel_grid
from arraygeom.epipolar import Track
from arraygeom.fields import default_field, pinhole_track
from arraygeom.fields.grid import BLOCK, FieldOnGrid
from arraygeom.pixels import HW

from ..networks.protocol import Beta, FusionNetwork, FusionOutput, Inputs
from .views import Views

UNSEEN = 1e-4
"""At confidences up to this beta does not see the point: then its position gives no depth."""


class Placement(NamedTuple):
    """How a beta is related to alpha.

    `points` says where alpha's pixels are when beta records: elsewhere only if they move (`Moved`).
    """

    pair: Pair
    points: Callable[[Tensor], Tensor]

    @property
    def has_depth(self) -> bool:
        """Whether positions in beta give depth."""
        return self.pair.link is None and self.pair.calibrated

    def track(self, x: Float[Tensor, "*n 2"]) -> Track:
        """The tracks in beta of alpha's pixels."""
        return pinhole_track(self.pair, self.points(x))


class FrameInputs(NamedTuple):
    """A network's inputs, padded to whole multiples; how each beta is placed; alpha's size without padding."""

    inputs: Inputs
    placements: list[Placement]
    hw: HW


def frame_inputs(network: FusionNetwork, views: Views) -> FrameInputs:
    """The inputs of a network for views that are prepared for it.

    Raises ValueError if alpha's pixels have no valid search segment in a beta: views that do not overlap.
    """
    m, hw = network.multiple, views.rig[views.alpha].hw
    alpha = padded(views.own[None], m)
    betas, placements = [], []
    for name in views.betas:
        pair = views.pair(name)
        field = views.fields.get(name) or default_field(pair)
        on_grid = FieldOnGrid.of(field, pair, hw=(alpha.shape[-2], alpha.shape[-1]), blocks=m % BLOCK == 0)
        place = Placement(pair, field.points if isinstance(field, Moved) else lambda x: x)
        betas.append(Beta(padded(views.images[name][None], m), on_grid, track=place.track if place.has_depth else None))
        _check_overlap(on_grid, pair, name)
        placements.append(place)
    return FrameInputs(Inputs(alpha, tuple(betas), m, network.beta_halo), placements, hw)


def _check_overlap(field: FieldOnGrid, pair: Pair, name: str) -> None:
    h, w = pair.alpha.hw
    if field.pixels is not None:
        overlap = field.pixels.valid[..., :h:8, :w:8].any()
    else:
        found = field.at(pixel_grid((h, w))[::8, ::8].reshape(-1, 2))
        overlap = getattr(found, "mask").any()  # noqa: B009
    if not overlap:
        bounds = "" if pair.depth is None else f" between {pair.depth[0]:g} and {pair.depth[1]:g} m"
        raise ValueError(f"alpha's and '{name}'s views do not overlap{bounds}: check the poses and the depth range")


def padded(image: Tensor, multiple: int) -> Tensor:
    """The image continued at the bottom and the right to whole multiples."""
    h, w = image.shape[-2:]
    return pad(image, (0, -w % multiple, 0, -h % multiple), mode="replicate")


def _within(where: Float[Tensor, "h w 2"], segments: Segments) -> Float[Tensor, "h w 2"]:
    """Positions, those beyond an end of their segment moved along it to that end."""
    h, w = where.shape[:2]
    start, end = (t[0, :h, :w].to(where) for t in (segments.start, segments.end))
    way = end - start
    length2 = way.square().sum(-1)
    share = ((where - start) * way).sum(-1) / length2.clamp(min=1e-12)
    beyond = segments.valid[0, :h, :w] & (length2 > 1e-6) & ((share < 0) | (share > 1))
    moved = where + (share.clamp(0, 1) - share)[..., None] * way
    return torch.where(beyond[..., None], moved, where)


def depth_and_confidence(
    output: FusionOutput, part: Inputs, placements: list[Placement], hw: HW, corner: tuple[int, int]
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
    """Depth from the calibrated betas, weighted by confidence in inverse depth (NaN: unknown); the image's confidence.

    A position whose depth is beyond the bounds that were searched counts as the end of its segment: a pixel beyond the
    far end may otherwise stand for any distance.
    `corner` is the (x, y) of the part's first pixel in alpha; `hw` the size of the part without padding.
    """
    h, w = hw
    like = output.position[0]
    x = (pixel_grid(hw, dtype=like.dtype, device=like.device) + like.new_tensor(corner)).reshape(-1, 2)
    total, weights = like.new_zeros(2, h, w)
    for beta, place, position, confidence in zip(part.betas, placements, output.position, output.confidence):
        if not place.has_depth:
            continue
        pair, track, offset = place.pair, place.track(x), like.new_tensor(beta.offset)
        where = position[0, :, :h, :w].movedim(0, -1)
        found = depth_from_track(track, (where + offset).reshape(-1, 2))
        if beta.field.pixels is not None and pair.depth is not None:
            near, far = (bound.to(found.depth) for bound in pair.depth)
            bounded = found.valid & (found.depth >= near) & (found.depth <= far)
            where = torch.where(bounded.reshape(h, w, 1), where, _within(where, beta.field.pixels))
            found = depth_from_track(track, (where + offset).reshape(-1, 2))
        valid = found.valid.reshape(h, w)
        weight = torch.where(valid & (confidence[0, :h, :w] > UNSEEN), confidence[0, :h, :w], 0.0)
        total = total + weight / torch.where(found.valid, found.depth, 1.0).reshape(h, w)
        weights = weights + weight
    known = weights > 0
    depth = torch.where(known, weights / torch.where(known, total, 1.0), torch.nan)
    overall = torch.stack(output.confidence).amin(0) if output.overall is None else output.overall
    return depth.to(output.image), overall[0, :h, :w]


LOST = 0.3
"""Confidence below which a pixel's depth is taken from beside it. Chosen on the pairs that `ResponseSettings` names."""

ONE_SIDE = 0.9
"""Length of the sum of all betas' segments, over the sum of their lengths, from which all count as on one side."""


def background_filled(
    depth: Float[Tensor, "h w"], confidence: Float[Tensor, "h w"], inputs: Inputs
) -> Float[Tensor, "h w"]:
    """Depth whose values of low confidence are the farther of the nearest confident ones to either side.

    What a beta does not see is occluded: farther away than what is beside it. Along rows, or along columns if the betas
    are above or below alpha. What is unknown stays NaN. Betas on several sides see what is occluded in one of them:
    depth is then as it is.
    """
    steps = [beta.field.pixels for beta in inputs.betas if beta.field.pixels is not None]
    if not steps:
        return depth
    apart = torch.stack([(part.end - part.start).mean((0, 1, 2)) for part in steps])
    if apart.sum(0).norm() < ONE_SIDE * apart.norm(dim=1).sum():
        return depth
    across, down = apart.sum(0).abs().tolist()
    along_rows = across >= down
    inverse = torch.where(depth.isfinite(), 1 / depth, torch.nan)
    known = (confidence >= LOST) & depth.isfinite()
    if not along_rows:
        inverse, known = inverse.mT, known.mT
    before = _nearest_known(inverse, known)
    after = _nearest_known(inverse.flip(-1), known.flip(-1)).flip(-1)
    beside = torch.fmin(before, after)
    found = torch.where(known | beside.isnan(), inverse, beside)
    found = found if along_rows else found.mT
    return torch.where(depth.isfinite() & (found > 0), 1 / found, depth)


def _nearest_known(values: Float[Tensor, "h w"], known: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Each pixel's nearest known value to the left, itself included; NaN if there is none."""
    columns = torch.arange(values.shape[1], device=values.device).expand_as(values)
    last = torch.where(known, columns, -1).cummax(1).values
    return torch.where(last >= 0, values.gather(1, last.clamp(min=0)), torch.nan)
