"""Beta's bands at alpha's view by matches: as bright as alpha, with its detail, filled in where not seen.

Unseen pixels take the colour of the nearest neighbours among alpha's own seen pixels in brightness, texture
and place (Welsh et al. 2002 colour a grey image so, by another one).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from arraygeom import Segments
from arraygeom.runtime.chunks import chunked

from ..media.colour import REC601, to_bytes
from ..media.filters import LocalMoments, box_mean, numpy_of, smoothed
from ..support.neighbours import nearest_points
from ..support.settings import size, tuned
from .band_mix import SpectralMix
from .inputs import Beta, BetaMatches, Colours, Inputs, Matches, at_matches, is_consistent
from .normalisation import SETTINGS as NORMALISATION
from .normalisation import Moments, explained_share, likeness, moments
from .semi_global import DISPARITY_FILL


@dataclass(frozen=True)
class ColourTransferSettings:
    """Settings of the transfer of beta's colours to alpha's view, and of colour by example.

    Brightness is 0 to 1, lengths are pixels of alpha. Middlebury and SYNTIM are the pairs of their tune
    halves.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    alike: float = tuned(
        2.0, "Middlebury, tune half: added to the logit of a match's confidence where brightness agrees"
    )
    fill: float = tuned(
        100.0, "Middlebury, tune half: strength of colour's diffusion, which stops where disparity's does"
    )
    surroundings: int = size(
        48, "Pixels within which both views' brightness is compared; half or twice as much does as well"
    )
    saturation: float = tuned(0.6, "Middlebury: the power of its ratio by which colour grows")
    most_brighter: float = size(2.0, "Surroundings that differ by a larger factor are of different things")
    detail_radius: int = tuned(
        2,
        "Middlebury, reduced 4 and 8 times: window of the regression that gives matched colour the detail "
        "that beta lost; in standard deviations of the blur by which beta is less sharp than alpha, where "
        "that is more: within a smaller window beta shows one value",
    )
    floor: float = size(
        1e-4, "Variance that regularises regressions on brightness; half or twice as much does as well"
    )
    noise_share: float = size(
        20.0,
        "Variance of noise in all bands over that of the difference in brightness; "
        "half or twice as much does as well",
    )
    texture_share: float = tuned(0.6, "SYNTIM and Middlebury: texture's share that is taken off that")
    lowest: float = size(
        0.1, "The quantile that stands for the least of either; half or twice as much does as well"
    )
    least_noise: float = size(
        2e-5, "Variance not worth the time to take it out: two thirds of a level of 8 bits in each band"
    )
    light_differs: float = tuned(
        0.3,
        "Middlebury, tune half, beta exposed 1.5 to 3 times: variance of light that differs between the "
        "views over that of light beyond the largest value",
    )
    most_detail: float = size(0.2, "Differences of brightness beyond this are no detail that beta lost")
    neighbours: int = size(5, "Examples of an unseen pixel; half or twice as many do as well")
    radii: tuple[int, int] = size((2, 6), "Radii of the windows of examples' means and deviations")
    place: tuple[float, float] = tuned(
        (1200.0, 1800.0),
        "Middlebury, tune half: pixels whose distance counts as much as black beside white, across "
        "the searched segments and along them: what is occluded is long across",
    )
    seen: float = size(0.5, "Weight above which a pixel counts as seen, and is an example")
    sources: int = size(60_000, "Seen pixels searched for examples at most")
    error: float = size(0.5, "Relative error of the approximate nearest-neighbour search")

    def detail(self, difference: Tensor) -> Tensor:
        """Return the part of a difference of brightness that is detail that beta lost."""
        return difference.clamp(-self.most_detail, self.most_detail)


SETTINGS = ColourTransferSettings()
LEAST = 1e-3
"""Size: least weight of a pixel in a fill."""
DIRECTIONS = 8
"""Size: spacing, in rows and columns, of the segments whose directions are averaged."""


EVERY = (slice(None, None, 2),) * 2
"""Size: every second pixel is searched for."""
Plane = NDArray[np.float32]


