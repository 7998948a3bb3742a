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
from .band_mix import SpectralMix
from .filters import blurred
from .positions import FINE

LEAST_WEIGHT = 1e-6
"""Size: added to weights, so that there are moments where all are 0."""


@dataclass(frozen=True)
class NormalisationSettings:
    """Settings of the normalisation of one image's brightness and sharpness to another's.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    largest_gain: float = size(4.0, "Of brightness; images that differ by more show different things")
    blurs: tuple[float, ...] = size(
        (0.4, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0),
        "Standard deviations, pixels, tried on the sharper image until it is no sharper than the other",
    )


SETTINGS = NormalisationSettings()


class Moments(NamedTuple):
    """Mean and standard deviation of images, over their last three dimensions.

    Attributes:
        mean: means (*b, 1, 1, 1).
        deviation: standard deviations (*b, 1, 1, 1).
    """

    mean: Tensor
    deviation: Tensor

    def gain(self, wanted: Moments, largest: float) -> Tensor:
        """Return the factor that makes the standard deviation the wanted one, at most `largest`."""
        return (wanted.deviation / self.deviation.clamp(min=1e-6)).clamp(max=largest)

    def matched(self, image: Tensor, wanted: Moments, largest_gain: float = math.inf) -> Tensor:
        """Return an image of these moments with the wanted ones; not clipped to 0..1."""
        return (image - self.mean) * self.gain(wanted, largest_gain) + wanted.mean


def moments(image: Float[Tensor, "*b c h w"], weight: Float[Tensor, "*b 1 h w"] | None = None) -> Moments:
    """Compute the moments of whole images, or, of one band, of the pixels with weight."""
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
    """Return an image with another's mean and, up to `largest_gain`, standard deviation, all bands together.

    Statistics of whole images mean little where these show different parts of a scene.

    Args:
        image: image to change.
        like: image whose mean and standard deviation are wanted.
        weight: weight of pixels at which both show the same point, for images of one size and one band; None
            for whole images.
        largest_gain: largest factor of the standard deviation.

    Returns:
        The image, scaled and shifted as a whole, not clipped; a flat image stays flat.
    """
    return moments(image, weight).matched(image, moments(like, weight), largest_gain)


def mean_moments(images: Iterable[Float[Tensor, "c h w"]]) -> Moments:
    """Compute the means of several images' moments."""
    return Moments(*(torch.stack(tensors).mean(0) for tensors in zip(*map(moments, images))))


