"""Several bands of one beta: the combination of them that alpha sees, and how alpha's detail adds to each.

A mono alpha may see what no single band does. Matched by the bands' mean, a first, coarse matching gives the
combination of them is most like alpha; by that they are matched closely, and by how well it explains alpha the
bands are corrected together. All sums over bands are of sorted summands, so that their order cannot matter at all.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import Segments

from .colour_transfer import (
    MOST_DETAIL,
    at_matches,
    box_mean,
    is_consistent,
    local_slope,
    match_weight,
)
from .semi_global import (
    Normalisation,
    Normalisations,
    matched_at_half_size,
    reduced,
)

OUTLIER = 0.06
"""Difference from alpha at which a match counts 1 / e in the second of two fits."""
EQUAL = 1e-4
"""How strongly the combination is drawn to one of equal parts: share of the bands' mean variance."""
MISFIT = 0.016
"""Difference from alpha, averaged over `SMOOTH` pixels to either side, at which the combination counts half."""
SMOOTH = 4
ALIKE = 0.08
"""Where the combination's black and white are so near to alpha's, black is taken for black and white for white, and the
difference for that of two exposures."""
DILUTED = 0.8
"""Wrong matches make least squares' weights too small. They are enlarged until the combination varies as much as alpha,
as if no less than this share of alpha's variance were explained."""
WIDE = 4
"""Bands are compared with alpha within squares whose radius is the image's longer side over this."""