class MatchedValues(NamedTuple):
    """Beta's values at the matches of alpha's pixels, and alpha as it is compared with them.

    Attributes:
        bands: beta's bands (B, C, H, W).
        combined: combination of these that is compared with alpha, (B, 1, H, W).
        brightness: that combination, normalised to alpha's brightness, (B, 1, H, W).
        soft: alpha, blurred to be no sharper than beta, (B, 1, H, W).
        valid: mask of the matches that are on beta, (B, 1, H, W).
        consistent: 1 where a match passes the left-right check, else 0, (B, 1, H, W).
        clipped: (B, C, H, W), 1 where a band is clipped, 0 elsewhere, and between them beside such pixels;
            None for none, and for bands that are compared by a mix.
    """

    bands: Tensor
    combined: Tensor
    brightness: Tensor
    soft: Tensor
    valid: Tensor
    consistent: Tensor
    clipped: Tensor | None

    @classmethod
    def from_matches(cls, alpha: Float[Tensor, "b 1 h w"], beta: Beta, matches: BetaMatches) -> MatchedValues:
        """Sample a beta at its matches.

        Without a mix alpha is compared with luma of three bands, or the mean of others.

        Raises:
            ValueError: for a field that is not of straight segments.
        """
        comparison, segments = matches.comparison, beta.field.straight
        image, soft = beta.image, comparison.whole.softened(alpha)
        consistent = is_consistent(matches.facts)
        if comparison.mix is not None:
            bands, valid = at_matches(image, segments, matches.disparity)
            combined = comparison.combined(bands)
            return cls(bands, combined, combined, soft, valid, consistent, None)
        luma = comparison.combined(image)
        planes = [image, luma, comparison.whole.normalised(luma)]
        planes += [] if beta.clipped is None else [beta.clipped.to(image)]
        sampled, valid = at_matches(torch.cat(planes, 1), segments, matches.disparity)
        bands, luma, brightness, *clipped = sampled.split([plane.shape[1] for plane in planes], 1)
        return cls(bands, luma, brightness, soft, valid, consistent, clipped[0] if clipped else None)


class MatchStatistics(NamedTuple):
    """Statistics over a frame's consistent matches: on beta, past the left-right check.

    Of clipped ones only those compared by a mix count. Statistics of tiles would differ, and borders show.

    Attributes:
        matches: number of these matches, plus one, (B, 1, 1, 1); of a frame in pieces a mean of theirs.
        colour: mean of beta's bands minus alpha, (B, C, 1, 1).
        level: means of beta's brightness and of its square, and of alpha and of its square, (4, B, 1, 1, 1).
        explained: share of the variance of beta's combined bands that alpha explains, 0 to 1, (B, 1, 1, 1).
        noise: variance of the noise in colour, all bands together, (B, 1, 1, 1); 0 for one band.
    """

    matches: Tensor
    colour: Tensor
    level: Tensor
    explained: Tensor
    noise: Tensor

    @classmethod
    def from_values(cls, alpha: Float[Tensor, "b 1 h w"], matched: MatchedValues) -> MatchStatistics:
        """Compute the statistics of alpha's image and a beta's values at the matches."""
        values, combined, brightness, soft, valid, consistent, clipped = matched
        counts = valid if clipped is None else valid & (clipped.amax(1, keepdim=True) < 0.5)
        both = counts * consistent
        count = both.sum((-2, -1), keepdim=True) + 1
        colour = (both * (values - alpha)).sum((-2, -1), keepdim=True) / count
        measured = [moments(image, both) for image in (brightness, alpha)]
        squares = [one.mean.double().square() + one.deviation.double().square() for one in measured]
        level = torch.stack([measured[0].mean, squares[0], measured[1].mean, squares[1]])
        explained = explained_share(combined, soft, both)
        one = cls(count, colour, level, explained, torch.zeros_like(count))
        if values.shape[1] == 1:
            return one
        unlike = one.leveled(brightness) - soft
        return one._replace(noise=colour_noise(unlike, soft, both * likeness(unlike)))

    def leveled(self, brightness: Tensor) -> Tensor:
        """Return beta's brightness with alpha's mean and standard deviation over consistent matches."""
        means, squares = self.level[::2], self.level[1::2]
        measured, wanted = map(Moments, means, (squares - means.square()).clamp(min=1e-12).sqrt())
        return measured.matched(brightness, wanted, NORMALISATION.largest_gain).to(brightness)

    @classmethod
    def mean(cls, pieces: Sequence[MatchStatistics]) -> MatchStatistics:
        """Combine the statistics of pieces to those of a frame."""
        counts = torch.stack([piece.matches for piece in pieces])
        share = counts / counts.sum(0)
        return cls(*(torch.stack([w * x for w, x in zip(share, each)]).sum(0) for each in zip(*pieces)))


