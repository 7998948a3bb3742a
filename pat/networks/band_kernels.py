"""The compiled loops of `pat.networks.matching`: semi-global matching over few labels around a known disparity.

Each pixel has two runs of `RUN` consecutive labels, from `low` and from `high`, which do not overlap. One image, one
thread, without Python's lock.
"""

from __future__ import annotations

import numpy as np

from pat.attention.kernels import compiled, separate_cache

from .semi_global_kernels import (
    FARTHEST,
    HALF,
    MOST,
    NOWHERE,
    ONE,
    UNSEEN,
    _between,
    _pixel,
    dissimilarity,
    jump_between,
)

RUN = 5
"""Labels in a run."""
LABELS = 2 * RUN


@compiled(inline="always")
def _label(low, high, k):
    return low + k if k < RUN else high + k - RUN


@compiled(nogil=True, cache=True)
def band_costs(own, own_bits, other, other_bits, end, along, length, cut, low, high, out):
    """Dissimilarity of alpha's pixel (own) and beta's (other) at each label of the runs: out (h, w, LABELS)."""
    height, width = own.shape
    rows, columns = other.shape
    for y in range(height):
        for x in range(width):
            last = length[y, x] + HALF
            beyond = UNSEEN if cut[y, x] else NOWHERE
            for k in range(LABELS):
                label = _label(low[y, x], high[y, x], k)
                column, row = _pixel(end[y, x], along[y, x], label)
                if label > last:
                    out[y, x, k] = beyond
                elif column < 0 or row < 0 or column >= columns or row >= rows:
                    out[y, x, k] = NOWHERE
                else:
                    place = row, column
                    out[y, x, k] = dissimilarity(own[y, x], own_bits[y, x], other[place], other_bits[place])


@compiled(inline="always")
def _aligned(before, origin_low, origin_high, first, out):
    """The neighbour's path costs at labels first - 1 to first + RUN, `MOST` where it has no such label."""
    for i in range(RUN + 2):
        label = first - 1 + i
        out[i] = MOST
        if origin_low <= label < origin_low + RUN:
            out[i] = before[label - origin_low]
        elif origin_high <= label < origin_high + RUN:
            out[i] = before[RUN + label - origin_high]


@compiled(inline="always")
def _advance(before, there, least, cost, here, total, now, small, jump, at):
    """One step of a path, between pixels whose runs begin at `there` and `here`: its costs `now`, added to `total`; the
    least."""
    fewest = MOST
    for run in range(2):
        _aligned(before, there[0], there[1], here[run], at)
        for i in range(RUN):
            k = run * RUN + i
            step = min(at[i], at[i + 2]) + small
            stay = min(at[i + 1], least + jump)
            now[k] = np.float32(cost[k]) + min(step, stay) - least
            total[k] += now[k]
            fewest = min(fewest, now[k])
    return fewest


@compiled(nogil=True, cache=True, fastmath=True)
def band_aggregate(cost, guide, low, high, small, large, total):
    """The sum over eight paths of semi-global matching (Hirschmüller 2008), added to total (h, w, LABELS).

    Penalties of neighbours whose labels differ by one (small), and by more (large, where alpha shows no edge).
    """
    for dx in range(-1, 2):
        for way in range(2):
            _sweep(cost, guide, low, high, small, large, total, dx, way)
    for way in range(2):
        _sweep_rows(cost, guide, low, high, small, large, total, way)


@compiled(inline="always")
def _sweep_rows(cost, guide, low, high, small, large, total, way):
    """Paths along rows."""
    height, width, _ = cost.shape
    before, now = np.zeros((2, LABELS), np.float32)
    at = np.empty(RUN + 2, np.float32)
    first, step = (0, 1) if way == 0 else (width - 1, -1)
    for y in range(height):
        least = np.float32(0)
        for i in range(width):
            x = first + i * step
            if i == 0:
                for k in range(LABELS):
                    now[k] = cost[y, x, k]
                    total[y, x, k] += now[k]
                least = now.min()
            else:
                jump = jump_between(guide[y, x], guide[y, x - step], small, large)
                there = low[y, x - step], high[y, x - step]
                here = low[y, x], high[y, x]
                least = _advance(before, there, least, cost[y, x], here, total[y, x], now, small, jump, at)
            before, now = now, before


@compiled(inline="always")
def _sweep(cost, guide, low, high, small, large, total, dx, way):
    """Paths from row to row, that move by `dx` columns on the way."""
    height, width, _ = cost.shape
    before, now = np.zeros((2, width, LABELS), np.float32)
    fewest, fewer = np.zeros((2, width), np.float32)
    at = np.empty(RUN + 2, np.float32)
    first, step = (0, 1) if way == 0 else (height - 1, -1)
    for i in range(height):
        y = first + i * step
        for x in range(width):
            origin = x - dx
            if i == 0 or origin < 0 or origin >= width:
                for k in range(LABELS):
                    now[x, k] = cost[y, x, k]
                    total[y, x, k] += now[x, k]
                fewer[x] = now[x].min()
            else:
                jump = jump_between(guide[y, x], guide[y - step, origin], small, large)
                there = low[y - step, origin], high[y - step, origin]
                here = low[y, x], high[y, x]
                fewer[x] = _advance(
                    before[origin], there, fewest[origin], cost[y, x], here, total[y, x], now[x], small, jump, at
                )
        before, now = now, before
        fewest, fewer = fewer, fewest


@compiled(nogil=True, cache=True)
def band_winners(total, low, high, end, along, length, rows, columns, disparity, unlike):
    """Each pixel's best label, to a fraction (disparity), and its distance from the best label of all alpha pixels that
    match the same pixel of beta (unlike, 0 to 1)."""
    height, width, _ = total.shape
    lowest = np.full((rows, columns), MOST, np.float32)
    claims = np.full((rows, columns), np.int32(-100000), np.int32)
    for y in range(height):
        for x in range(width):
            for k in range(LABELS):
                label = _label(low[y, x], high[y, x], k)
                if label <= length[y, x] + HALF:
                    column, row = _pixel(end[y, x], along[y, x], label)
                    if 0 <= row < rows and 0 <= column < columns and total[y, x, k] < lowest[row, column]:
                        lowest[row, column], claims[row, column] = total[y, x, k], label
    for y in range(height):
        for x in range(width):
            best = 0
            for k in range(1, LABELS):
                if total[y, x, k] < total[y, x, best]:
                    best = k
            label = _label(low[y, x], high[y, x], best)
            run = 0 if best < RUN else RUN
            fraction = _between(total[y, x, run : run + RUN], best - run, RUN - 1)
            disparity[y, x] = np.float32(label) + fraction
            column, row = _pixel(end[y, x], along[y, x], label)
            unlike[y, x] = ONE
            if label <= length[y, x] + HALF and 0 <= row < rows and 0 <= column < columns:
                unlike[y, x] = min(np.float32(abs(claims[row, column] - label)) / FARTHEST, ONE)


for _entry in (band_costs, band_aggregate, band_winners):
    separate_cache(_entry)
