"""An alpha in colour has its own colours where the betas do not see the point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.chunks import chunked
from arraygeom.robust import least_squares

from ..media.colour import from_luma_chroma, to_luma_chroma
from ..support.settings import size
from .results import Frame


@dataclass(frozen=True)
class OwnColourSettings:
    """Of a fused image whose alpha was recorded in colour."""

    unseen: float = size(0.2, "Confidence up to which alpha's own colours are taken")
    seen: float = size(0.5, "And from which the betas'")
    pixels: int = size(100_000, "About so many pixels say how the betas' colours differ from alpha's")
    prior: float = size(1.0, "Squared chroma in all that weighs as much against any difference")


SETTINGS = OwnColourSettings()


def with_own_colours(frame: Frame, own: Float[Tensor, "3 h w"]) -> Frame:
    """A fused frame whose chroma is alpha's own where confidence is low, as the betas' cameras show such colours.

    Luminance stays. How the betas show alpha's colours is found where they see the same points.
    """
    own = own.to(frame.image)
    step = max(int((frame.confidence.numel() / SETTINGS.pixels) ** 0.5), 1)
    some = (..., slice(None, None, step), slice(None, None, step))
    terms, values = (to_luma_chroma(image[some])[1].flatten(1).detach().double() for image in (own, frame.image))
    weight = (frame.confidence[some].flatten().detach() > SETTINGS.seen).double()
    same = torch.eye(2, dtype=torch.float64, device=own.device)
    change = same + least_squares(terms, (values - terms).T, weight, SETTINGS.prior * same)
    mix = partial(_mixed, change.T.to(own))
    return frame._replace(image=chunked(mix, frame.image, own, frame.confidence[None]))


def _mixed(
    change: Float[Tensor, "2 2"],
    image: Float[Tensor, "3 h w"],
    own: Float[Tensor, "3 h w"],
    confidence: Float[Tensor, "1 h w"],
) -> Float[Tensor, "3 h w"]:
    share = ((confidence - SETTINGS.unseen) / (SETTINGS.seen - SETTINGS.unseen)).clamp(0, 1)
    luma, chroma = to_luma_chroma(image)
    there = torch.einsum("ij,jhw->ihw", change, to_luma_chroma(own)[1])
    return from_luma_chroma(luma, share * chroma + (1 - share) * there)
