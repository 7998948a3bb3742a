"""Cutting frames into pieces with halos, among them those in which large frames are matched."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from torch import Tensor

from arraygeom.fields.grid import Box
from arraygeom.pixels import HW

MATCHING_HALO = 128
"""The halo of the pieces in which large frames are matched at full size, pixels."""
MATCHED_AT_ONCE = 1_600_000
"""Pixels of alpha matched at once. Larger frames are cut the same way whatever memory is allowed, so that results do
not depend on it."""


class Tile(NamedTuple):
    """Rows and columns of the output, and of alpha's image that they need: (top, bottom, left, right)."""

    inner: Box
    outer: Box


def area(box: Box) -> int:
    """Pixels in a box."""
    top, bottom, left, right = box
    return (bottom - top) * (right - left)


def whole(hw: HW) -> Tile:
    """A frame as one tile."""
    return Tile((0, hw[0], 0, hw[1]), (0, hw[0], 0, hw[1]))


def tiles_of(hw: HW, side: int | tuple[int, int], halo: int) -> Iterator[Tile]:
    """Tiles (square, or of a height and a width) with a halo, cut off at the frame's borders."""
    (h, w), (rows, columns) = hw, side if isinstance(side, tuple) else (side, side)
    for top in range(0, h, rows):
        for left in range(0, w, columns):
            bottom, right = min(top + rows, h), min(left + columns, w)
            outer = (max(top - halo, 0), min(bottom + halo, h), max(left - halo, 0), min(right + halo, w))
            yield Tile((top, bottom, left, right), outer)


def sides_by_work(hw: HW, halo: int, multiple: int, most: float) -> list[tuple[int, int]]:
    """Heights and widths of tiles of at most `most` pixels with their halos, the least work first."""
    h, w = hw
    sides: dict[tuple[int, int], int] = {}
    for rows in range(1, -(-h // 64) + 1):
        for columns in range(1, -(-w // 64) + 1):
            side = max(-(-h // rows // multiple) * multiple, 64), max(-(-w // columns // multiple) * multiple, 64)
            if side not in sides and math.prod(min(s + 2 * halo, n) for s, n in zip(side, hw)) <= most:
                sides[side] = math.prod(_covered_length(n, s, halo) for n, s in zip(hw, side))
    return sorted(sides, key=lambda side: sides[side])


def _covered_length(length: int, side: int, halo: int) -> int:
    """The sum of the lengths of pieces with their halos."""
    return sum(min(i + side + halo, length) - max(i - halo, 0) for i in range(0, length, side))


def matching_pieces(hw: HW, multiple: int) -> list[Tile]:
    """The pieces in which a frame is matched: one, or those with the least work of at most `MATCHED_AT_ONCE` pixels."""
    if math.prod(hw) <= MATCHED_AT_ONCE:
        return [whole(hw)]
    return list(tiles_of(hw, sides_by_work(hw, MATCHING_HALO, multiple, MATCHED_AT_ONCE)[0], MATCHING_HALO))


def from_pieces(hw: HW, multiple: int, make: Callable[[Box], Iterable[Tensor]]) -> list[Tensor]:
    """Planes put together from the inner parts of the pieces in which a frame is matched. `make` gives those of a box;
    they may be smaller than it by whole factors."""
    found: list[Tensor] = []
    for inner, outer in matching_pieces(hw, multiple):
        parts = list(make(outer))
        if inner == outer:
            return parts
        steps = [(outer[1] - outer[0]) // part.shape[-2] for part in parts]
        found = found or [p.new_empty(*p.shape[:-2], *(n // s for n in hw)) for p, s in zip(parts, steps)]
        for target, part, s in zip(found, parts, steps):
            top, bottom, left, right = (n // s for n in inner)
            y, x = top - outer[0] // s, left - outer[2] // s
            target[..., top:bottom, left:right] = part[..., y : y + bottom - top, x : x + right - left]
        del parts, part
    return found