class SpectralMix(NamedTuple):
    """The combination of C bands that is most like alpha, for each of a batch: offset + sum of weights times bands.

    slopes: (B, C), by how much each band rises where the combination rises by 1 from one pixel to the next; less if
        that explains alpha badly.
    gain: (B), 0 to 1: how far what alpha has beyond the combination is the bands' error, and not another spectrum. 0
        for one band, where that cannot be known.
    """

    weights: Float[Tensor, "b c"]
    offset: Float[Tensor, " b"]
    slopes: Float[Tensor, "b c"]
    gain: Float[Tensor, " b"]

    @classmethod
    def equal(cls, bands: Float[Tensor, "b c _ _"]) -> SpectralMix:
        """The mean of the bands."""
        ones = torch.ones(bands.shape[:2], dtype=torch.float64, device=bands.device)
        return cls(ones / bands.shape[1], 0 * ones[:, 0], ones, 0 * ones[:, 0])

    @classmethod
    def fitted(
        cls, bands: Float[Tensor, "b c h w"], alpha: Float[Tensor, "b 1 h w"], weight: Float[Tensor, "b 1 h w"]
    ) -> SpectralMix:
        """The one most like alpha by weighted least squares, around each pixel's surroundings; twice, the second time
        without outliers."""
        parts = [_fit(*part) for part in zip(bands.double(), alpha.double(), weight.double())]
        return cls(*(torch.stack(part) for part in zip(*parts)))

    def of(self, bands: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 h w"]:
        """The combination of these bands."""
        products = self.weights[:, :, None, None] * bands.double()
        total = products.sort(1).values.sum(1, keepdim=True) + self.offset[:, None, None, None]
        return total.to(bands)

    def rises(self, like: Tensor) -> Float[Tensor, "b c 1 1"]:
        """The slopes."""
        return self.slopes[:, :, None, None].to(like)

    def reconciled(self, bands: Float[Tensor, "b c h w"], alpha: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b c h w"]:
        """The bands corrected so that their combination is nearer to alpha, by as much as it is reliable."""
        step = self.gain[:, None, None, None].to(bands) * self.rises(bands)
        return bands + step * (alpha - self.of(bands))


@torch.no_grad()
def coarse_mix(
    alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b c hb wb"], segments: Segments, blocks: Segments, factor: int
) -> SpectralMix:
    """The combination of beta's bands that is most like alpha, found on images reduced by `factor`.

    `segments` (B or 1, h / factor, w / factor) and `blocks` (half as many) are of the centres of blocks of alpha's
    pixels, in pixels of the whole beta.
    """
    if beta.shape[1] == 1:
        return SpectralMix.equal(beta)
    own, bands = avg_pool2d(alpha, factor), avg_pool2d(beta, factor)
    guide = SpectralMix.equal(bands).of(bands)
    normalisations = Normalisations.of(own, guide)
    disparity, facts = matched_at_half_size(own, guide, reduced(blocks, factor), normalisations.half)
    values, valid = at_matches(bands, reduced(segments, factor), disparity)
    return SpectralMix.fitted(values, normalisations.whole.softened(own), valid * is_consistent(facts))


@torch.no_grad()
def colours_of_bands(
    alpha: Float[Tensor, "b 1 h w"],
    beta: Float[Tensor, "b c hb wb"],
    segments: Segments,
    disparity: Float[Tensor, "b 1 h w"],
    facts: Float[Tensor, "b 3 h2 w2"],
    mix: SpectralMix,
    normalisation: Normalisation,
) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 1 h w"]]:
    """The bands minus alpha at matches that the mix has found, and their weight, 0 to 1."""
    values, valid = at_matches(beta, segments, disparity)
    colours, unlike = _matched(values, alpha, mix, normalisation)
    return colours, match_weight(unlike, is_consistent(facts), valid)


def _matched(values: Tensor, alpha: Tensor, mix: SpectralMix, normalisation: Normalisation) -> tuple[Tensor, Tensor]:
    """Bands minus alpha, with the detail that alpha has and they have not; how unlike alpha they are."""
    brightness, soft = mix.of(values), normalisation.softened(alpha)
    gain = mix.gain[:, None, None, None].to(alpha)
    beyond = (alpha - soft) + gain * (soft - brightness)
    rises = mix.rises(values)
    slope = rises + local_slope(values - rises * brightness, brightness)
    return values + slope * beyond.clamp(-MOST_DETAIL, MOST_DETAIL) - alpha, brightness - soft


def _fit(bands: Tensor, alpha: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weights, offset, slopes and gain for bands (C, h, w) and alpha (1, h, w)."""
    order = bands.flatten(1).sum(1).argsort()
    weight = weight + 1e-6
    first = robust = weight.flatten()
    x, y = (_local(planes, weight).flatten(1) for planes in (bands[order], alpha))
    for _ in range(2):
        share = robust / robust.sum()
        weights = _combination(x, y[0], share)
        rest = y[0] - weights @ x
        robust = first * torch.exp(-(rest / OUTLIER).square())
    explained = (1 - first @ rest.square() / (first @ y[0].square()).clamp(min=1e-12)).clamp(min=0)
    weights = weights / explained.clamp(min=DILUTED).sqrt()
    detail = _detail(bands[order]).flatten(1)
    combined = weights @ detail
    slopes = explained * (detail @ (share * combined)) / (share @ combined.square()).clamp(min=1e-12)
    gain = explained / (1 + (_smooth_misfit(rest.view_as(alpha), share.view_as(alpha)) / MISFIT) ** 6)
    offset = share @ (alpha.flatten() - weights @ bands[order].flatten(1))
    if max(abs(weights.sum() + offset - 1), abs(offset)) < ALIKE:
        weights, offset, slopes = weights / weights.sum(), 0 * offset, slopes * weights.sum()
    back = order.argsort()
    return weights[back], offset, slopes[back], gain


def _detail(planes: Tensor) -> Tensor:
    """What pixels of (c, h, w) have beyond the mean of those around: how materials differ does not count."""
    return planes - avg_pool2d(planes[None], 3, 1, 1, count_include_pad=False)[0]


def _local(planes: Tensor, weight: Tensor) -> Tensor:
    """Planes (c, h, w) less their weighted mean in wide squares: light and lenses differ between views, slowly."""
    radius = max(planes.shape[-2:]) // WIDE
    mean = partial(box_mean, radius=radius)
    return planes - (mean((planes * weight)[None]) / mean(weight[None]))[0]


def _combination(x: Tensor, y: Tensor, share: Tensor) -> Tensor:
    """Weights (C) with which bands x (C, n) make y (n), both about 0; drawn to equal ones."""
    mean = x.mean(0)
    scale = (share @ y.square()).sqrt() / (share @ mean.square()).sqrt().clamp(min=1e-3)
    equal = scale.expand(len(x)) / len(x)
    covariance = x * share @ x.T
    ridge = (EQUAL * covariance.trace() / len(x) + 1e-12) * torch.eye(len(x)).to(x)
    return equal + torch.linalg.solve(covariance + ridge, x * share @ (y - equal @ x))


def _smooth_misfit(rest: Tensor, share: Tensor) -> Tensor:
    """Root mean square of the rest (1, h, w) averaged around each pixel: errors of matches, at edges, average out."""

    def mean(plane: Tensor) -> Tensor:
        return avg_pool2d(plane[None], 2 * SMOOTH + 1, 1, SMOOTH, count_include_pad=False)[0]

    smooth = mean(share * rest) / mean(share).clamp(min=1e-12)
    return (share * smooth.square()).sum().sqrt()
