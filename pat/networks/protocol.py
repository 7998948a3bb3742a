"""The protocol between the fusion and its networks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from arraygeom import Pair, Positions, ReceptiveField, Segments, lazily, pixel_grid

from .semi_global import Normalisations, SemiGlobalMatches
from .spectral_mix import SpectralMix


@dataclass(frozen=True)
class Look:
    """Where to look in one beta: `at` maps alpha pixels (n, 2) to segments or positions in beta's pixels.

    `at` may answer for one rig (n) or for a batch of rigs (B, n). Segments are looked at in `samples` places.
    `known` is what a survey of the whole images has found, for networks that make one, and `balances` and `mix` what
    the survey of a piece is to know of the whole.
    """

    at: Callable[[Tensor], Segments | Positions]
    samples: int
    known: SemiGlobalMatches | None = None
    normalisations: Normalisations | None = None
    mix: SpectralMix | None = None

    @classmethod
    def along(cls, field: ReceptiveField, pair: Pair) -> Look:
        """The field of a pair, with about one sample for each pixel of beta on the longest segment."""
        device = pair.cameras[0].K.device if pair.calibrated else None
        sparse = pixel_grid(pair.alpha.hw, device=device)[::4, ::4].reshape(-1, 2)
        at = lazily(field, pair)
        found = at(sparse)
        if isinstance(found, Positions):
            return cls(at, found.xy.shape[-2])
        longest = torch.where(found.valid, found.length.detach(), 0.0).max()
        return cls(at, math.ceil(float(longest)) + 1)


Looks = Sequence[Look]


class FusionOutput(NamedTuple):
    """What a fusion network says of alpha's view.

    image: (B, C, s H, s W), the fused image.
    position: one (B, 2, H, W) for each beta, where its pixels were found, in beta's pixels.
    spread: one (B, H, W) for each beta, the uncertainty of that, in beta's pixels.
    confidence: one (B, H, W) for each beta, 0 to 1: whether beta sees the point, and where is known.
    """

    image: Tensor
    position: list[Tensor]
    spread: list[Tensor]
    confidence: list[Tensor]


@runtime_checkable
class FusionNetwork(Protocol):
    """What `fuse` asks of a network."""

    halo: int
    """How far around a pixel alpha's image, and where it looks, can matter, pixels."""
    beta_halo: int
    """How far around where it is looked at beta's image can matter, pixels."""
    bytes_per_pixel: float
    """Working memory for each pixel of alpha and of the betas, measured."""
    multiple: int
    """Images are padded to multiples of this, and cut at them."""
    equal_pitch: bool
    """Whether betas want to be resized so that their pixels subtend about the angle that alpha's do."""

    joins_bands: Literal["no", "neighbours", "all"]
    """Which betas that see the same from one place are to come as one of several bands: none, those that follow each
    other (where the order of the bands matters), or all."""

    def normalisation(self, alpha: Tensor, beta: Tensor, look: Look) -> Look:
        """The look with what surveys of pieces are to know of the whole images (of whole multiples), if anything."""
        ...

    def survey(self, alpha: Tensor, beta: Tensor, look: Look) -> SemiGlobalMatches | None:
        """What is to be known of whole images (of whole multiples) before pieces of them are fused, if anything."""
        ...

    def __call__(self, alpha: Tensor, betas: Sequence[Tensor], looks: Looks) -> FusionOutput:
        """Fuse alpha (B, C, H, W) with betas of any sizes."""
        ...
