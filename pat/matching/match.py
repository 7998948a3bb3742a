"""The door of this room: `match` says where the pixels of alpha are in each beta, and what the betas show there."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from arraygeom.chunks import Box

from ..support.settings import size
from .colour_transfer import coarse_mix, colours_of_bands, diffused_from, matched_colours
from .inputs import Beta, Inputs
from .matches import BetaMatches, Comparison, Matches, combined_bands
from .multiview import agreed
from .semi_global import FINE, matched_at_half_size
from .subpixel import matched_at_full_size, precise, with_gradients

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class MatchSettings:
    """Of matching as a whole."""

    coarsely: int = size(400_000, "Pixels of alpha at most on which the combination of bands that it sees is found")


SETTINGS = MatchSettings()


@runtime_checkable
class Matcher(Protocol):
    """What `fuse` asks for matches: `match`, or another function of the inputs."""

    def __call__(self, inputs: Inputs) -> Matches:
        """The matches of inputs whose sides are whole multiples of `inputs.multiple`."""
        ...


def match(inputs: Inputs) -> Matches:
    """Match alpha with every beta, and transfer the betas' bands to alpha's view; with gradients as `transferred`, and
    of the positions.

    Raises ValueError for a beta whose field is not of straight segments.
    """
    found = located(inputs)
    if torch.is_grad_enabled():
        found = Matches(tuple(_following(inputs.alpha, *one) for one in zip(inputs.betas, found.betas)))
    return transferred(inputs, found)


def _following(alpha: Tensor, beta: Beta, found: BetaMatches) -> BetaMatches:
    """The matches, which follow images and segments that have gradients."""
    segments, comparison = beta.field.straight, found.comparison
    if not any(x.requires_grad for x in (alpha, beta.image, segments.start, segments.end)):
        return found
    views = comparison.normalisations.whole.views(alpha, comparison.combined(beta.image))
    return replace(found, disparity=with_gradients(views, segments, found.disparity))


@torch.no_grad()
def located(inputs: Inputs) -> Matches:
    """Where alpha's pixels are in each beta, without colours; of several calibrated betas, where all agree."""
    alone = Matches(tuple(_located_in_one(inputs.of_beta(i)) for i in range(len(inputs.betas))))
    return agreed(inputs, alone) if inputs.can_agree else alone


def _located_in_one(inputs: Inputs) -> BetaMatches:
    """The matches in the one beta: at half the size for the whole frame, then at full size around those."""
    LOG.info("matching a beta")
    alpha, (beta,) = inputs.alpha, inputs.betas
    comparison = compared(inputs)
    level, combined = comparison.normalisations, comparison.combined(beta.image)
    half = matched_at_half_size(alpha, combined, beta.field.of_blocks(FINE), level.half)

    def closer(box: Box) -> list[Tensor]:
        piece, rough = inputs.part(box), half.cut(box).disparity
        (part,), near = piece.betas, interpolate(rough, scale_factor=FINE, mode="bilinear")
        views, segments = level.whole.views(piece.alpha, comparison.combined(part.image)), part.field.straight
        disparity, unlike = matched_at_full_size(views, segments, rough)
        return [precise(views, segments, disparity, unlike, near), avg_pool2d(unlike, FINE)]

    disparity, unlike = inputs.in_pieces(closer)
    return BetaMatches(disparity, torch.cat([unlike, half.facts[:, 1:]], 1), comparison)


def compared(inputs: Inputs) -> Comparison:
    """What of the one beta's bands is compared with alpha: the combination that is most like alpha where betas may have
    any bands, else luma."""
    alpha, (beta,) = inputs.alpha, inputs.betas
    if inputs.bands is not None or beta.image.shape[1] == 1:
        return Comparison.of(alpha, beta.image, None)
    factor = FINE
    while factor < inputs.multiple // FINE and math.prod(inputs.hw) > SETTINGS.coarsely * factor**2:
        factor *= 2
    segments, blocks = (beta.field.of_blocks(side) for side in (factor, FINE * factor))
    return Comparison.of(alpha, beta.image, coarse_mix(alpha, beta.image, segments, blocks, factor))


def transferred(inputs: Inputs, found: Matches) -> Matches:
    """The matches with beta's bands at them; those of matches from elsewhere, too.

    Of betas that agree on depth, those that have all of the result's bands share the colour that is diffused; any other
    has its own. With gradients if images or fields have some and gradients are recorded. Raises ValueError for matches
    of another size or number of betas.
    """
    found.check(inputs.hw, len(inputs.betas))
    agree, large = inputs.can_agree, len(inputs.pieces) > 1
    sharing = [agree and inputs.shows_all_bands(beta) for beta in inputs.betas]

    def of(box: Box) -> list[Tensor]:
        parts = _transferred_piece(inputs.part(box), found.cut(box), sharing)
        return [part if part.requires_grad or not large else part.half() for part in parts]

    parts = inputs.in_pieces(of)
    bands, diffused = parts[-len(sharing) :], iter(parts[: -len(sharing)])
    shared = next(diffused) if any(sharing) else None
    made = zip(found.betas, bands, sharing)
    return Matches(tuple(replace(m, bands=b, diffused=shared if s else next(diffused)) for m, b, s in made))


def _transferred_piece(piece: Inputs, found: Matches, sharing: Sequence[bool]) -> list[Tensor]:
    """The diffused colour that betas share, if any do, that of each other beta, and each beta's bands minus alpha."""
    alpha = piece.alpha
    alone = [transferred_bands(alpha, *one) for one in zip(piece.betas, found.betas)]
    shared = []
    if any(sharing):
        counting = [(c, w, m.prior) for (c, w), m, counts in zip(alone, found.betas, sharing) if counts]
        weights = [weight * math.exp(prior) for _, weight, prior in counting]
        mixed = sum(w * colour for w, (colour, _, _) in zip(weights, counting)) / torch.stack(weights).sum(0)
        shared = [diffused_from(mixed, alpha, torch.stack([weight for _, weight, _ in counting]).amax(0))]
    own = [diffused_from(colour, alpha, weight) for (colour, weight), counts in zip(alone, sharing) if not counts]
    return [*shared, *own, *(colour for colour, _ in alone)]


def transferred_bands(alpha: Tensor, beta: Beta, found: BetaMatches) -> tuple[Tensor, Tensor]:
    """A beta's bands minus alpha at its matches (B, C, H, W), and their weight (B, 1, H, W), 0 to 1."""
    where, mix = (beta.field.straight, found.disparity, found.facts), found.comparison.mix
    level = found.comparison.normalisations.whole
    if mix is None:
        return matched_colours(alpha, combined_bands(beta.image), beta.image, *where, level)
    return colours_of_bands(alpha, beta.image, *where, mix, level)
