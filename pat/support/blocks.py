"""Convolutional blocks of the networks, and the precision that they compute in."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils._pytree import tree_map

from arraygeom.runtime.chunks import chunked

ROWS = 64
"""Rows that the largest stages of a U-Net compute at a time."""


class ResidualBlock(nn.Module):
    """Residual block: x + conv(leaky(conv(x))) of x (b, dim, h, w), both convolutions 3x3.

    Args:
        dim: number of channels, in and out.
        dilation: dilation of the first convolution.
        bias: True for biases in both convolutions.
    """

    def __init__(self, dim: int, *, dilation: int = 1, bias: bool = True) -> None:
        super().__init__()
        self.first = nn.Conv2d(dim, dim, 3, padding=dilation, dilation=dilation, bias=bias)
        self.second = nn.Conv2d(dim, dim, 3, padding=1, bias=bias)
        self.act = nn.LeakyReLU(0.1, inplace=True)

    def forward(self, x: Float[Tensor, "b d h w"]) -> Float[Tensor, "b d h w"]:
        """Return features (b, d, h, w) of the same shape as `x`."""
        return self.second(self.act(self.first(x))).add_(x)


class ResidualASPP(nn.Module):
    """Residual atrous pyramid (Wang et al. 2019) of x (b, dim, h, w), which keeps its shape.

    Three groups of dilated 3x3 convolutions in turn, each fused by a 1x1 convolution; the three results are
    added to the input. No biases.

    Args:
        dim: number of channels, in and out.
        dilations: dilations of the parallel convolutions of a group.
    """

    def __init__(self, dim: int, dilations: tuple[int, ...] = (1, 4, 8)) -> None:
        super().__init__()
        self.groups = nn.ModuleList(
            nn.ModuleList(nn.Conv2d(dim, dim, 3, padding=d, dilation=d, bias=False) for d in dilations)
            for _ in range(3)
        )
        self.fuse = nn.ModuleList(nn.Conv2d(dim * len(dilations), dim, 1, bias=False) for _ in range(3))
        self.act = nn.LeakyReLU(0.1, inplace=True)

    def forward(self, x: Float[Tensor, "b d h w"]) -> Float[Tensor, "b d h w"]:
        """Return features (b, d, h, w) of the same shape as `x`; each group starts from the result of the
        one before."""
        total, y = x, x
        for group, fuse in zip(self.groups, self.fuse):
            assert isinstance(group, nn.ModuleList)
            y = fuse(torch.cat([self.act(conv(y)) for conv in group], 1))
            total = total + y
        return total


def conv(inputs: int, outputs: int, *, stride: int = 1) -> nn.Sequential:
    """Make a 3x3 convolution followed by leaky ReLU.

    Returns:
        The two layers in sequence, with padding 1: (b, inputs, h, w) to (b, outputs, h / stride, w / stride).
    """
    convolution = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)
    return nn.Sequential(convolution, nn.LeakyReLU(0.1, inplace=True))


def channels_last(x: Float[Tensor, "b d h w"]) -> Float[Tensor, "b d h w"]:
    """Return the tensor with the channels of a pixel adjacent in memory: CPU convolutions take half the time.

    Shape and values stay (b, d, h, w).
    """
    return x.contiguous(memory_format=torch.channels_last)


def enlarge(x: Float[Tensor, "b d h w"], factor: int = 2) -> Float[Tensor, "b d h*{factor} w*{factor}"]:
    """Enlarge feature maps bilinearly by an integer factor, where c' = (c + 0.5) factor - 0.5.

    Returns:
        Tensor (b, d, factor h, factor w).
    """
    return nn.functional.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)


class UNet(nn.Module):
    """U-Net of three scales: called with (b, `inputs`, h, w), sides multiples of 4, it returns (b, `outputs`,
    h, w).

    Args:
        inputs: number of channels of the input.
        widths: channels at full, 1/2 and 1/4 size; three numbers.
        outputs: number of channels of the output.
        blocks: residual blocks on the way down and again up at full and 1/2 size; 2 `blocks` at 1/4.
    """

    def __init__(self, inputs: int, widths: tuple[int, ...], outputs: int, *, blocks: int = 1) -> None:
        super().__init__()
        a, b, c = widths
        dilations, self.halo = (1, 2) * blocks, 2 * blocks + 1
        self.first = nn.Sequential(conv(inputs, a), *_residual(a, blocks))
        self.second = nn.Sequential(conv(a, b, stride=2), *_residual(b, blocks))
        self.third = nn.Sequential(conv(b, c, stride=2), *(ResidualBlock(c, dilation=d) for d in dilations))
        self.up_b, self.up_a = nn.Conv2d(c, b, 1), nn.Conv2d(b, a, 1)
        self.back_b, self.back_a = (_in_turn(_residual(n, blocks)) for n in (b, a))
        self.last = nn.Conv2d(a, outputs, 3, padding=1)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o h w"]:
        """Return features (b, outputs, h, w) for an input (b, inputs, h, w).

        Raises:
            RuntimeError: by torch, for sides not multiples of 4; some give a result without meaning instead.
        """
        first = self._in_rows(self.first, x)
        second = self.second(first)
        second = self.back_b(second + enlarge(self.up_b(self.third(second))))
        return self._in_rows(self._finished, first, enlarge(self.up_a(second)))

    def _finished(self, first: Tensor, more: Tensor) -> Tensor:
        return self.last(self.back_a(first + more))

    def _in_rows(self, stage: Callable[..., Tensor], *images: Tensor) -> Tensor:
        """Run a stage at the largest scale on some rows at a time if no gradient is wanted."""
        if torch.is_grad_enabled():
            return stage(*images)
        return chunked(stage, *images, rows=ROWS, halo=self.halo)


def _residual(dim: int, count: int) -> list[ResidualBlock]:
    return [ResidualBlock(dim) for _ in range(count)]


def _in_turn(blocks: list[ResidualBlock]) -> nn.Module:
    """Chain blocks; a single block stays itself, so that the names of its weights match published files."""
    return nn.Sequential(*blocks) if len(blocks) > 1 else blocks[0]


def in_bfloat16(module: nn.Module) -> None:
    """Make a module compute in bfloat16 autocast and return float32. Replaces its `forward` in place."""
    module.forward = partial(_rounded, module)  # copies of a module have their own


def _rounded(module: nn.Module, *images: Any) -> Any:
    with torch.autocast(images[0].device.type, torch.bfloat16):
        answer = type(module).forward(module, *images)
    return tree_map(lambda t: t.float(), answer)


@contextmanager
def without_autocast() -> Iterator[None]:
    """Context manager that turns autocast off on CPU and GPU, for code that needs full precision."""
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        yield
