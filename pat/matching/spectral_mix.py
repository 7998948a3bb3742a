"""The combination of any bands of beta that alpha sees.

Alpha is explained as offset + weights . beta around each pixel, and the addition of alpha's detail to each is
estimated too. All sums over such bands are of sorted summands, so that their order cannot matter at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.robust import RobustFit, gaussian, least_squares, robust_least_squares

from ..media.filters import box_mean
from ..support.settings import size, tuned
from .normalisation import UNLIKE


@dataclass(frozen=True)
class MixSettings:
    """Settings of the fit of bands to alpha; brightness is 0 to 1.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    equal: float = size(
        1e-4, "Share of the bands' mean variance by which the combination is drawn to equal parts"
    )
    misfit: float = tuned(
        0.016,
        "Source not recorded: difference from alpha, averaged around, at which the combination counts half",
    )
    smooth: int = size(4, "Pixels to either side over which `misfit` is averaged")
    diluted: float = tuned(
        0.8,
        "Source not recorded: wrong matches make least squares' weights too small; they are enlarged until "
        "the combination varies as much as alpha, "
        "as if no less than this share of alpha's variance were explained",
    )
    coarsely: int = size(400_000, "Alpha's pixels at most on which the combination is found")
    wide: int = size(4, "The image's longer side over the radius in which bands are compared")


SETTINGS = MixSettings()


class SpectralMix(NamedTuple):
    """Linear combination of C bands that is most similar to alpha: offset + sum of weights times bands.

    Attributes:
        weights: weight of each band (B, C).
        offset: offset (B).
        slopes: change of each band (B, C) by a local one of 1 in the mix; less if that explains alpha badly.
        gain: share (B), 0 to 1, of alpha's difference from the combination that is an error of the bands, and
            not another spectrum; 0 for the mean of bands (`equal`), of which that is not known.
    """

    weights: Float[Tensor, "b c"]
    offset: Float[Tensor, " b"]
    slopes: Float[Tensor, "b c"]
    gain: Float[Tensor, " b"]

    @classmethod
    def equal(cls, bands: Float[Tensor, "b c _ _"]) -> SpectralMix:
        """Return the mean of the bands."""
        ones = torch.ones(bands.shape[:2], dtype=torch.float64, device=bands.device)
        return cls(ones / bands.shape[1], 0 * ones[:, 0], ones, 0 * ones[:, 0])

    @classmethod
    def fitted(
        cls,
        bands: Float[Tensor, "b c h w"],
        alpha: Float[Tensor, "b 1 h w"],
        weight: Float[Tensor, "b 1 h w"],
    ) -> SpectralMix:
        """Fit the combination most similar to alpha by weighted least squares, relative to local means.

        It is fitted twice, the second time without outliers; where black and white then are about alpha's,
        the weights are scaled to a sum of 1, and the offset is 0.

        Args:
            bands: beta's bands at alpha's pixels.
            alpha: alpha, no sharper than the bands.
            weight: weight of each pixel, at least 0.

        Returns:
            The combination for each of the batch, float64.
        """
        parts = [_mix(*tensors) for tensors in zip(bands.double(), alpha.double(), weight.double())]
        return cls(*(torch.stack(tensors) for tensors in zip(*parts)))

    def combined(self, bands: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 h w"]:
        """Return the combination of these bands."""
        products = self.weights[:, :, None, None] * bands.double()
        total = products.sort(1).values.sum(1, keepdim=True) + self.offset[:, None, None, None]
        return total.to(bands)

    def rises(self, like: Tensor) -> Float[Tensor, "b c 1 1"]:
        """Return the slopes, in the type of `like`."""
        return self.slopes[:, :, None, None].to(like)

    def reconciled(
        self, bands: Float[Tensor, "b c h w"], alpha: Float[Tensor, "b 1 h w"]
    ) -> Float[Tensor, "b c h w"]:
        """Return the bands corrected so that their combination nears alpha, as far as that is reliable."""
        step = self.gain[:, None, None, None].to(bands) * self.rises(bands)
        return bands + step * (alpha - self.combined(bands))


def _mix(bands: Tensor, alpha: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return weights, offset, slopes and gain for bands (C, h, w) and alpha (1, h, w)."""
    order = bands.flatten(1).sum(1).argsort()
    weight = weight + 1e-6
    x, y = (_beyond_local_mean(planes, weight).flatten(1) for planes in (bands[order], alpha))
    weights, rest, share = _combination(x, y[0], weight.flatten())
    unexplained = weight.flatten() @ rest.square() / (weight.flatten() @ y[0].square()).clamp(min=1e-12)
    explained = (1 - unexplained).clamp(min=0)
    weights = weights / explained.clamp(min=SETTINGS.diluted).sqrt()
    # What pixels have beyond the mean of those around: how materials differ does not count.
    detail = (bands[order] - box_mean(bands[order], 1)).flatten(1)
    combined = weights @ detail
    slopes = explained * (detail @ (share * combined)) / (share @ combined.square()).clamp(min=1e-12)
    misfit = _smooth_misfit(rest.view_as(alpha), share.view_as(alpha))
    gain = explained / (1 + (misfit / SETTINGS.misfit) ** 6)
    offset = share @ (alpha.flatten() - weights @ bands[order].flatten(1))
    if max(abs(weights.sum() + offset - 1), abs(offset)) < UNLIKE:
        # Black is about as bright as black, and white as white: what is left is of two exposures.
        weights, offset, slopes = weights / weights.sum(), 0 * offset, slopes * weights.sum()
    back = order.argsort()
    return weights[back], offset, slopes[back], gain


def _combination(x: Tensor, y: Tensor, weight: Tensor) -> RobustFit:
    """Return weights (C) by which bands x (C, n) make y (n), drawn to equal; then without outliers."""
    share, mean = weight / weight.sum(), x.mean(0)
    scale = (share @ y.square()).sqrt() / (share @ mean.square()).sqrt().clamp(min=1e-3)
    equal = scale.expand(len(x)) / len(x)
    ridge = SETTINGS.equal * (share @ x.square().mean(0)) + 1e-12
    precision, beyond = ridge * torch.eye(len(x)).to(x), y - equal @ x

    def weigh(rest: Tensor) -> Tensor:
        robust = weight * gaussian(rest, UNLIKE)
        return robust / robust.sum()

    start = least_squares(x, beyond, share, precision)
    weights = robust_least_squares(x, beyond, start, weigh, precision=precision, steps=1)
    return weights._replace(coefficients=equal + weights.coefficients)


def _beyond_local_mean(planes: Tensor, weight: Tensor) -> Tensor:
    """Return planes (c, h, w) less their weighted mean in wide squares: light of views differs slowly."""
    radius = max(planes.shape[-2:]) // SETTINGS.wide
    return planes - box_mean(planes * weight, radius) / box_mean(weight, radius)


def _smooth_misfit(rest: Tensor, share: Tensor) -> Tensor:
    """Return the root mean square of the rest (1, h, w) averaged around: errors at edges cancel out."""
    total = box_mean(share, SETTINGS.smooth).clamp(min=1e-12)
    smooth = box_mean(share * rest, SETTINGS.smooth) / total
    return (share * smooth.square()).sum().sqrt()
