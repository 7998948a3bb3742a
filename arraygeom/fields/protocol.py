"""The protocol that every receptive field follows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..pixels import pixel_grid
from ..rig import Pair
from ..segments import Positions, Segments

SamplingLocations = Segments | Positions


@runtime_checkable
class ReceptiveField(Protocol):
    """The search segment or sampling locations in beta of each alpha pixel."""

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> SamplingLocations:
        """Segments or positions in beta's pixels, for alpha's pixels x. Differentiable in the pair's numbers."""
        ...


def sampling_locations(field: ReceptiveField, pair: Pair, x: Float[Tensor, "*n 2"] | None = None) -> SamplingLocations:
    """The field over given pixels, or over alpha's whole image (H, W); a batch of rigs gives (*b, H, W)."""
    return field(pair, all_pixels(pair) if x is None else x)


def lazily(field: ReceptiveField, pair: Pair) -> Callable[[Tensor], SamplingLocations]:
    """The field as a function of alpha pixels (n, 2) alone, which attention calls chunk by chunk.

    For a batch of rigs it answers for each of them, (*b, n).
    """
    axes = _batch_axes(pair)
    return lambda x: field(pair, x.reshape(*[1] * axes, *x.shape))


def all_pixels(pair: Pair) -> Float[Tensor, "*b h w 2"]:
    """Alpha's pixel centres, float32, with the axes of a batch of rigs (of length 1) in front."""
    known = _numbers(pair)
    grid = pixel_grid(pair.alpha.hw, device=None if known is None else known.device)
    return grid.reshape(*[1] * _batch_axes(pair), *grid.shape)


def _numbers(pair: Pair) -> Tensor | None:
    """A matrix of the pair, if it has any."""
    if isinstance(pair.alpha, Camera):
        return pair.alpha.K
    return None if pair.link is None else pair.link.F


def _batch_axes(pair: Pair) -> int:
    known = _numbers(pair)
    return 0 if known is None else known.ndim - 2


CHUNK = 1 << 15
"""Pixels handled at once, so that what is computed on the way stays in a core's cache."""


def in_chunks(f: Callable[[Tensor], Segments], x: Float[Tensor, "*n 2"]) -> Segments:
    """f over pixels, some rows of the first axis at a time; f must answer for each pixel alone."""
    rows = max(1, CHUNK * x.shape[0] * 2 // max(x.numel(), 1)) if x.ndim > 1 else 0
    if x.ndim == 1 or rows >= x.shape[0] or x.shape[0] == 1:
        return f(x)
    parts = [f(rows_of_x) for rows_of_x in x.split(rows)]
    return Segments(*(torch.cat([getattr(p, name) for p in parts]) for name in ("start", "end", "valid")))
