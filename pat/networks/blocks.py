"""The convolutional blocks that the networks are made of."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils._pytree import tree_map


class ResidualBlock(nn.Module):
    """x + conv(leaky(conv(x))), both 3x3."""

    def __init__(self, dim: int, *, dilation: int = 1) -> None:
        super().__init__()
        self.first = nn.Conv2d(dim, dim, 3, padding=dilation, dilation=dilation)
        self.second = nn.Conv2d(dim, dim, 3, padding=1)
        self.act = nn.LeakyReLU(0.1, inplace=True)

    def forward(self, x: Float[Tensor, "b d h w"]) -> Float[Tensor, "b d h w"]:
        """The same size and channels."""
        return self.second(self.act(self.first(x))).add_(x)


class ResidualASPP(nn.Module):
    """Three groups of atrous convolutions (dilations 1, 4, 8), each fused by 1x1 and added (Wang et al. 2019)."""

    def __init__(self, dim: int, dilations: tuple[int, ...] = (1, 4, 8)) -> None:
        super().__init__()
        self.groups = nn.ModuleList(
            nn.ModuleList(nn.Conv2d(dim, dim, 3, padding=d, dilation=d, bias=False) for d in dilations)
            for _ in range(3)
        )
        self.fuse = nn.ModuleList(nn.Conv2d(dim * len(dilations), dim, 1, bias=False) for _ in range(3))
        self.act = nn.LeakyReLU(0.1, inplace=True)

    def forward(self, x: Float[Tensor, "b d h w"]) -> Float[Tensor, "b d h w"]:
        """The same size and channels; each group works on the result of the one before."""
        total, y = x, x
        for group, fuse in zip(self.groups, self.fuse):
            assert isinstance(group, nn.ModuleList)
            y = fuse(torch.cat([self.act(conv(y)) for conv in group], 1))
            total = total + y
        return total


def conv(inputs: int, outputs: int, *, stride: int = 1) -> nn.Sequential:
    """A 3x3 convolution and its activation."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.LeakyReLU(0.1, inplace=True))


def channels_last(x: Float[Tensor, "b d h w"]) -> Float[Tensor, "b d h w"]:
    """The same with the channels beside each other in memory: convolutions on the CPU take about half the time."""
    return x.contiguous(memory_format=torch.channels_last)


def stacked(*parts: Float[Tensor, "b _ h w"]) -> Float[Tensor, "b d h w"]:
    """The channels of all parts, `channels_last`."""
    return torch.cat([channels_last(part) for part in parts], 1)


def enlarge(x: Float[Tensor, "b d h w"], factor: int = 2) -> Float[Tensor, "b d h*{factor} w*{factor}"]:
    """Bilinear, by the pixel-area convention c' = (c + 0.5) factor - 0.5."""
    return nn.functional.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)


def in_bfloat16(part: nn.Module) -> None:
    """Let a part compute in bfloat16 where autocast does, with float32 output."""
    forward = part.forward

    def cast(*images: Tensor) -> Any:
        with torch.autocast(images[0].device.type, torch.bfloat16):
            answer = forward(*images)
        return tree_map(lambda t: t.float(), answer)

    part.forward = cast
