"""Whose brightness the fused image has: alpha's, or a colour beta's in alpha's detail.

Where no combination of beta's bands is what alpha sees, as with near infrared, alpha's brightness in beta's
colours is
of neither camera: leaves are pale, skin is flat.
"""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ..matching.colour_transfer import SETTINGS, local_slope
from ..matching.normalisation import Normalisation
from ..media.colour import luminance
from ..networks.protocol import FusionNetwork
from .results import Frame

Luminance = Literal["alpha", "mix", "beta"]
SHARES: dict[Luminance, float] = {"alpha": 1.0, "mix": 0.5, "beta": 0.0}
"""Alpha's share of the luminance."""


def check_luminance(network: FusionNetwork, kept: Luminance, *, noisy: bool) -> None:
    """Raises ValueError for a word that is none of `SHARES`, and where beta's luminance is not available."""
    if kept not in SHARES:
        raise ValueError(f"luminance is one of {', '.join(SHARES)}; got {kept!r}")
    if kept == "alpha":
        return
    if not network.keeps_luminance:
        raise ValueError(f"luminance={kept!r} needs weights for RGB betas, such as mono-colour: leave it at 'alpha'")
    if noisy:
        raise ValueError(
            f"luminance={kept!r} with noise: denoising is towards alpha's luminance; leave one of them out"
        )


def with_alpha_detail(frame: Frame, alpha: Float[Tensor, "1 h w"]) -> Frame:
    """A frame of beta's luminance with the detail that alpha has and beta has not."""
    luma = luminance(frame.image)[None]
    own, other = alpha[None].to(luma), torch.nan_to_num(luma)
    normalisation = Normalisation.of(own, other)
    soft = normalisation.softened(own)
    detail = local_slope(other, soft) * SETTINGS.detail(own - soft)
    return frame._replace(image=frame.image + detail[0])
