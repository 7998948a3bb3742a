"""The convolutional blocks that the networks are made of, and the precision in which they compute."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pixel_unshuffle
from torch.utils._pytree import tree_map

from arraygeom.fields.protocol import compilable
from arraygeom.runtime.chunks import chunked

from .unshuffle_numba import unshuffle

ROWS = 64
"""Rows at a time of a U-Net's largest stages."""


class ResidualBlock(nn.Module):
    """x + conv(leaky(conv(x))), both 3x3."""

    def __init__(self, dim: int, *, dilation: int = 1, bias: bool = True) -> None:
        super().__init__()
        self.first = nn.Conv2d(dim, dim, 3, padding=dilation, dilation=dilation, bias=bias)
        self.second = nn.Conv2d(dim, dim, 3, padding=1, bias=bias)
        self.act = nn.LeakyReLU(0.1, inplace=True)

    def forward(self, x: Float[Tensor, "b d h w"]) -> Float[Tensor, "b d h w"]:
        """The same size and channels."""
        return self.second(self.act(self.first(x))).add_(x)


class ResidualASPP(nn.Module):
    """Three atrous groups (dilations 1, 4, 8), each fused by 1x1 convolution and added (Wang et al. 2019)."""

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
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.LeakyReLU(0.1, inplace=True)
    )


def channels_last(x: Float[Tensor, "b d h w"]) -> Float[Tensor, "b d h w"]:
    """The same, channels beside each other in memory: convolutions on the CPU take about half the time."""
    return x.contiguous(memory_format=torch.channels_last)


def stacked(*parts: Float[Tensor, "b _ _ _"]) -> Float[Tensor, "b d h w"]:
    """All parts' channels, `channels_last`; 2x2 pixels of parts twice the size as in `pixel_unshuffle`."""
    h, w = (min(tensor.shape[side] for tensor in parts) for side in (-2, -1))
    if not all(map(plain, parts)):
        same = (tensor if tensor.shape[-1] == w else pixel_unshuffle(tensor, 2) for tensor in parts)
        return torch.cat([channels_last(tensor) for tensor in same], 1)
    counts = [tensor.shape[1] * (tensor.shape[-1] // w) ** 2 for tensor in parts]
    out = parts[0].new_empty(len(parts[0]), h, w, sum(counts))
    for tensor, target in zip(parts, out.split(counts, -1)):
        if tensor.shape[-1] == w:
            target.copy_(tensor.movedim(1, -1))
        else:
            for image, of in zip(tensor.numpy(), target.numpy()):
                unshuffle(image[:, ::2], image[:, 1::2], of)
    return out.movedim(-1, 1)


def plain(x: Tensor) -> bool:
    """Whether compiled loops of float32 can take a tensor: nothing asks for its gradient."""
    return x.dtype == torch.float32 and compilable(x) and not x.requires_grad


def enlarge(x: Float[Tensor, "b d h w"], factor: int = 2) -> Float[Tensor, "b d h*{factor} w*{factor}"]:
    """Bilinear, by the pixel-area convention c' = (c + 0.5) factor - 0.5."""
    return nn.functional.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)


class UNet(nn.Module):
    """Three scales down and up again, `blocks` residual blocks at each, twice as many at the smallest."""

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
        """The same size; sides are multiples of 4."""
        first = self._in_rows(self.first, x)
        second = self.second(first)
        second = self.back_b(second + enlarge(self.up_b(self.third(second))))
        return self._in_rows(self._finished, first, enlarge(self.up_a(second)))

    def _finished(self, first: Tensor, more: Tensor) -> Tensor:
        return self.last(self.back_a(first + more))

    def _in_rows(self, stage: Callable[..., Tensor], *images: Tensor) -> Tensor:
        """A stage at the largest size, which takes most of the memory, of some rows at a time."""
        if torch.is_grad_enabled():
            return stage(*images)
        return chunked(stage, *images, rows=ROWS, halo=self.halo)


def _residual(dim: int, count: int) -> list[ResidualBlock]:
    return [ResidualBlock(dim) for _ in range(count)]


def _in_turn(blocks: list[ResidualBlock]) -> nn.Module:
    """One block is itself, as weights of networks with one have it."""
    return nn.Sequential(*blocks) if len(blocks) > 1 else blocks[0]


def in_bfloat16(module: nn.Module) -> None:
    """Let a module compute in bfloat16 where autocast does, with float32 output."""
    module.forward = partial(_rounded, module)  # copies of a module have their own


def _rounded(module: nn.Module, *images: Any) -> Any:
    with torch.autocast(images[0].device.type, torch.bfloat16):
        answer = type(module).forward(module, *images)
    return tree_map(lambda t: t.float(), answer)


@contextmanager
def without_autocast() -> Iterator[None]:
    """Whatever autocast is in effect around: parts that may be less precise say so themselves."""
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        yield
