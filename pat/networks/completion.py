"""Colour completed: what no beta sees, and what is doubtful, by a network that has seen many photographs.

Each way of filling in is right somewhere. The network weighs them pixel by pixel, the image as it is one of
them, and adds what none of them has. It is trained apart from the rest, on what the rest gives for
photographs cut into surfaces, for real shapes in the textures of photographs, and for stereo pairs
(`experiments.completion`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle

from ..matching.matches import FILLS
from ..media.colour import from_luma_chroma, to_luma_chroma
from ..support.blocks import UNet, stacked
from ..support.settings import tuned

CANDIDATES = 2 + FILLS
"""Size: matched, diffused, by nearest examples, by attention."""
BLOCKS = 1
"""Size: residual blocks at each scale."""


@dataclass(frozen=True)
class CompletionSettings:
    """Of what is done with the network's answer."""

    strength: float = tuned(
        0.5,
        "Middlebury, tune half, of pairs that training did not see: so much of the change is taken: "
        "photographs cut into surfaces need more of it than pairs do",
    )


SETTINGS = CompletionSettings()


class Completion(nn.Module):
    """A U-Net from half the size down, its widths at 1/2, 1/4 and 1/8; colours are bands minus alpha."""

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.unet = UNet(4 * (4 + 2 * CANDIDATES), widths, 4 * (3 + CANDIDATES), blocks=BLOCKS)
        nn.init.zeros_(self.unet.last.weight)
        start = torch.tensor([0.0, 0.0, 3.0] + [0.0] * CANDIDATES)  # the image as it is, mostly
        self.unet.last.bias = nn.Parameter(start.repeat_interleave(4))

    def forward(
        self,
        alpha: Float[Tensor, "b 1 h w"],
        confidence: Float[Tensor, "b 1 h w"],
        mixed: Float[Tensor, "b 3 h w"],
        candidates: Sequence[Float[Tensor, "b 3 h w"]],
    ) -> Float[Tensor, "b 3 h w"]:
        """Colour in place of `mixed`. Where a match is certain, it is nearly that."""
        colours = differences(confidence, mixed, candidates)
        inputs = features(alpha, confidence, [to_luma_chroma(colour)[1] for colour in (mixed, *colours)])
        del colours
        added, *shares = self.answer(inputs).split([2] + [1] * CANDIDATES, 1)
        apart = differences(confidence, mixed, candidates)
        change = sum(share * difference for share, difference in zip(shares, apart))
        added = (1 - confidence) * from_luma_chroma(torch.zeros_like(alpha), added)
        return mixed + SETTINGS.strength * (change + added)

    def answer(self, inputs: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o 2*h 2*w"]:
        """The chroma to add where a match is not certain, and the candidates' shares, by `features`."""
        added, weights = pixel_shuffle(self.unet(inputs), 2).split([2, 1 + CANDIDATES], 1)
        return torch.cat([added, weights.softmax(1)[:, 1:]], 1)


def features(
    alpha: Float[Tensor, "b 1 h w"],
    confidence: Float[Tensor, "b 1 h w"],
    colours: Sequence[Float[Tensor, "b _ h w"]],
) -> Float[Tensor, "b i h/2 w/2"]:
    """What the network is given; `colours` are chroma of the image and of what each candidate differs by."""
    return stacked(alpha[:, :0, ::2, ::2], alpha - 0.5, confidence, *colours)


def differences(
    confidence: Float[Tensor, "b 1 h w"],
    mixed: Float[Tensor, "b 3 h w"],
    candidates: Sequence[Float[Tensor, "b 3 h w"]],
) -> list[Float[Tensor, "b 3 h w"]]:
    """What the matched colour, and each other one the less certain that is, differs by from the image."""
    matched, *fills = (candidate - mixed for candidate in candidates)
    return [matched, *((1 - confidence) * fill for fill in fills)]
