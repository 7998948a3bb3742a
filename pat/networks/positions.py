"""Where alpha's pixels are in each beta, as further bands of a network's image: made and put together with it."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..matching.inputs import Inputs
from .protocol import FusionNetwork, FusionOutput


class Found(NamedTuple):
    """Where alpha's pixels are in a beta, (H, W, 2), and with what confidence, (H, W)."""

    position: Tensor
    confidence: Tensor


class WithPositions(nn.Module):
    """A network whose image has further bands: the position (x, y) in each whole beta, and its confidence."""

    def __init__(self, network: FusionNetwork) -> None:
        super().__init__()
        self.network = network

    def __getattr__(self, name: str) -> Any:
        """What the fusion asks of networks is that of the network inside."""
        inside = self.__dict__["_modules"].get("network") or self.__dict__.get("network")
        return inside if name == "network" else getattr(inside, name)

    def forward(self, inputs: Inputs, state: Any = None) -> FusionOutput:
        """Fuse; the image must be of alpha's size."""
        found = self.network(inputs, state)
        further = [found.image]
        for beta, position, confidence in zip(inputs.betas, found.position, found.confidence):
            corner = position.new_tensor(beta.offset)[:, None, None]
            further += [(position + corner).to(found.image), confidence[:, None].to(found.image)]
        return found._replace(image=torch.cat(further, 1))


def split(image: Float[Tensor, "c h w"], betas: int) -> tuple[Float[Tensor, "d h w"], list[Found]]:
    """The image proper that `WithPositions` made of so many betas, and what the further bands say of each of them."""
    bands = len(image) - 3 * betas
    further = image[bands:].split(3)
    return image[:bands], [Found(part[:2].movedim(0, -1), part[2]) for part in further]
