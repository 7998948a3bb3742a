"""The entry of this room: `match` finds alpha's pixels in each beta, and the betas' bands there."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import Segments

from .band_mix import SETTINGS as MIX
from .band_mix import SpectralMix
from .choice import Choice, chosen, with_certainty
from .colour_transfer import transferred
from .inputs import FINE, BetaMatches, Comparison, Inputs, Matches, at_matches, is_consistent, reduced
from .multiview import agreed, with_likeliest_colours
from .semi_global import HalfSizeMatches, matched_at_half_size
from .subpixel import following, matched_at_full_size

LOG = logging.getLogger(__name__)


Matcher = Callable[[Inputs], Matches]
"""Function that `fuse` calls to match inputs, with sides at whole multiples of `inputs.multiple`: `match` or
your own."""


def match(inputs: Inputs, choice: Choice | None = None) -> Matches:
    """Match alpha with every beta, estimate the confidence of each match, and transfer the betas' bands.

    Gradients reach images and fields, through `disparity` too. Without `inputs.learned` it has none, and
    matches are semi-global ones with a left-right check, without `chosen`, `stated` and `certainty`.

    Args:
        inputs: alpha, of one channel and even sides (whole multiples of 4 for betas of several bands without
            `inputs.bands`), and the betas; none of less than 8 pixels a side.
        choice: network that chooses between candidate disparities; None for the one that ships. Not used
            without `inputs.learned`.

    Returns:
        The matches in each beta, with `colours` at alpha's view.

    Raises:
        ValueError: for no beta, a beta whose field is not of straight segments, an alpha of other sides or
            several channels, and images that are too small.
    """
    if inputs.alpha.shape[1] != 1:
        raise ValueError(f"alpha has {inputs.alpha.shape[1]} channels: what is matched has one")
    (h, w), betas = inputs.hw, [beta.image for beta in inputs.betas]
    multiple = FINE * (1 + (inputs.bands is None and any(image.shape[1] > 1 for image in betas)))
    if h % multiple or w % multiple:
        raise ValueError(f"alpha has {w}x{h} pixels to match: pad both sides to multiples of {multiple}")
    if (least := min(h, w, *(side for image in betas for side in image.shape[-2:]))) < 4 * FINE:
        raise ValueError(f"an image to match has a side of {least} pixels: give {4 * FINE} or more")
    matches = located(inputs, choice)
    if inputs.learned and torch.is_grad_enabled():
        matches = following(inputs, matches)
    return transferred(inputs, matches)


def located(inputs: Inputs, choice: Choice | None = None) -> Matches:
    """Match alpha's pixels in each beta, without colours; for several calibrated betas, where all agree.

    Args:
        choice: network that chooses between candidate disparities, as for `match`.

    Returns:
        The matches, detached; without `inputs.learned` semi-global ones, without choice or certainty.

    Raises:
        ValueError: for a beta whose field is not of straight segments.
    """
    matches = in_each_beta(inputs)
    if inputs.learned:
        matches = with_certainty(chosen(inputs, matches, choice))
    if not inputs.can_agree:
        return matches
    together = agreed(inputs, matches)
    return with_likeliest_colours(inputs, matches, with_certainty(together)) if inputs.learned else together


@torch.no_grad()
def in_each_beta(inputs: Inputs) -> Matches:
    """Match each beta as if it were the only one.

    Returns:
        The matches, detached, as of `located_in_one`.

    Raises:
        ValueError: for a beta whose field is not of straight segments.
    """
    of_betas = []
    for number, one in enumerate(inputs.by_beta, 1):
        LOG.info("matching beta %d of %d", number, len(inputs.betas))
        of_betas.append(located_in_one(one))
    return Matches(tuple(of_betas))


def located_in_one(inputs: Inputs) -> BetaMatches:
    """Match a single beta semi-globally: at half the size for the whole frame, then at full size around that.

    Args:
        inputs: inputs with one beta, and an alpha of even sides.

    Returns:
        The matches (with gradients in `comparison` alone), without choice, confidence or colours.

    Raises:
        ValueError: for several betas, or a field that is not of straight segments.
    """
    mix, alpha, (beta,) = seen_mix(inputs), inputs.alpha, inputs.betas
    comparison = Comparison.from_images(alpha, beta.image, mix)
    half = matched_at_half_size(comparison.half_views(alpha, beta.image), beta.field.of_blocks(FINE))

    def closer(piece: Inputs, rough: HalfSizeMatches) -> tuple[Tensor, Tensor]:
        (beta,) = piece.betas
        views = comparison.views(piece.alpha, beta.image)
        return matched_at_full_size(views, beta.field.straight, rough.disparity)

    disparity, unlike = inputs.in_pieces(closer, half)
    return BetaMatches(disparity, torch.cat([unlike, half.facts[:, 1:]], 1), comparison)


def seen_mix(inputs: Inputs) -> SpectralMix | None:
    """Estimate the combination of a single beta's bands that is most similar to alpha, on reduced images.

    Args:
        inputs: inputs with one beta.

    Returns:
        The combination, without gradients; None where luma or the mean of the bands is compared: the number
        of the result's bands is stated (`inputs.bands`), or the beta has one band.

    Raises:
        ValueError: for several betas; where it is estimated, for a field that is not of straight segments.
    """
    alpha, (beta,) = inputs.alpha, inputs.betas
    if inputs.bands is not None or beta.image.shape[1] == 1:
        return None
    factor = FINE
    while factor < inputs.multiple // FINE and math.prod(inputs.hw) > MIX.coarsely * factor**2:
        factor *= 2
    segments, blocks = (beta.field.of_blocks(side) for side in (factor, FINE * factor))
    return coarse_mix(alpha, beta.image, segments, blocks, factor)


@torch.no_grad()
def coarse_mix(
    alpha: Float[Tensor, "b 1 h w"],
    beta: Float[Tensor, "b c hb wb"],
    segments: Segments,
    blocks: Segments,
    factor: int,
) -> SpectralMix:
    """Estimate the combination of beta's bands that is most similar to alpha, on images reduced by `factor`.

    Args:
        segments: segments (B or 1, h / factor, w / factor) of the centres of blocks of alpha's pixels, in
            pixels of the whole beta.
        blocks: segments (B or 1, h / (2 factor), w / (2 factor)) of blocks of twice the side.
        factor: whole number by which both images are reduced.

    Returns:
        The combination of each of the batch, float64, without gradients.
    """
    coarse_alpha, bands = avg_pool2d(alpha, factor), avg_pool2d(beta, factor)
    comparison = Comparison.from_images(coarse_alpha, bands, SpectralMix.equal(bands))
    half = matched_at_half_size(comparison.half_views(coarse_alpha, bands), reduced(blocks, factor))
    values, valid = at_matches(bands, reduced(segments, factor), half.disparity)
    return SpectralMix.fitted(
        values, comparison.whole.softened(coarse_alpha), valid * is_consistent(half.facts)
    )
