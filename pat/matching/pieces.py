"""How large frames are cut into tiles, among them the pieces in which they are matched."""

from __future__ import annotations

import math

from arraygeom.chunks import Tile, spans, tiles_of, whole
from arraygeom.pixels import HW

MATCHING_HALO = 128
"""The halo of the pieces in which large frames are matched at full size, pixels."""
MATCHED_AT_ONCE = 1_600_000
"""Pixels of alpha matched at once. Larger frames are cut the same way whatever memory is allowed, so that results do
not depend on it."""


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
    return sum(min(last + halo, length) - max(first - halo, 0) for first, last in spans(length, side))


def matching_pieces(hw: HW, multiple: int) -> list[Tile]:
    """The pieces in which a frame is matched: one, or those with the least work of at most `MATCHED_AT_ONCE` pixels."""
    if math.prod(hw) <= MATCHED_AT_ONCE:
        return [whole(hw)]
    return list(tiles_of(hw, sides_by_work(hw, MATCHING_HALO, multiple, MATCHED_AT_ONCE)[0], MATCHING_HALO))