def explained_share(
    image: Float[Tensor, "b 1 h w"], of: Float[Tensor, "b 1 h w"], weight: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 1 1 1"]:
    """Compute the weighted share of one image's variance that a linear regression on another explains.

    It is the squared correlation, and small for an alpha in the near infrared, whose detail says little of
    visible colours.

    Args:
        image: image to explain.
        of: image to explain it by.
        weight: weight of each pixel, at least 0.

    Returns:
        Share for each of the batch, 0 to 1; 0 for a negative correlation or a flat image.
    """
    a, b = (p - _weighted_mean(p, weight) for p in (image, of))
    common, one, other = (_weighted_mean(p, weight) for p in (a * b, a * a, b * b))
    return common.clamp(min=0).square() / (one * other + 1e-9)


def _weighted_mean(image: Tensor, weight: Tensor) -> Float[Tensor, "*b 1 1 1"]:
    weight = weight + LEAST_WEIGHT
    return (weight / weight.sum((-3, -2, -1), keepdim=True) * image).sum((-3, -2, -1), keepdim=True)


class ComparedViews(NamedTuple):
    """Alpha and beta for comparison, equally bright and sharp.

    Attributes:
        alpha: alpha's image (B, 1, h, w), blurred where it is the sharper one.
        beta: combination of beta's bands (B, 1, hb, wb), normalised; blurred where it is the sharper one.
        guides: alpha before it is blurred, in 8 bits, (B, h, w).
        blurs: standard deviation of each alpha's blur, pixels; 0 where it is not blurred.
    """

    alpha: Tensor
    beta: Tensor
    guides: NDArray[np.uint8]
    blurs: Sequence[float]


class Normalisation(NamedTuple):
    """Normalisation of beta's brightness to alpha's, and blur of the sharper one, for each of a batch.

    Attributes:
        level: (3, B, 1, 1, 1), the value subtracted from beta, the factor, the value added.
        blurs: standard deviations for alpha, and for beta, in pixels; 0 for the one that is not the sharper.
    """

    level: Tensor
    blurs: tuple[list[float], list[float]]

    @classmethod
    def from_images(cls, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b 1 hb wb"]) -> Normalisation:
        """Estimate the normalisation that makes means and standard deviations equal, and then the
        sharpness."""
        measured, wanted = moments(beta), moments(alpha)
        level = torch.stack([measured.mean, measured.gain(wanted, SETTINGS.largest_gain), wanted.mean])
        return cls(level, equalising_blurs(alpha, measured.matched(beta, wanted, SETTINGS.largest_gain)))

    def normalised(self, beta: Tensor) -> Tensor:
        """Return brightness of beta, or a part, with alpha's mean and (up to `largest_gain`) deviation."""
        mean, factor, middle = self.level.to(beta)
        return (beta - mean) * factor + middle

    def softened(self, alpha: Tensor) -> Tensor:
        """Return alpha (or a part of it), no sharper than beta."""
        return blurred(alpha, self.blurs[0])

    def views(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b 1 hb wb"]) -> ComparedViews:
        """Return alpha and beta's brightness, or parts of them, as they are compared."""
        other = blurred(self.normalised(beta), self.blurs[1])
        return ComparedViews(self.softened(alpha), other, to_bytes(alpha[:, 0]), self.blurs[0])


@torch.no_grad()
def equalising_blurs(
    image: Float[Tensor, "b 1 h w"], other: Float[Tensor, "b 1 hb wb"]
) -> tuple[list[float], list[float]]:
    """Compute the Gaussian blurs that make two images equally sharp: detail of one alone cannot be matched.

    Returns:
        Standard deviations in pixels for each image of the batch, of `image` and of `other`; 0 for the one
        that is not the sharper, at most the largest of `SETTINGS.blurs`.
    """
    image_sharpness, other_sharpness = ([_sharpness(p) for p in images] for images in (image, other))
    return [_equal_blur(p, s) for p, s in zip(image, other_sharpness)], [
        _equal_blur(p, s) for p, s in zip(other, image_sharpness)
    ]


def _equal_blur(image: Float[Tensor, "1 h w"], wanted: float) -> float:
    """Return the blur after which an image is so sharp; sharpness falls exponentially between two blurs."""
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
    """Return the mean second difference of the means of 2 x 2 pixels; 0 along a side of less than 6 pixels.

    It is of fine detail, which blur takes first, and where noise counts less than from pixel to pixel. First
    differences are of coarser detail, too.
    """
    half = avg_pool2d(image, FINE)
    differences = (half.diff(n=2, dim=axis).abs() for axis in (-1, -2))
    return sum(float(difference.mean()) for difference in differences if difference.numel()) + 1e-9


class Comparison(NamedTuple):
    """Combination of a beta's bands that is compared with alpha, and its normalisation to alpha.

    Attributes:
        mix: combination of bands that alpha sees; None for Rec. 601 luma of three bands, the mean of others.
        whole: normalisation of the combination.
        half: normalisation of the combination at half the size.
    """

    mix: SpectralMix | None
    whole: Normalisation
    half: Normalisation

    @classmethod
    def from_images(
        cls, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b c hb wb"], mix: SpectralMix | None = None
    ) -> Comparison:
        """Estimate the comparison of whole images of even sides, by this mix."""
        other = combined_bands(beta, mix)
        half = Normalisation.from_images(avg_pool2d(alpha, 2), avg_pool2d(other, 2))
        return cls(mix, Normalisation.from_images(alpha, other), half)

    def combined(self, beta: Float[Tensor, "b c hb wb"]) -> Float[Tensor, "b 1 hb wb"]:
        """Return the combination of beta's bands, or of a part of it."""
        return combined_bands(beta, self.mix)

    def views(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b c hb wb"]) -> ComparedViews:
        """Return alpha and the combination of beta's bands, or parts of them, as they are compared."""
        return self.whole.views(alpha, self.combined(beta))

    def half_views(self, alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b c hb wb"]) -> ComparedViews:
        """Return the same at half the size."""
        return self.half.views(avg_pool2d(alpha, 2), avg_pool2d(self.combined(beta), 2))


def combined_bands(
    beta: Float[Tensor, "b c h w"], mix: SpectralMix | None = None
) -> Float[Tensor, "b 1 h w"]:
    """Combine the bands by a mix; without one return Rec. 601 luma of three bands, the mean of others."""
    if mix is not None:
        return mix.combined(beta)
    return luminance(beta) if beta.shape[1] == 3 else beta.mean(1, keepdim=True)
