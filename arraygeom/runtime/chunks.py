"""A large thing in parts: boxes of an image with halos, and functions called for one part after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, product
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .threads import in_order
from .tracing import transformations

ROWS = 256
"""Rows at a time: of an image of 12 megapixels, 12 MB of three colours in float32."""

Box = tuple[int, ...]
"""First pixel, and the one after the last, along each axis: (top, bottom, left, right) of an image."""


class Tile(NamedTuple):
    """A box of what is made, and the box of what is given that it needs: the same with a halo."""

    inner: Box
    outer: Box


def area(box: Box) -> int:
    """Pixels in a box."""
    return math.prod(last - first for first, last in zip(box[::2], box[1::2]))


def slices(box: Sequence[int]) -> tuple[Any, ...]:
    """What is indexed to get a box, along its axes."""
    return tuple(slice(*span) for span in zip(box[::2], box[1::2]))


def whole(lengths: Sequence[int]) -> Tile:
    """All of a frame (h, w) as one tile."""
    box = tuple(chain(*((0, n) for n in lengths)))
    return Tile(box, box)


def spans(length: int, step: int) -> list[tuple[int, int]]:
    """First index, and the one after the last, of parts of `step`; the last part may be shorter."""
    return [(first, min(first + step, length)) for first in range(0, max(length, 1), step)]


def tiles_of(lengths: Sequence[int], side: int | Sequence[int], halo: int) -> Iterator[Tile]:
    """Tiles of a frame (h, w), square or of a height and a width, whose halos end at its borders."""
    sides = [side] * len(lengths) if isinstance(side, int) else side
    for inner in product(*map(spans, lengths, sides)):
        outer = ((max(first - halo, 0), min(last + halo, n)) for (first, last), n in zip(inner, lengths))
        yield Tile(tuple(chain(*inner)), tuple(chain(*outer)))


def chunked(
    function: Callable[..., Any],
    *tensors: Tensor,
    rows: int | Sequence[int] = ROWS,
    halo: int = 0,
    axis: int | Sequence[int] = -2,
) -> Any:
    """`function(*tensors)`, computed for some rows at a time; with several axes, for one tile at a time.

    Of tensors on the CPU parts are computed `in_order` on several threads.

    The tensors are cut along the axis, and so is what the function gives: a tensor or several, as long as
    what it is given or shorter by a whole factor, of which `rows` and `halo` are multiples. Each part is
    given `halo` more rows on either side, as far as there are any; what the function gives for those is
    dropped. Gradients pass through.

    Gives a tensor if the function does, else a tuple. If all fits into one part the function is called as it
    is.
    """
    axes = [axis] if isinstance(axis, int) else axis
    lengths = [tensors[0].shape[a] for a in axes]

    def part(tile: Tile) -> Any:
        return function(*(_cut(t, tile.outer, axes) for t in tensors))

    tiles = list(tiles_of(lengths, rows, halo))
    made = in_order(part, tiles) if tensors[0].device.type == "cpu" else map(part, tiles)
    return assembled(lengths, zip(tiles, made), axes)


def assembled(
    lengths: Sequence[int], parts: Iterable[tuple[Tile, Any]], axes: Sequence[int] = (-2, -1)
) -> Any:
    """Tensors of a frame (h, w), put together from the inner parts of those of its tiles.

    Of each tile a tensor or several are given, as large as the outer box or smaller by a whole factor. A tile
    that is the whole frame is given back as it is.
    """
    planes: list[_Plane] = []
    single = False
    for tile, made in parts:
        single = isinstance(made, Tensor)
        tensors = (made,) if single else tuple(made)
        if tile.inner == whole(lengths).inner:
            return made if single else tensors
        planes = planes or [_Plane(tensor, tile, lengths, axes) for tensor in tensors]
        for plane, tensor in zip(planes, tensors):
            plane.add(tensor, tile)
        del made, tensors, tensor
    joined = tuple(plane.tensor() for plane in planes)
    return joined[0] if single else joined


def sides_by_work(hw: Sequence[int], halo: int, multiple: int, most: float) -> list[tuple[int, int]]:
    """Heights and widths of tiles of at most `most` pixels with their halos, the least work first."""
    h, w = hw
    sides: dict[tuple[int, int], int] = {}
    for rows in range(1, -(-h // 64) + 1):
        for columns in range(1, -(-w // 64) + 1):
            side = (
                max(-(-h // rows // multiple) * multiple, 64),
                max(-(-w // columns // multiple) * multiple, 64),
            )
            if side not in sides and math.prod(min(s + 2 * halo, n) for s, n in zip(side, hw)) <= most:
                sides[side] = math.prod(_covered_length(n, s, halo) for n, s in zip(hw, side))
    return sorted(sides, key=lambda side: sides[side])


def _covered_length(length: int, side: int, halo: int) -> int:
    """The sum of the lengths of pieces with their halos."""
    return sum(min(last + halo, length) - max(first - halo, 0) for first, last in spans(length, side))


class _Plane:
    """A tensor put together from parts: written in place, so that parts can be forgotten.

    Along a single axis they are concatenated at the end where something follows them (gradients,
    transformations): gradients through writing in place copy the whole once a part.
    """

    def __init__(self, block: Tensor, tile: Tile, lengths: Sequence[int], axes: Sequence[int]) -> None:
        self.axes = axes
        self.factor = (tile.outer[1] - tile.outer[0]) // block.shape[axes[0]]
        self.parts: list[Tensor] = []
        self.whole: Tensor | None = None
        if len(axes) > 1 or not (block.requires_grad or transformations()):
            shape = list(block.shape)
            for axis, n in zip(axes, lengths):
                shape[axis] = n // self.factor
            order = sorted(range(block.ndim), key=block.stride, reverse=True)
            self.whole = torch.empty_permuted(shape, order, dtype=block.dtype, device=block.device)

    def add(self, block: Tensor, tile: Tile) -> None:
        """Keep the inner part of what was made of a tile."""
        inner, outer = (tuple(n // self.factor for n in box) for box in tile)
        begin = [n for n in outer[::2] for _ in range(2)]
        block = _cut(block, tuple(n - first for n, first in zip(inner, begin)), self.axes)
        if self.whole is None:
            self.parts.append(block)
        else:
            _cut(self.whole, inner, self.axes).copy_(block)

    def tensor(self) -> Tensor:
        """All of it."""
        return torch.cat(self.parts, self.axes[0]) if self.whole is None else self.whole


def _cut(t: Tensor, box: Box, axes: Sequence[int]) -> Tensor:
    for axis, first, last in zip(axes, box[::2], box[1::2]):
        t = t.narrow(axis, first, last - first)
    return t
