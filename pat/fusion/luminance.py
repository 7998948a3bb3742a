"""Luminance of the fused image, alpha's or a colour beta's in alpha's detail, and its chroma.

Where no combination of beta's bands is similar to alpha, as with near infrared, alpha's brightness in beta's
colours is of neither camera: leaves are pale, skin is flat. An alpha in colour has its own chroma where betas
do not see.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.robust import least_squares
from arraygeom.runtime.chunks import chunked

from ..matching.colour_transfer import SETTINGS, local_slope
from ..matching.normalisation import Normalisation
from ..media.colour import from_luma_chroma, luminance, to_luma_chroma
from ..networks.protocol import FusionNetwork
from ..support.settings import size
from .frame import Frame

Luminance = Literal["alpha", "mix", "beta"]
SHARES: dict[Luminance, float] = {"alpha": 1.0, "mix": 0.5, "beta": 0.0}
"""Alpha's share of the luminance."""


@dataclass(frozen=True)
class OwnColourSettings:
    """Settings of a fused image whose alpha was recorded in colour.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    unseen: float = size(0.2, "Confidence up to which alpha's own colours are taken")
    seen: float = size(0.5, "And from which the betas'")
    pixels: int = size(100_000, "About so many pixels say how the betas' colours differ from alpha's")
    prior: float = size(1.0, "Squared chroma in all that weighs as much against any difference")


OWN_COLOUR = OwnColourSettings()


def check_luminance(network: FusionNetwork, kept: Luminance, *, noisy: bool) -> None:
    """Check that a network can keep the luminance that is asked for.

    Args:
        network: network that fuses.
        kept: luminance that the image has, one of `SHARES`.
        noisy: True if the images are denoised.

    Raises:
        ValueError: for a word that is not in `SHARES`; and for another than "alpha" with noise, or for a
            network without `keeps_luminance`.
    """
    if kept not in SHARES:
        raise ValueError(f"luminance is one of {', '.join(SHARES)}; got {kept!r}")
    if kept == "alpha":
        return
    if not network.keeps_luminance:
        raise ValueError(
            f"luminance={kept!r} needs weights for RGB betas, such as mono-colour: leave it at 'alpha'"
        )
    if noisy:
        raise ValueError(
            f"luminance={kept!r} with noise: denoising is towards alpha's luminance; leave one of them out"
        )


def with_alpha_detail(frame: Frame, alpha: Float[Tensor, "1 h w"]) -> Frame:
    """Add to a frame of beta's luminance the detail that alpha has and beta lacks.

    Args:
        frame: frame of RGB bands with beta's luminance.
        alpha: alpha's image, values 0..1.

    Returns:
        The frame, with the same detail added to each band.
    """
    luma = luminance(frame.image)[None]
    alpha_luma, beta_luma = alpha[None].to(luma), torch.nan_to_num(luma)
    normalisation = Normalisation.from_images(alpha_luma, beta_luma)
    soft = normalisation.softened(alpha_luma)
    detail = local_slope(beta_luma, soft) * SETTINGS.detail(alpha_luma - soft)
    return frame._replace(image=frame.image + detail[0])


def with_own_colours(frame: Frame, alpha: Float[Tensor, "3 h w"]) -> Frame:
    """Replace a fused frame's chroma by alpha's own where confidence is low, converted to the betas' colours.

    Luma stays. The conversion of alpha's colours is fitted where the betas see the same points. Between the
    confidences `OWN_COLOUR.unseen` and `OWN_COLOUR.seen` both are mixed.

    Args:
        frame: frame of RGB bands.
        alpha: alpha's image in colour, values 0..1, at the frame's pixels.

    Returns:
        The frame with the new image.
    """
    alpha = alpha.to(frame.image)
    step = max(int((frame.confidence.numel() / OWN_COLOUR.pixels) ** 0.5), 1)
    some = (..., slice(None, None, step), slice(None, None, step))
    chroma = (to_luma_chroma(image[some])[1] for image in (alpha, frame.image))
    terms, values = (plane.flatten(1).detach().double() for plane in chroma)
    weight = (frame.confidence[some].flatten().detach() > OWN_COLOUR.seen).double()
    same = torch.eye(2, dtype=torch.float64, device=alpha.device)
    change = same + least_squares(terms, (values - terms).T, weight, OWN_COLOUR.prior * same)
    mix = partial(_mixed, change.T.to(alpha))
    return frame._replace(image=chunked(mix, frame.image, alpha, frame.confidence[None]))


def _mixed(
    change: Float[Tensor, "2 2"],
    image: Float[Tensor, "3 h w"],
    alpha: Float[Tensor, "3 h w"],
    confidence: Float[Tensor, "1 h w"],
) -> Float[Tensor, "3 h w"]:
    share = ((confidence - OWN_COLOUR.unseen) / (OWN_COLOUR.seen - OWN_COLOUR.unseen)).clamp(0, 1)
    luma, chroma = to_luma_chroma(image)
    there = torch.einsum("ij,jhw->ihw", change, to_luma_chroma(alpha)[1])
    return from_luma_chroma(luma, share * chroma + (1 - share) * there)
