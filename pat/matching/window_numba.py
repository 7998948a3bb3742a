"""The compiled loops of `pat.matching.subpixel`: semi-global matching over few labels around a known disparity.

Each pixel has two runs of `RUN` consecutive labels, from `low` and from `high`, which do not overlap. One image, one
thread, without Python's lock.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types

from pat.attention.kernels.emit import LANES, Vector, compiled, instruction, separate_cache
from pat.attention.kernels.layout import pointers
from pat.attention.kernels.vectors import add, from_index, load, splat, store

from .semi_global_numba import (
    FARTHEST,
    HALF,
    MOST,
    NOWHERE,
    ONE,
    UNSEEN,
    _between,
    dissimilarity,
    jump_between,
)

RUN = 5
"""Labels in a run."""
HIGH = 8
"""Lane of the second run's first label, of the `LANES` that a pixel's costs are in; those that stand for no label are
computed, but never the least."""

NOTHING = np.int64(2**63 - 1)
"""More than any cost and label together."""


@compiled(inline="always")
def _label(low, high, lane):
    return low + lane if lane < HIGH else high + lane - HIGH


@compiled(inline="always")
def _positions(end, along, low, high, last, rows, columns, out):
    """Where the lanes' labels are in beta, pixels counted row by row; rows * columns for those that are not on it or
    beyond the last."""
    for lane in range(LANES):
        label = np.float32(low + lane if lane < HIGH else high + lane - HIGH)
        column = np.int32(np.floor(end[0] + label * along[0] + HALF))
        row = np.int32(np.floor(end[1] + label * along[1] + HALF))
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows) & (label <= last)
        out[lane] = np.int32(row * columns + column) if inside else np.int32(rows * columns)


@compiled(nogil=True, cache=True)
def band_costs(own, own_bits, other, other_bits, end, along, length, cut, low, high, out):
    """Dissimilarity of alpha's pixel (own) and beta's (other) at each label of the runs: out (h, w, LANES)."""
    height, width = own.shape
    rows, columns = other.shape
    values, bits, at = other.ravel(), other_bits.ravel(), np.empty(LANES, np.int32)
    nowhere = rows * columns
    for y in range(height):
        for x in range(width):
            last, found = length[y, x] + HALF, out[y, x]
            _positions(end[y, x], along[y, x], low[y, x], high[y, x], last, rows, columns, at)
            beyond = UNSEEN if cut[y, x] else NOWHERE
            for lane in range(LANES):
                if lane % HIGH < RUN:
                    place = at[lane]
                    if place < nowhere:
                        cost = dissimilarity(own[y, x], own_bits[y, x], values[place], bits[place])
                    else:
                        cost = beyond if _label(low[y, x], high[y, x], lane) > last else NOWHERE
                    found[lane] = cost


@instruction(lambda cost, i: Vector(types.float32))
def _costs_at(code, cost, i: index):
    """The costs of all lanes of a pixel."""
    return code.uitofp(code.get(code.kinds[0], cost, i), ir.VectorType(ir.FloatType(), LANES))


@instruction(lambda path, *_: path)
def _one_step(code, path, least, small, jump, cost):
    """The costs of a path at the next pixel, whose runs are the same; those of lanes without a label mean nothing."""

    def less(a, b):
        return code.select(code.fcmp_ordered("<", a, b), a, b)

    before, after = (code.shuffle(path, None, [(k + i) % LANES for k in range(LANES)]) for i in (-1, 1))
    step = code.fadd(less(before, after), code.repeat(small))
    stay = less(path, code.repeat(code.fadd(least, jump)))
    return code.fsub(code.fadd(cost, less(step, stay)), code.repeat(least))


@instruction(lambda path, beside: path)
def _walled(code, path, beside):
    """The path with `MOST` in lanes without a label; but if the second run is `beside` the first, each goes on into the
    other."""
    most = ir.Constant(path.type, [float(MOST)] * LANES)
    wall, runs = LANES, [k if k % HIGH < RUN else LANES for k in range(LANES)]
    apart = code.shuffle(path, most, runs)
    joined = code.shuffle(path, most, [*runs[:RUN], HIGH, wall, RUN - 1, *runs[HIGH:]])
    return code.select(beside, joined, apart)


@instruction(lambda path: path.scalar)
def _least(code, path):
    """The least of a path's costs."""
    return code.intrinsic("llvm.vector.reduce.fmin.%", path.type.element, [path], fastmath=["nnan"])


