"""Processing in parts: boxes of an image with halos, and functions called for one part after the other."""

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
"""Rows at a time: for an image of 12 megapixels, 12 MB of three colours in float32."""

Box = tuple[int, ...]
"""First pixel, and the one after the last, along each axis: (top, bottom, left, right) of an image."""


class Tile(NamedTuple):
    """Box of a result, and the box of the input that it needs.

    Attributes:
        inner: box of the result: first row, row after the last, first column, column after the last; two
            numbers where a single axis is cut.
        outer: the same box with a halo, as far as the frame goes.
    """

    inner: Box
    outer: Box


def area(box: Box) -> int:
    """Return the number of pixels in a box."""
    return math.prod(last - first for first, last in zip(box[::2], box[1::2]))


def slices(box: Sequence[int]) -> tuple[Any, ...]:
    """Convert a box to the index that selects it."""
    return tuple(slice(*span) for span in zip(box[::2], box[1::2]))


def whole(lengths: Sequence[int]) -> Tile:
    """Return one tile for all of a frame (h, w)."""
    box = tuple(chain(*((0, n) for n in lengths)))
    return Tile(box, box)


def spans(length: int, step: int) -> list[tuple[int, int]]:
    """Split a length into (first, last + 1) of parts of `step`, the last perhaps shorter; one empty for 0."""
    return [(first, min(first + step, length)) for first in range(0, max(length, 1), step)]


def tiles_of(lengths: Sequence[int], side: int | Sequence[int], halo: int) -> Iterator[Tile]:
    """Yield the tiles of a frame row by row, the last of a row or column as small as what is left.

    Args:
        lengths: lengths (h, w) of the frame, or of any axes; a length of 0 has one empty part.
        side: side of square tiles, or one for each axis; 1 or more.
        halo: pixels around each tile, as far as the frame goes.
    """
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
    """Compute `function(*tensors)` for some rows at a time; with several axes, for one tile at a time.

    Results must be tensors as long as the input along the axis, or shorter by one whole factor that divides
    the lengths, `rows` and `halo` (not checked). Each part gets up to `halo` more rows on either side, whose
    results are dropped. On the CPU parts may run on several threads (`in_order`). Gradients pass through.

    Args:
        function: function of tensors that returns a tensor or a tuple of tensors.
        tensors: tensors, one or more, of one length along the axis (or axes).
        rows: length of a part along the axis, or lengths along each.
        halo: rows to add on either side.
        axis: axis, or axes, of arguments and results to cut along.

    Returns:
        A tensor if the function returns one, else a tuple; what the function returned if all is one part.
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
    """Assemble tensors of a frame (h, w) from the inner parts of its tiles' results.

    Args:
        lengths: lengths of the whole frame along `axes`.
        parts: tiles in the order of `tiles_of`, which cover the frame, with one tensor or several each, as
            large as the outer box or smaller by a whole factor.
        axes: axes of the tensors that the tiles cut.

    Returns:
        A tensor if the parts are tensors, else a tuple, empty without parts. The tensors of a tile that is
        the whole frame are returned themselves.
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
    """List sizes of tiles that cut a frame evenly, the least total work (pixels of all tiles) first.

    Args:
        hw: height and width of the frame.
        halo: pixels around each tile, as far as the frame goes, which count in the work and in `most`.
        multiple: number that sides are multiples of, unless they are 64, the least.
        most: largest number of pixels of a tile.

    Returns:
        (height, width) of tiles without halos, which may exceed the frame's; empty if none fits.
    """
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
    """Total length of pieces with their halos."""
    return sum(min(last + halo, length) - max(first - halo, 0) for first, last in spans(length, side))


class _Plane:
    """Tensor assembled from parts: written in place, so that parts can be released.

    Along a single axis they are concatenated at the end if something follows them (gradients,
    transformations): gradients through writing in place copy the whole once for each part.
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
        """Keep the inner part of a tile's result."""
        inner, outer = (tuple(n // self.factor for n in box) for box in tile)
        begin = [n for n in outer[::2] for _ in range(2)]
        block = _cut(block, tuple(n - first for n, first in zip(inner, begin)), self.axes)
        if self.whole is None:
            self.parts.append(block)
        else:
            _cut(self.whole, inner, self.axes).copy_(block)

    def tensor(self) -> Tensor:
        """Return the whole tensor."""
        return torch.cat(self.parts, self.axes[0]) if self.whole is None else self.whole


def _cut(t: Tensor, box: Box, axes: Sequence[int]) -> Tensor:
    for axis, first, last in zip(axes, box[::2], box[1::2]):
        t = t.narrow(axis, first, last - first)
    return t
