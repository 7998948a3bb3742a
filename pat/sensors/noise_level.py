"""Noise of a camera's image: stated, or estimated from the image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d, pad

from ..media.colour import linear_from_srgb, srgb_from_linear
from .steps import normal

AddedTo = Literal["light", "values"]
"""Domain of the noise: linear light, which is sRGB-encoded afterwards, or the values themselves."""

CURVE = 65
"""Ideal values, and quantiles of the noise, at which mean and deviation of recorded values are tabulated."""
SMOOTHED = 7
"""Side in pixels of the window over which the signal is averaged."""
SIDE, GROUPS, FEWEST = 12, 16, 40
"""Blocks for the estimate: their side in pixels, groups of about equal value, least blocks in a group."""
SMOOTHEST, SHARE = 0.05, 0.677
"""Quantile of a group's variances that stands for noise alone, and its ratio to the variance of white noise
(measured on 40,000 blocks of it)."""


@dataclass(frozen=True)
class NoiseLevel:
    """Noise model of a camera: the variance of a pixel of value v is shot · v + read².

    Attributes:
        shot: variance for each unit of v, which is 1 at white; a number, or (B, 1, 1, 1) for a batch.
        read: standard deviation of the read noise, in the unit of v; number or batch as `shot`.
        added_to: "light" where v is linear light, sRGB-encoded afterwards; "values" where v is the image's
            value itself.

    Raises:
        ValueError: for a `shot` or `read` that is negative, infinite or NaN, or another `added_to`.
    """

    shot: float | Tensor = 0.0
    read: float | Tensor = 0.0
    added_to: AddedTo = "light"

    def __post_init__(self) -> None:
        if self.added_to not in get_args(AddedTo):
            raise ValueError(f"noise: added_to is light or values, got '{self.added_to}'")
        for name in ("shot", "read"):
            value = torch.as_tensor(getattr(self, name))
            if not bool(((value >= 0) & value.isfinite()).all()):
                raise ValueError(f"noise: {name} must be 0 or more, got {getattr(self, name)}")

    @classmethod
    def from_electrons(cls, electrons: float, read: float = 0.0, added_to: AddedTo = "light") -> NoiseLevel:
        """Make the noise model of a camera that counts `electrons` at white.

        Args:
            electrons: electrons that a pixel counts at value 1.
            read: standard deviation of the read noise in electrons.
            added_to: "light" or "values", as for the class.

        Returns:
            The noise level: shot 1 / `electrons`, read `read` / `electrons`.

        Raises:
            ValueError: for fewer than 1 electron at white, and as the class raises it.
        """
        if not electrons >= 1:
            raise ValueError(
                f"noise: electrons at white must be 1 or more, such as 200, got {electrons:g}: "
                "state how many a pixel counts at white, not a standard deviation, "
                "or have the noise estimated"
            )
        if read < 0:
            raise ValueError(f"noise: read must be 0 or more, got {read:g}: state it in electrons")
        return cls(1 / electrons, read / electrons, added_to)

    @classmethod
    @torch.no_grad()
    def estimated(cls, image: Float[Tensor, "1 c h w"]) -> NoiseLevel:
        """Estimate an sRGB image's noise, taken as white, from its smoothest parts at each brightness.

        The smallest second differences of a group of blocks are taken as noise alone; the better fit of noise
        in light and noise in values is chosen. Noise that demosaicing, resampling or a codec has smoothed is
        underestimated; fine texture all over the image is taken for noise.

        Args:
            image: values 0..1, which is not checked; blocks with several black pixels, or
                brighter than .95, are left out.

        Returns:
            The noise level, one for all channels; zero if a side is under 14 pixels, no block is left, or the
            smoothest blocks have no variation.
        """
        if min(image.shape[-2:]) < SIDE + 2:
            return cls()
        value, variance = (part.cpu() for part in _smoothest(image.double()))
        if not len(value) or not float(variance.max()) > 0:
            return cls()
        fits = [_fitted(added_to, value, variance) for added_to in ("light", "values")]
        return min(fits, key=lambda fit: fit[1])[0]

    def recorded(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """Add this noise to an ideal sRGB image: Poisson counts plus normal read noise, clipped to 0..1.

        Args:
            image: sRGB values without NaN.
            generator: random generator on the image's device.

        Returns:
            The noisy sRGB image, of the same shape. Up to a `shot` of 1e-7 there is read noise alone; above,
            no gradient reaches `image`.
        """
        linear = self.added_to == "light"
        light = linear_from_srgb(image) if linear else image
        shot, read = (torch.as_tensor(x, dtype=light.dtype).to(light) for x in (self.shot, self.read))
        expected = (light.clamp(min=0) / shot.clamp(min=1e-9)).clamp(max=1e7)
        counted = torch.poisson(expected, generator=generator) * shot
        light = torch.where(shot > 1e-7, counted, light) + read * normal(light.shape, light, generator)
        return srgb_from_linear(light.clamp(0, 1)) if linear else light.clamp(0, 1)

    def deviation(self, image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Compute the standard deviation of a noisy sRGB image's values by the brightness around each."""
        _, mean, deviation = self._curves(image)
        return _interpolated(_smoothed(image), mean, deviation)

    def unbiased(self, image: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Correct the bias of a noisy sRGB image, so that local means come near the ideal image's.

        Clipping at black makes the mean too bright, the more so with read noise; sRGB encoding makes it too
        dark. Denoisers that average values keep this bias. The noise is taken as normal: dark parts keep some
        bias where pixels count few electrons.

        Returns:
            The corrected sRGB image, of the same shape; not clipped.
        """
        value, mean, _ = self._curves(image)
        return image + _interpolated(_smoothed(_smoothed(image)), mean, value - mean)

    def _curves(self, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Ideal values with mean and deviation of their recorded values, for noise taken as normal."""
        value = torch.linspace(0, 1, CURVE, device=like.device).to(like)
        normal = torch.special.ndtri((torch.arange(CURVE, device=like.device).to(like) + 0.5) / CURVE)
        shot, read = (torch.as_tensor(x).to(like).reshape(-1, 1, 1) for x in (self.shot, self.read))
        light = (linear_from_srgb(value) if self.added_to == "light" else value)[:, None]
        noisy = (light + (shot * light + read**2).sqrt() * normal).clamp(0, 1)
        recorded = srgb_from_linear(noisy) if self.added_to == "light" else noisy
        curves = value.expand(len(shot), -1), recorded.mean(-1), recorded.std(-1, correction=0)
        return tuple(curve.expand(len(like), -1) for curve in curves)  # type: ignore[return-value]


def _interpolated(x: Tensor, positions: Float[Tensor, "b n"], values: Float[Tensor, "b n"]) -> Tensor:
    """Interpolate values at increasing positions, at the entries of x (B, ...); constant beyond the ends."""
    flat = x.flatten(1).clamp(positions[:, :1], positions[:, -1:])
    i = torch.searchsorted(positions.contiguous(), flat.contiguous()).clamp(1, positions.shape[1] - 1)
    low, high = positions.gather(1, i - 1), positions.gather(1, i)
    share = (flat - low) / (high - low).clamp(min=1e-9)
    return torch.lerp(values.gather(1, i - 1), values.gather(1, i), share.clamp(0, 1)).reshape(x.shape)


def _smoothed(image: Tensor) -> Tensor:
    r = SMOOTHED // 2
    return avg_pool2d(pad(image, (r, r, r, r), mode="replicate"), SMOOTHED, 1)


def _smoothest(image: Float[Tensor, "1 c h w"]) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Brightness and noise variance of the least varying blocks at each of some brightnesses."""
    inner = image[..., 1:-1, 1:-1]
    rough = avg_pool2d((image.diff(n=2, dim=-1).diff(n=2, dim=-2) / 6).square(), SIDE)
    mean, empty = avg_pool2d(inner, SIDE), avg_pool2d((inner <= 0).to(inner), SIDE)
    unclipped = (empty < 0.02) & (mean < 0.95)
    mean, rough = mean[unclipped], rough[unclipped]
    groups = mean.argsort().split(max(-(-len(mean) // GROUPS), FEWEST)) if len(mean) else ()
    values = [mean[group].median() for group in groups]
    variances = [rough[group].quantile(SMOOTHEST) / SHARE for group in groups]
    return torch.stack([*values, mean.new_zeros(())])[:-1], torch.stack([*variances, mean.new_zeros(())])[:-1]


def _fitted(added_to: AddedTo, value: Tensor, variance: Tensor) -> tuple[NoiseLevel, float]:
    """Noise level by least squares of relative errors, and its mean squared logarithmic error."""
    signal, slope = value, torch.ones_like(value)
    if added_to == "light":
        signal = linear_from_srgb(value)
        slope = (srgb_from_linear(signal * 1.01 + 1e-4) - value) / (0.01 * signal + 1e-4)
    weight = slope**2 / variance.clamp(min=1e-10)
    design = torch.stack([signal, torch.ones_like(signal)], -1) * weight[:, None]
    wanted = torch.ones_like(value)[:, None]
    free = torch.linalg.lstsq(design, wanted).solution
    design = design * (free >= 0).mT  # what would be negative is 0, and the other is fitted alone
    shot, read = torch.linalg.lstsq(design, wanted, driver="gelsd").solution.clamp(min=0)[:, 0].tolist()
    error = float((design @ design.new_tensor([shot, read])).clamp(min=1e-6).log().square().mean())
    return NoiseLevel(shot, math.sqrt(read), added_to), error
