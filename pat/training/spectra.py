"""Random bands mixed from red, green and blue, so that networks learn no band in particular."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor

MOST = 4
"""Bands of one beta at most."""


class Spectra(NamedTuple):
    """C bands for each of a batch: mixtures of red, green and blue, each with its own gamma and contrast.

    mixture: (B, C, 3), rows add up to 1. gamma, low, high: (B, C), the band is low where the mixture is 0 and high
    where it is 1; low is above high for bands that are dark where others are bright.
    """

    mixture: Tensor
    gamma: Tensor
    low: Tensor
    high: Tensor

    @classmethod
    def drawn(cls, batch: int, count: int, generator: Generator) -> Spectra:
        """Half of the bands are of one colour, half have a gamma curve, one in ten is inverted."""

        def chance(p: float) -> Tensor:
            return torch.rand(batch, count, generator=generator) < p

        parts = torch.rand(batch, count, 3, generator=generator).square() + 1e-3
        one = torch.eye(3)[torch.randint(3, (batch, count), generator=generator)]
        mixture = torch.where(chance(0.5)[..., None], one, parts / parts.sum(-1, keepdim=True))
        exponent = 1.4 * torch.rand(batch, count, generator=generator) - 0.7
        gamma = torch.where(chance(0.5), exponent, 0.0).exp2()
        low = 0.2 * torch.rand(batch, count, generator=generator)
        high = 1 - 0.4 * torch.rand(batch, count, generator=generator)
        inverted = chance(0.1)
        return cls(mixture, gamma, torch.where(inverted, high, low), torch.where(inverted, low, high))

    def of(self, image: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c h w"]:
        """The bands of a colour image."""
        mixture, gamma, low, high = (part.to(image) for part in self)
        mixed = torch.einsum("bck,bkhw->bchw", mixture, image).clamp(min=1e-6) ** gamma[..., None, None]
        return low[..., None, None] + (high - low)[..., None, None] * mixed