def transferred(inputs: Inputs, matches: Matches) -> Matches:
    """Transfer the betas' bands to alpha's view, also for matches from another source.

    Alpha has one channel and even sides, unchecked. Fills are colours for pixels that beta does not see. Of
    several betas for which `can_agree` is True, those with all of the result's bands share one fill; any
    other has its own. Gradients reach images and fields, but not through fills.

    Returns:
        The matches with `colours`; of a large frame float16 planes where these have no gradient.

    Raises:
        ValueError: as `Matches.check`, and for a beta whose field is not of straight segments.
    """
    matches.check(inputs)
    large = len(inputs.pieces) > 1
    statistics = _statistics_of_frame(inputs, matches) if large else None

    def stored(plane: Tensor) -> Tensor:
        return plane if plane.requires_grad or not large else plane.half()

    def of(piece: Inputs, there: Matches) -> list[Tensor]:
        given: Sequence[MatchStatistics | None] = statistics or [None] * len(piece.betas)
        parts = zip(piece.betas, there.betas, given)
        carried = (transferred_bands(piece.alpha, *one, sees_luma=piece.sees_luma) for one in parts)
        return [stored(plane) for planes in carried for plane in planes]

    planes = iter(inputs.in_pieces(of, matches))
    carried = list(zip(planes, planes, planes))
    fills = [stored(fill) for fill in _fills(inputs, carried)]
    return Matches(
        tuple(replace(m, colours=Colours(*one, fill)) for m, one, fill in zip(matches.betas, carried, fills))
    )


def _fills(inputs: Inputs, carried: Sequence[tuple[Tensor, Tensor, Tensor]]) -> list[Tensor]:
    """Compute the fills of each beta, from its bands and their weight, over the whole frame.

    Pieces of one would find other examples, and their borders would show. Betas that stand in for each other
    share theirs.
    """
    sharing = [inputs.can_agree and inputs.shows_all_bands(beta) for beta in inputs.betas]
    regressed, of_betas = inputs.bands is None, [directions_of(beta.field.straight) for beta in inputs.betas]
    shared: Tensor | None = None
    if any(sharing):
        some = [one for one, shares in zip(carried, sharing) if shares]
        each = torch.stack([weight.float() for _, weight, _ in some])
        weights = (each + LEAST) / (
            1 + LEAST - each
        )  # odds: colours of weak matches hardly count beside others
        mixed = (weights * torch.stack([bands.float() for bands, _, _ in some])).sum(0) / weights.sum(0)
        mean = np.mean([one for one, shares in zip(of_betas, sharing) if shares], 0)
        shared = filled_from(mixed, inputs.alpha, each.amax(0), mean, regressed=regressed)
    return [
        shared
        if shares and shared is not None
        else filled_from(one[0], inputs.alpha, one[1], directions, regressed=regressed)
        for one, shares, directions in zip(carried, sharing, of_betas)
    ]


def directions_of(segments: Segments) -> Float[NDArray, "2 2"]:
    """Compute the mean outer product of unit vectors along valid segments; half the identity without any."""
    some = (segments.end - segments.start)[..., ::DIRECTIONS, ::DIRECTIONS, :].detach().double()
    some = some[segments.valid[..., ::DIRECTIONS, ::DIRECTIONS]]
    units = some[some.norm(dim=-1) > LEAST].cpu().numpy()
    units = units / np.linalg.norm(units, axis=-1, keepdims=True)
    return units.T @ units / len(units) if len(units) else np.eye(2) / 2


