"""Images made comparable: their moments (whole, where a weight is, and local), and their sharpness."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..media.colour import luminance, to_bytes
from ..support.settings import size
from .filters import blurred
from .positions import FINE
from .spectral_mix import SpectralMix

LEAST_WEIGHT = 1e-6
"""Size: added to weights, so that there are moments where all are 0."""


@dataclass(frozen=True)
class NormalisationSettings:
    """How far one image is brought to another's brightness and sharpness."""

    largest_gain: float = size(4.0, "Of brightness; images that differ by more show different things")
    blurs: tuple[float, ...] = size(
        (0.4, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0),
        "Standard deviations, pixels, tried on the sharper image until it is no sharper than the other",
    )


SETTINGS = NormalisationSettings()


class Moments(NamedTuple):
    """Mean and standard deviation of images, over their last three dimensions, which are kept."""

    mean: Tensor
    deviation: Tensor

    def gain(self, wanted: Moments, largest: float) -> Tensor:
        """The factor that makes the standard deviation the wanted one."""
        return (wanted.deviation / self.deviation.clamp(min=1e-6)).clamp(max=largest)

    def matched(self, image: Tensor, wanted: Moments, largest_gain: float = math.inf) -> Tensor:
        """An image of these moments, with the wanted ones; not cut to 0..1."""
        return (image - self.mean) * self.gain(wanted, largest_gain) + wanted.mean


def moments(image: Float[Tensor, "*b c h w"], weight: Float[Tensor, "*b 1 h w"] | None = None) -> Moments:
    """The moments of whole images, or where the weight is."""
    if weight is None:
        deviation, mean = torch.std_mean(image, (-3, -2, -1), keepdim=True)
        return Moments(mean, deviation)
    mean = _weighted_mean(image, weight)
    return Moments(mean, _weighted_mean((image - mean).square(), weight).sqrt())


def normalised(
    image: Float[Tensor, "*b c h w"],
    like: Float[Tensor, "*b d hl wl"],
    weight: Float[Tensor, "*b 1 h w"] | None = None,
    *,
    largest_gain: float = math.inf,
) -> Float[Tensor, "*b c h w"]:
    """The image with another's mean and standard deviation.

    With a weight, where that is: both show the same point at a pixel there. Statistics of whole images mean
    little where these show different parts of a scene.
    """
    return moments(image, weight).matched(image, moments(like, weight), largest_gain)


def mean_moments(images: Iterable[Float[Tensor, "c h w"]]) -> Moments:
    """The means of several images' moments."""
    return Moments(*(torch.stack(tensors).mean(0) for tensors in zip(*map(moments, images))))


