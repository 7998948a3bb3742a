"""The sensor: exposure, noise, saturation, digits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from .chain import Step, normal


@dataclass(frozen=True)
class Exposure(Step):
    """Linear light times a gain: exposure time, aperture and amplification together."""

    gain: float | Tensor

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        return image * self.gain


@dataclass(frozen=True)
class Noise(Step):
    """Shot and read noise, on linear values of which 1 stands for `full_well` electrons; `read` in electrons.

    Variance in electrons is the signal plus `read`^2. "gaussian" draws from a normal of that variance, and is
    differentiable; "poisson" counts electrons (whole numbers before the read noise), which differs visibly
    below about ten of them; its gradient is that of the mean.
    """

    full_well: float
    read: float = 0.0
    counts: Literal["gaussian", "poisson"] = "gaussian"

    def __post_init__(self) -> None:
        if self.full_well <= 0 or self.read < 0:
            raise ValueError(
                f"noise: wanted full_well > 0 and read >= 0 electrons, got {self.full_well:g} and {self.read:g}"
            )

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        if self.counts == "poisson":
            return self._counted(image, generator)
        variance = (image.clamp(min=0) * self.full_well + self.read**2) / self.full_well**2
        return image + (variance + 1e-20).sqrt() * normal(image.shape, image, generator)

    def _counted(self, image: Tensor, generator: Generator) -> Tensor:
        expected = (image.detach().clamp(min=0) * self.full_well).to(generator.device)
        electrons = torch.poisson(expected, generator=generator).to(image)
        electrons = electrons + self.read * normal(image.shape, image, generator)
        return image + (electrons / self.full_well - image).detach()


@dataclass(frozen=True)
class Clip(Step):
    """Saturation: values clipped to 0..1."""

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        return image.clamp(0, 1)


@dataclass(frozen=True)
class Quantise(Step):
    """Clipped to 0..1 and rounded to 2^bits levels. The gradient passes as if nothing were rounded."""

    bits: int = 8

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        levels = 2**self.bits - 1
        clipped = image.clamp(0, 1)
        return clipped + ((clipped * levels).round() / levels - clipped).detach()


@dataclass(frozen=True)
class Jitter(Step):
    """A random gain, gamma and white balance for each image, clipped to 0..1.

    The logarithms of gain, gamma and of each channel's balance are normal with these standard deviations. Meant
    for sRGB-encoded values.
    """

    gain: float = 0.05
    gamma: float = 0.05
    normalisation: float = 0.03

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        b, c = image.shape[:2]
        gain = self.gain * normal((b, 1), image, generator) + self.normalisation * normal((b, c), image, generator)
        gamma = self.gamma * normal((b, 1, 1, 1), image, generator)
        return (image.clamp(min=1e-6) ** gamma.exp() * gain.exp()[..., None, None]).clamp(0, 1)