@instruction(lambda *_: Vector(types.float32))
def _aligned(code, path, there, here):
    """The neighbour's path, whose runs begin at `there`, at the labels of the runs that begin at `here`, and at those
    beside them; `MOST` where it has no such label. All are pointers; memory `LANES` around the path can be read."""
    count = ir.IntType(32)
    lanes, most = (
        ir.VectorType(count, HIGH)([*range(-1, HIGH - 1)]),
        ir.VectorType(ir.FloatType(), HIGH)([float(MOST)] * HIGH),
    )
    first, second = (code.load(code.gep(there, [count(run)])) for run in range(2))
    runs = []
    for run in range(2):
        begin, found = code.load(code.gep(here, [count(run)])), most
        for start, of_run in ((first, 0), (second, HIGH)):
            step = code.sub(begin, start)
            step = code.select(code.icmp_signed("<", step, count(-RUN - 1)), count(-RUN - 1), step)
            step = code.select(code.icmp_signed(">", step, count(RUN + 1)), count(RUN + 1), step)
            stored = code.get(types.CPointer(types.float32), path, code.offset(step, of_run - 1), HIGH)
            within = code.icmp_unsigned("<", code.add(lanes, code.repeat(step, HIGH)), lanes.type([RUN] * HIGH))
            found = code.select(within, stored, found)
        runs.append(found)
    return code.shuffle(*runs, [*range(1, 2 * HIGH), 0])


@compiled(nogil=True, cache=True)
def band_aggregate(cost, guide, low, high, small, large, total):
    """The sum over eight paths of semi-global matching (Hirschmüller 2008): total (h, w, LANES).

    Penalties of neighbours whose labels differ by one (small), and by more (large, where alpha shows no edge).
    """
    width = cost.shape[1]
    runs, paths = np.stack((low, high), -1), np.empty((6 * width + 3) * LANES, np.float32)
    fewest = np.empty(6 * width + 1, np.float32)
    for way in range(2):
        _sweep(way, guide, runs, cost.reshape(-1), small, large, total.reshape(-1), paths, fewest)


@compiled
def _sweep(way, guide, runs, cost, small, large, total, paths, fewest):
    """Four paths at once, so that costs and sums go through memory twice in all: from the pixel before in the row, and
    from three of the row before. With `way` 1 rows and columns are taken from the last."""
    height, width = guide.shape
    cost, total, runs, paths, fewest = pointers((cost, total, runs.reshape(-1), paths[LANES:], fewest))
    none, step = np.float32(0), 1 - 2 * way
    for row in range(height):
        y = row if way == 0 else height - 1 - row
        for i in range(width):
            x = i if way == 0 else width - 1 - i
            p = y * width + x
            here, costs = from_index(runs, 2 * p), _costs_at(cost, p * LANES)
            beside = here[1] - here[0] == RUN
            sums = splat(none)
            for k in range(4):
                # Three paths come from the row before and are kept by columns, the fourth from the pixel before.
                dx = k - 1 if k < 3 else -step
                dy = step if k < 3 else 0
                now = (row % 2 * 3 + k) * width + x if k < 3 else 6 * width
                if (k < 3 and row == 0) or not 0 <= x + dx < width:
                    path = _walled(costs, beside)
                else:
                    before = ((row + 1) % 2 * 3 + k) * width + x + dx if k < 3 else now
                    there, path = from_index(runs, 2 * (p - dy * width + dx)), load(paths, before * LANES)
                    if there[0] != here[0] or there[1] != here[1]:
                        path = _aligned(from_index(paths, before * LANES), there, here)
                    jump = jump_between(guide[y, x], guide[y - dy, x + dx], small, large)
                    path = _walled(_one_step(path, fewest[before], small, jump, costs), beside)
                store(paths, now * LANES, path)
                fewest[now] = _least(path)
                sums = add(sums, path)
            store(total, p * LANES, sums if way == 0 else add(load(total, p * LANES), sums))


@compiled(nogil=True, cache=True)
def band_winners(total, costs, low, high, end, along, length, rows, columns, disparity, unlike):
    """Each pixel's best label, to a fraction (disparity), and its distance from the best label of all alpha pixels that
    match the same pixel of beta (unlike, 0 to 1). `costs` is `total` seen as int32: the order of positive floats is
    that of their bits."""
    height, width, _ = total.shape
    nowhere = rows * columns
    claims = np.full(nowhere + 1, NOTHING)
    matched, at = np.empty((height, width), np.int32), np.empty(LANES, np.int32)
    for y in range(height):
        for x in range(width):
            sums, least = costs[y, x], NOTHING
            _positions(end[y, x], along[y, x], low[y, x], high[y, x], length[y, x] + HALF, rows, columns, at)
            for lane in range(LANES):
                if lane % HIGH < RUN:
                    label, cost = np.int64(_label(low[y, x], high[y, x], lane)), np.int64(sums[lane]) << 32
                    claims[at[lane]] = min(claims[at[lane]], cost | label)
                    least = min(least, cost | np.int64(lane))
            best = least & 15
            run = 0 if best < RUN else HIGH
            label = np.float32(_label(low[y, x], high[y, x], best))
            disparity[y, x] = label + _between(total[y, x, run : run + RUN], best - run, RUN - 1)
            matched[y, x], unlike[y, x] = at[best], label
    for y in range(height):
        for x in range(width):
            away = abs(np.float32(claims[matched[y, x]] & 0xFFFFFFFF) - unlike[y, x])
            unlike[y, x] = min(away / FARTHEST, ONE) if matched[y, x] < nowhere else ONE


for _entry in (band_costs, band_aggregate, band_winners):
    separate_cache(_entry)
