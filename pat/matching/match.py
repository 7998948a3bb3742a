"""The door of this room: `match` says where the pixels of alpha are in each beta, and what the betas show there."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from arraygeom.chunks import Box, assembled

from .colour_transfer import coarse_mix, colours_of_bands, diffused_from, matched_colours
from .inputs import Beta, Inputs
from .matches import BetaMatches, Comparison, Matches, combined_bands
from .multiview import agreed, can_agree, priors
from .pieces import matching_pieces
from .semi_global import FINE, matched_at_half_size
from .subpixel import matched_at_full_size, precise

LOG = logging.getLogger(__name__)

COARSELY = 400_000
"""Pixels of alpha at most on which the combination of bands that alpha sees is found. *size*"""


@runtime_checkable
class Matcher(Protocol):
    """What `fuse` asks for matches: `match`, or another function of the inputs."""

    def __call__(self, inputs: Inputs) -> Matches:
        """The matches of inputs whose sides are whole multiples of `inputs.multiple`."""
        ...


def match(inputs: Inputs) -> Matches:
    """Match alpha with every beta, and transfer the betas' bands to alpha's view.

    Raises ValueError for a beta whose field is not of straight segments.
    """
    return transferred(inputs, located(inputs))


@torch.no_grad()
def located(inputs: Inputs) -> Matches:
    """Where alpha's pixels are in each beta, without colours; of several calibrated betas, where all agree."""
    found = []
    for i in range(len(inputs.betas)):
        LOG.info("matching beta %d of %d", i + 1, len(inputs.betas))
        found.append(_located_in_one(inputs.of_beta(i)))
    return agreed(inputs, Matches(tuple(found))) if can_agree(inputs) else Matches(tuple(found))


def _located_in_one(inputs: Inputs) -> BetaMatches:
    """The matches in the one beta: at half the size for the whole frame, then at full size around those."""
    alpha, (beta,) = inputs.alpha, inputs.betas
    comparison = compared(inputs)
    level = comparison.normalisations
    half = matched_at_half_size(alpha, comparison.combined(beta.image), beta.field.of_blocks(FINE), level.half)

    def closer(piece: Inputs, box: Box) -> list[Tensor]:
        (part,), rough = piece.betas, half.cut(box).disparity
        guide, segments = comparison.combined(part.image), part.field.straight
        disparity, unlike = matched_at_full_size(piece.alpha, guide, segments, rough, level.whole)
        near = interpolate(rough, scale_factor=FINE, mode="bilinear")
        return [
            precise(piece.alpha, guide, segments, disparity, unlike, near, level.whole),
            avg_pool2d(unlike, FINE),
        ]

    disparity, unlike = _in_pieces(inputs, closer)
    return BetaMatches(disparity, torch.cat([unlike, half.facts[:, 1:]], 1), comparison)


def compared(inputs: Inputs) -> Comparison:
    """What of the one beta's bands is compared with alpha: the combination that is most like alpha where betas may have
    any bands, else luma."""
    alpha, (beta,) = inputs.alpha, inputs.betas
    if inputs.bands is not None or beta.image.shape[1] == 1:
        return Comparison.of(alpha, beta.image, None)
    factor = FINE
    while factor < inputs.multiple // FINE and math.prod(inputs.hw) > COARSELY * factor**2:
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
    agree = can_agree(inputs)
    sharing = [agree and inputs.shows_all_bands(beta) for beta in inputs.betas]
    prior = priors(inputs) if any(sharing) else (0.0,) * len(sharing)
    large = len(matching_pieces(inputs.hw, inputs.multiple)) > 1

    def of(piece: Inputs, box: Box) -> list[Tensor]:
        parts = _transferred_piece(piece, [one.cut(box) if large else one for one in found.betas], sharing, prior)
        return [part if part.requires_grad or not large else part.half() for part in parts]

    parts = _in_pieces(inputs, of)
    bands, diffused = parts[-len(sharing) :], iter(parts[: -len(sharing)])
    shared = next(diffused) if any(sharing) else None
    made = zip(found.betas, bands, sharing, prior)
    return Matches(tuple(replace(m, bands=b, diffused=shared if s else next(diffused), prior=p) for m, b, s, p in made))


def _transferred_piece(
    piece: Inputs, found: Sequence[BetaMatches], sharing: Sequence[bool], prior: Sequence[float]
) -> list[Tensor]:
    """The diffused colour that betas share, if any do, that of each other beta, and each beta's bands minus alpha."""
    alpha = piece.alpha
    alone = [transferred_bands(alpha, beta, one) for beta, one in zip(piece.betas, found)]
    shared = []
    if any(sharing):
        weights = torch.stack([weight for (_, weight), counts in zip(alone, sharing) if counts])
        counting = [(c, w * math.exp(p)) for (c, w), p, counts in zip(alone, prior, sharing) if counts]
        total = torch.stack([weight for _, weight in counting]).sum(0)
        mixed = sum(weight * colour for colour, weight in counting) / total
        shared = [diffused_from(mixed, alpha, weights.amax(0))]
    own = [diffused_from(colour, alpha, weight) for (colour, weight), counts in zip(alone, sharing) if not counts]
    return [*shared, *own, *(colour for colour, _ in alone)]


def transferred_bands(alpha: Tensor, beta: Beta, found: BetaMatches) -> tuple[Tensor, Tensor]:
    """A beta's bands minus alpha at its matches (B, C, H, W), and their weight (B, 1, H, W), 0 to 1."""
    where, mix = (beta.field.straight, found.disparity, found.facts), found.comparison.mix
    level = found.comparison.normalisations.whole
    if mix is None:
        return matched_colours(alpha, combined_bands(beta.image), beta.image, *where, level)
    return colours_of_bands(alpha, beta.image, *where, mix, level)


def _in_pieces(inputs: Inputs, make: Callable[[Inputs, Box], Iterable[Tensor]]) -> list[Tensor]:
    """What is made of a frame, or of each of the pieces in which a large one is matched."""
    pieces = matching_pieces(inputs.hw, inputs.multiple)
    cut = inputs.cut if len(pieces) > 1 else lambda _: inputs
    return list(assembled(inputs.hw, ((piece, make(cut(piece.outer), piece.outer)) for piece in pieces)))