def _statistics_of_frame(inputs: Inputs, matches: Matches) -> list[MatchStatistics]:
    """Compute the statistics of each beta, over all pieces, in turn."""
    of_pieces = []
    for piece, there in inputs.cut_in_pieces(matches):
        values = (MatchedValues.from_matches(piece.alpha, *one) for one in zip(piece.betas, there.betas))
        of_pieces.append([MatchStatistics.from_values(piece.alpha, one) for one in values])
    return [MatchStatistics.mean(of_beta) for of_beta in zip(*of_pieces)]


def transferred_bands(
    alpha: Float[Tensor, "b 1 h w"],
    beta: Beta,
    matches: BetaMatches,
    statistics: MatchStatistics | None = None,
    *,
    sees_luma: bool = True,
) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 1 h w"], Float[Tensor, "b 1 h w"]]:
    """Compute a beta's colours at the matches: all of `Colours` but its fills.

    Args:
        alpha: alpha's image.
        beta: beta's image and field.
        matches: matches in that beta.
        statistics: statistics to use; None for those of these pixels.
        sees_luma: True if alpha sees about the luma of RGB betas: photometric similarity then counts in the
            weight, and colours grow with alpha's brightness; not used for matches with a mix of bands.

    Returns:
        `bands` (the statistics' mean where the match is not on beta), `weight` and `likeness` of `Colours`,
        at alpha's pixels.

    Raises:
        ValueError: for a field that is not of straight segments.
    """
    there, mix = MatchedValues.from_matches(alpha, beta, matches), matches.comparison.mix
    statistics = statistics or MatchStatistics.from_values(alpha, there)
    if mix is not None:
        colours, weight, alike = _colours_by_mix(alpha, matches, there, mix)
    else:
        colours, weight, alike = _colours_by_luma(alpha, matches, there, statistics, sees_luma=sees_luma)
    return torch.where(there.valid, colours, statistics.colour), weight, alike