def explained_share(
    image: Float[Tensor, "b 1 h w"], of: Float[Tensor, "b 1 h w"], weight: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 1 1 1"]:
    """The share of one image's variance another explains where weighted, 0 if one is the other's negative.

    Small for an alpha in the near infrared: its detail says little of visible colours.
    """
    a, b = (p - _weighted_mean(p, weight) for p in (image, of))
    common, one, other = (_weighted_mean(p, weight) for p in (a * b, a * a, b * b))
    return common.clamp(min=0).square() / (one * other + 1e-9)


def _weighted_mean(image: Tensor, weight: Tensor) -> Float[Tensor, "*b 1 1 1"]:
    weight = weight + LEAST_WEIGHT
    return (weight / weight.sum((-3, -2, -1), keepdim=True) * image).sum((-3, -2, -1), keepdim=True)


class ComparedViews(NamedTuple):
    """Alpha and beta for comparison, (B, 1, ., .), equally bright and sharp; alpha in 8 bits (B, h, w); and
    the standard deviation, in pixels, by which each alpha was blurred to be as sharp as beta."""

    alpha: Tensor
    beta: Tensor
    guides: NDArray[np.uint8]
    blurs: Sequence[float]


class Normalisation(NamedTuple):
    """How beta's brightness is normalised to alpha's, and how either is then blurred, for each of a batch.

    level: (3, B, 1, 1, 1): what is subtracted from beta, the factor, what is added.
    blurs: standard deviations for alpha, and for beta, in pixels; 0 for the one that is not the sharper.
    """

    level: Tensor
    blurs: tuple[list[float], list[float]]

    @classmethod
    def of(cls, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b 1 hb wb"]) -> Normalisation:
        """What makes the means and standard deviations the same, and then the sharpness."""
        measured, wanted = moments(beta), moments(alpha)
        level = torch.stack([measured.mean, measured.gain(wanted, SETTINGS.largest_gain), wanted.mean])
        return cls(level, equalising_blurs(alpha, measured.matched(beta, wanted, SETTINGS.largest_gain)))

    def normalised(self, beta: Tensor) -> Tensor:
        """Beta's brightness (or that of a part of it) with alpha's mean and standard deviation."""
        mean, factor, middle = self.level.to(beta)
        return (beta - mean) * factor + middle

    def softened(self, alpha: Tensor) -> Tensor:
        """Alpha (or a part of it), no sharper than beta."""
        return blurred(alpha, self.blurs[0])

    def views(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b 1 hb wb"]) -> ComparedViews:
        """Alpha and beta's brightness, or parts of them, as they are compared."""
        other = blurred(self.normalised(beta), self.blurs[1])
        return ComparedViews(self.softened(alpha), other, to_bytes(alpha[:, 0]), self.blurs[0])


@torch.no_grad()
def equalising_blurs(
    image: Float[Tensor, "b 1 h w"], other: Float[Tensor, "b 1 hb wb"]
) -> tuple[list[float], list[float]]:
    """Standard deviations to blur either with until it is as sharp as the other; 0 for the less sharp.

    Detail that only one has cannot be matched.
    """
    image_sharpness, other_sharpness = ([_sharpness(p) for p in images] for images in (image, other))
    return [_equal_blur(p, s) for p, s in zip(image, other_sharpness)], [
        _equal_blur(p, s) for p, s in zip(other, image_sharpness)
    ]


def _equal_blur(image: Float[Tensor, "1 h w"], wanted: float) -> float:
    """The blur after which an image is so sharp: sharpness falls exponentially between two of the blurs."""
    less, before = 0.0, _sharpness(image)
    if before <= wanted:
        return less
    for blur in SETTINGS.blurs:
        after = _sharpness(blurred(image[None], [blur])[0])
        if after <= wanted:
            return less + (blur - less) * math.log(before / wanted) / math.log(before / after)
        less, before = blur, after
    return less


def _sharpness(image: Float[Tensor, "1 h w"]) -> float:
    """The mean second difference of the means of 2 x 2 pixels: of fine detail, which blur takes first, and
    where noise counts less than from pixel to pixel. First differences are of coarser detail, too. None along
    a side of less than 6 pixels."""
    half = avg_pool2d(image, FINE)
    differences = (half.diff(n=2, dim=axis).abs() for axis in (-1, -2))
    return sum(float(difference.mean()) for difference in differences if difference.numel()) + 1e-9


class Comparison(NamedTuple):
    """What of a beta's bands is compared with alpha, and how that is brought to alpha's level and sharpness.

    mix: the combination of bands that alpha sees; None: Rec. 601 luma of three bands, the mean of others.
    whole, half: how the combination is normalised, and the same at half the size.
    """

    mix: SpectralMix | None
    whole: Normalisation
    half: Normalisation

    @classmethod
    def of(
        cls, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b c hb wb"], mix: SpectralMix | None = None
    ) -> Comparison:
        """That of whole images of even sides, by this mix."""
        other = combined_bands(beta, mix)
        half = Normalisation.of(avg_pool2d(alpha, 2), avg_pool2d(other, 2))
        return cls(mix, Normalisation.of(alpha, other), half)

    def combined(self, beta: Float[Tensor, "b c hb wb"]) -> Float[Tensor, "b 1 hb wb"]:
        """The combination of beta's bands, or of a part of it."""
        return combined_bands(beta, self.mix)

    def views(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b c hb wb"]) -> ComparedViews:
        """Alpha and the combination of beta's bands, or parts of them, as they are compared."""
        return self.whole.views(alpha, self.combined(beta))

    def half_views(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b c hb wb"]) -> ComparedViews:
        """The same at half the size."""
        return self.half.views(avg_pool2d(alpha, 2), avg_pool2d(self.combined(beta), 2))


def combined_bands(
    beta: Float[Tensor, "b c h w"], mix: SpectralMix | None = None
) -> Float[Tensor, "b 1 h w"]:
    """The bands as this mix combines them; without one Rec. 601 luma of three bands, the mean of others."""
    if mix is not None:
        return mix.of(beta)
    return luminance(beta) if beta.shape[1] == 3 else beta.mean(1, keepdim=True)
