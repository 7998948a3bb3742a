"""Photometric similarity of two views, by which matches, colours and motion are weighted."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..support.settings import tuned
from .filters import box_mean


@dataclass(frozen=True)
class LikenessSettings:
    """Settings of the similarity. Brightness is 0 to 1.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    unlike: float = tuned(0.07, "Middlebury: difference of brightness at which likeness is 1 / e")


SETTINGS = LikenessSettings()
UNLIKE = SETTINGS.unlike


def likeness(difference: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b 1 h w"]:
    """Compute photometric similarity: 1 where images are equally bright around a pixel, down to 0 elsewhere.

    Args:
        difference: difference of brightness.
    """
    return torch.exp(-(box_mean(difference.abs(), 1) / UNLIKE).square())