def _colours_by_luma(
    alpha: Tensor, matches: BetaMatches, there: MatchedValues, statistics: MatchStatistics, *, sees_luma: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute bands minus alpha, with the detail that alpha has and beta lacks; their weight and likeness."""
    values, luma, brightness, soft, valid, _, clipped = there
    bands, unlike = values.shape[1], statistics.leveled(brightness) - soft
    if clipped is not None and bands == 3 and sees_luma:
        values, whole = with_clipped_light(values, luma, soft, clipped)
        unlike = unlike + (whole - luma) * (1 - clipped.amin(1, keepdim=True))  # white may be of any colour
        luma = whole
    alike = likeness(unlike) if sees_luma else torch.ones_like(unlike)
    if bands == 1:  # which may be unlike alpha
        alike = torch.lerp(torch.ones_like(alike), alike, statistics.explained.to(alike))
    weight = match_weight(alike, matches, valid)
    if bands == 1:
        return _detailed(values, soft, alpha) - alpha, weight, alike
    power = SETTINGS.saturation if sees_luma else 0.0
    colour, bright = _scaled_to_alpha(values - luma, luma, alpha, weight, power)
    if float(statistics.noise.amax()) > SETTINGS.least_noise:
        colour = _without_noise(colour, bright, statistics.noise)
    radii = [round(SETTINGS.detail_radius * max(1.0, blur)) for blur in matches.comparison.whole.blurs[0]]
    detailed = _each_detailed(colour, bright, alpha, radii)
    return torch.lerp(colour, detailed, statistics.explained) + luma - alpha, weight, alike


def _colours_by_mix(
    alpha: Tensor, matches: BetaMatches, there: MatchedValues, mix: SpectralMix
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute bands minus alpha, with the detail that alpha has and they lack; their weight and likeness."""
    values, brightness, soft = there.bands, there.brightness, there.soft
    gain = mix.gain[:, None, None, None].to(alpha)
    beyond = (alpha - soft) + gain * (soft - brightness)
    rises = mix.rises(values)
    slope = rises + local_slope(values - rises * brightness, brightness)
    colours = values + slope * SETTINGS.detail(beyond) - alpha
    alike = likeness(brightness - soft)
    return colours, match_weight(alike, matches, there.valid), alike


def with_clipped_light(
    values: Float[Tensor, "b 3 h w"],
    luma: Float[Tensor, "b 1 h w"],
    alpha: Float[Tensor, "b 1 h w"],
    clipped: Float[Tensor, "b 3 h w"],
) -> tuple[Float[Tensor, "b 3 h w"], Float[Tensor, "b 1 h w"]]:
    """Add to clipped bands the light that alpha shows and beta's luma lacks, equally to all that are clipped.

    Alpha's excess over luma, where positive, is explained by light beyond the largest value and by light that
    differs between the views, each by its expected variance: a ridge regression of one number at each pixel.

    Args:
        luma: Rec. 601 luma of the values.
        alpha: alpha, as sharp as these.
        clipped: 1 where a band is clipped, 0 elsewhere, and between them beside such pixels.

    Returns:
        The bands, which may exceed 1, and their luma.
    """
    share = (clipped * values.new_tensor(REC601)[:, None, None]).sum(1, keepdim=True)
    beyond = (alpha - luma).clamp(min=0) * share / (share.square() + SETTINGS.light_differs)
    return values + clipped * beyond, luma + share * beyond


def _scaled_to_alpha(
    colour: Tensor, brightness: Tensor, alpha: Tensor, weight: Tensor, power: float
) -> tuple[Tensor, Tensor]:
    """Return beta's colour differences (B, C, H, W) and brightness, larger where alpha is brighter around.

    Light or a lens that makes a surface brighter keeps its saturation, a reflection does not: the power is in
    between; and 0 where alpha sees another spectrum, such as near infrared: there the ratio is of materials.
    """
    least, most = 1e-3, SETTINGS.most_brighter
    alpha_mean, beta_mean = (
        box_mean(image * weight, SETTINGS.surroundings) + least for image in (alpha, brightness)
    )
    ratio = (alpha_mean / beta_mean.clamp(min=least)).clamp(1 / most, most)
    return colour * ratio**power, brightness * ratio


def match_weight(
    alike: Float[Tensor, "b 1 h w"], matches: BetaMatches, valid: Tensor
) -> Float[Tensor, "b 1 h w"]:
    """Compute the weight of the colours at the matches.

    It is the photometric similarity, halved where the left-right check fails. Where `certainty` is known, it
    is the root of that times the probability, given the similarity, that the match is right.

    Args:
        alike: photometric similarity, 0 to 1.
        valid: mask of the matches that are on beta.

    Returns:
        Weights, 0 to 1 (at least `LEAST` by `certainty`); 0 where `valid` is False.
    """
    checked = alike * (1 + is_consistent(matches.facts)) / 2
    if matches.certainty is None:
        return checked * valid
    odds = matches.confidence.clamp(LEAST, 1 - LEAST).logit() + SETTINGS.alike * alike
    return (checked * odds.sigmoid()).clamp(min=LEAST**2).sqrt() * valid


def filled_from(
    colour: Float[Tensor, "b c h w"],
    alpha: Float[Tensor, "b 1 h w"],
    weight: Float[Tensor, "b 1 h w"],
    directions: Float[NDArray, "2 2"],
    *,
    regressed: bool = False,
) -> Float[Tensor, "b fills c h w"]:
    """Fill in the colours of pixels that beta does not see by those of the most similar pixels that it sees.

    In the fill seen pixels, those of a weight above 1/2, keep their colour; if these are hardly any, all do.

    Args:
        colour: bands minus alpha.
        alpha: alpha's image.
        weight: weight of each pixel's colour, 0 to 1.
        directions: mean outer product of the unit vectors along the searched segments (`directions_of`).
        regressed: True to fit the regression of colour on brightness over connected regions of alpha first,
            and take only the difference from it from examples.

    Returns:
        The fill at all pixels, with `regressed` the regression and the fill, bands minus alpha; detached.
    """
    planes = zip(numpy_of(colour), numpy_of(alpha[:, 0]), numpy_of(weight[:, 0]), to_bytes(alpha[:, 0]))
    fills = []
    for bands, brightness, w, guide in planes:
        base = [_diffused(bands, brightness, w + LEAST, guide)] if regressed else []
        nearest = by_examples(bands - sum(base), brightness, w, directions) + sum(base)
        fills.append(np.stack([*base, nearest]))
    return torch.from_numpy(np.stack(fills)).to(alpha)


@torch.no_grad()
def colour_noise(
    unlike: Float[Tensor, "b 1 h w"], texture: Float[Tensor, "b 1 h w"], weight: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 1 1 1"]:
    """Estimate the variance of noise in colour at the matches, all bands together.

    It is taken from the fine part of the difference of brightness, less the share that texture causes when it
    is resampled.

    Args:
        unlike: difference of brightness between beta at the match and alpha, values 0..1.
        texture: brightness of alpha.
        weight: weight of each pixel, 0 to 1; those above a half count.

    Returns:
        Variance for each of the batch, without gradient; 0 where there is none, or no pixel counts.
    """
    parts, radius = torch.cat([unlike, texture], 1), SETTINGS.detail_radius
    fine = box_mean((parts - box_mean(parts, radius)).square(), radius)
    fine = torch.where(weight > 0.5, fine, torch.nan)[..., ::4, ::4].flatten(2)
    least, of_texture = fine.nanquantile(SETTINGS.lowest, 2).nan_to_num(0.0).split(1, 1)
    variance = SETTINGS.noise_share * (least - SETTINGS.texture_share * of_texture)
    return variance.clamp(min=0)[..., None, None]


def _without_noise(colour: Tensor, brightness: Tensor, noise: Tensor) -> Tensor:
    """Return colour (B, C, H, W) nearer its regression on brightness, the noisier the rest (Lee 1980)."""
    local = LocalMoments.within(SETTINGS.detail_radius, colour, brightness)
    slope = local.slope(SETTINGS.floor)
    fitted = local.bands + slope * (brightness - local.image)
    rest = (local.variance_of_bands - slope * local.covariance).sum(1, keepdim=True).clamp(min=0)
    return torch.lerp(fitted, colour, (rest - noise).clamp(min=0) / (rest + 1e-9))


def _each_detailed(colour: Tensor, brightness: Tensor, alpha: Tensor, radii: Sequence[int]) -> Tensor:
    """Apply `_detailed` to each of the batch with its own radius."""
    radii = [radii[0]] if len(set(radii)) == 1 else radii
    parts = zip(*(x.tensor_split(len(radii)) for x in (colour, brightness, alpha)), radii)
    return torch.cat([_detailed(c, b, a, radius) for c, b, a, radius in parts])


def _detailed(
    colour: Tensor, brightness: Tensor, alpha: Tensor, radius: int = SETTINGS.detail_radius
) -> Tensor:
    """Move colour (B, C, H, W) along its local regression on brightness by the excess of alpha's."""

    def of(colour: Tensor, brightness: Tensor, alpha: Tensor) -> Tensor:
        return colour + local_slope(colour, brightness, radius) * SETTINGS.detail(alpha - brightness)

    return chunked(of, colour, brightness, alpha, halo=radius)


def local_slope(
    colour: Float[Tensor, "b c h w"],
    brightness: Float[Tensor, "b 1 h w"],
    radius: int = SETTINGS.detail_radius,
) -> Float[Tensor, "b c h w"]:
    """Compute the slope of the regression of colour on brightness around each pixel.

    The guided filter's linear model (He et al. 2013): it restores the detail that beta lost by its
    resolution. The slope is multiplied by the cube of the share of colour's variance that the regression
    explains: few of a window's pixels are independent, so that even noise seems to be explained in part.

    Args:
        colour: bands.
        brightness: guide.
        radius: pixels to either side of a window.

    Returns:
        Slope of each band at each pixel.
    """
    local = LocalMoments.within(radius, colour, brightness)
    variances = (local.variance_of_image + 1e-6) * (local.variance_of_bands + 1e-6)
    explained = (local.covariance.square() / variances).clamp(max=1) ** 3
    return explained * local.slope(SETTINGS.floor)


def _diffused(
    colour: NDArray, brightness: NDArray, weight: NDArray, guide: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Compute colour (c, h, w) by its regression on brightness (h, w) over connected regions of the guide.

    The moments of the guided filter (He et al. 2013), diffused instead of averaged over a window: a region
    that no beta sees has colour that varies with brightness as it does nearby.
    """
    how = SETTINGS.fill, DISPARITY_FILL[1]
    sums = [weight, *(weight * p for p in (brightness, brightness**2, *colour))]
    total, first, second, *of_bands = smoothed(sums, guide, how)
    products = smoothed([weight * brightness * p for p in colour], guide, how)
    mean = first / total
    variance = np.maximum(second / total - mean * mean, 0) + SETTINGS.floor
    beyond = np.clip(brightness - mean, -SETTINGS.most_detail, SETTINGS.most_detail)
    bands = [band / total for band in of_bands]
    return np.stack([b + (p / total - b * mean) / variance * beyond for b, p in zip(bands, products)])


def by_examples(
    colour: Float[NDArray, "c h w"],
    alpha: Float[NDArray, "h w"],
    weight: Float[NDArray, "h w"],
    directions: Float[NDArray, "2 2"],
) -> Float[NDArray, "c h w"]:
    """Replace the colour of pixels of low weight by a weighted mean of the seen pixels most similar to them.

    Every second pixel in each direction is compared with such pixels, and pixels between them are
    interpolated.

    Args:
        colour: bands of each pixel.
        alpha: brightness, in which pixels are compared together with their positions.
        weight: weight of each pixel's colour, 0 to 1; a pixel counts as seen above a half.
        directions: mean outer product of the unit vectors (x, y) along the segments that were searched;
            examples count as nearer along these.

    Returns:
        Colour at all pixels; seen ones keep theirs. The array `colour` itself if all are seen, or fewer of
        every second pixel than a mean takes.
    """
    seen = weight > SETTINGS.seen
    near = cv2.dilate((~seen).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    asked, seen_there = near[EVERY], seen[EVERY]
    step = max(1, int(np.ceil(np.sqrt(np.count_nonzero(seen_there) / SETTINGS.sources))))
    sources = np.zeros_like(seen_there)
    sources[::step, ::step] = seen_there[::step, ::step]
    if np.count_nonzero(sources) < SETTINGS.neighbours or not asked.any():
        return colour
    features = [(plane[sources], plane[asked]) for plane in _features(alpha, directions)]
    known, wanted = (np.stack(planes, 1) for planes in zip(*features))
    index, _ = nearest_points(known, wanted, SETTINGS.neighbours, SETTINGS.error)
    share = weight[EVERY][sources][index]
    share = (share / share.sum(1, keepdims=True)).astype(np.float32)
    out = np.empty_like(colour)
    for own, filled in zip(colour, out):
        plane = np.where(seen, own, 0)[EVERY]
        plane[asked] = np.einsum("nk,nk->n", plane[sources][index], share)
        filled[:] = np.where(seen, own, _between(plane, (alpha.shape[0], alpha.shape[1])))
    return out


def _between(plane: Plane, hw: tuple[int, int]) -> Plane:
    """Enlarge a plane of every second pixel, from the first, to all pixels, by linear interpolation."""
    back = np.array([[0.5, 0, 0], [0, 0.5, 0]], np.float32)
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    between: Plane = cv2.warpAffine(plane, back, (hw[1], hw[0]), flags=how, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[assignment]
    return between


def _features(alpha: Plane, directions: Float[NDArray, "2 2"]) -> Iterator[Plane]:
    """Yield brightness, its means and standard deviations in windows, and place, of every second pixel.

    They are scaled so that distances compare.
    """
    alpha = np.ascontiguousarray(alpha, np.float32)
    yield alpha[EVERY]
    for radius in SETTINGS.radii:
        side = (2 * radius + 1,) * 2
        mean, square = cv2.boxFilter(alpha, -1, side), cv2.boxFilter(alpha * alpha, -1, side)
        yield mean[EVERY]
        yield np.sqrt(np.maximum(square - mean * mean, 0))[EVERY]
    across, along = (1 / pixels**2 for pixels in SETTINGS.place)
    metric = across * np.eye(2) + (along - across) * directions
    rows, columns = 2 * np.indices(alpha[EVERY].shape, dtype=np.float32)
    for x, y in np.linalg.cholesky(metric).T.astype(np.float32):
        yield x * columns + y * rows
