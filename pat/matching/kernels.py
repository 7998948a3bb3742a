"""Compiled loops of semi-global matching, of the planes through it and of the choice after it.

Each works on one image, in one thread, without Python's lock.

In semi-global matching each pixel has one or two *runs* of `count` consecutive labels, which begin at `first`
(h, w, runs) and do not overlap. Costs and sums of a run are in lanes, of which those after the last label
mean nothing: a single run has as many as it needs, a multiple of 16; of two, each has 8, of which at most 5
are labels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from arraygeom.runtime.compiled import compiled, renew_with
from pat.attention.kernels import SOURCES
from pat.attention.kernels.emit import LANES, NARROW, Vector, instruction
from pat.attention.kernels.layout import pointers
from pat.attention.kernels.vectors import add_int, from_index, load, splat, store

from .cost import NOWHERE, UNSEEN, dissimilarity, pixel_of
from .inputs import FINE

NO_LABEL = np.uint8(255)
"""Cost of a lane without a label: so much more than `NOWHERE` and a jump that no path ever comes from one."""
EDGE = np.float32(4 / 255)
"""Difference of alpha's neighbours that halves the larger penalty."""
FARTHEST = np.float32(8)
"""Largest difference of labels in the left-right check."""
ONE = np.float32(1.0)
HALF = np.float32(0.5)
PARTS = 16
"""Sums of costs are whole 16ths in 16 bits: twice as many as floats go through memory in the same time."""
UNRELATED = np.float32(0.2)
"""Cost of the second best, in the unit of the facts, where a segment has no other label: margins are those of
right matches then, .16 to .29 on Middlebury, and none of wrong ones, which cost .26 to .29."""
WALL = np.int16(30000)
"""Value above any sum of costs along a path, in parts."""


@compiled(inline="always")
def _halves(first, runs, lane):
    """Return the first labels of both halves of the vector of a pixel's lanes that begins at `lane`."""
    return (first[0] + lane, first[0] + lane + NARROW) if runs == 1 else (first[0], first[1])


@compiled(inline="always")
def _places(end, along, low, high, last, rows, columns, out):
    """Write the pixels of a vector of labels in beta, row by row; -1 for those off it or beyond the last.

    The vector's halves begin at `low` and `high`.
    """
    for k in range(LANES):
        label = np.float32(low + k if k < NARROW else high + k - NARROW)
        column = np.int32(np.floor(end[0] + label * along[0] + HALF))
        row = np.int32(np.floor(end[1] + label * along[1] + HALF))
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows) & (label <= last)
        out[k] = np.int32(row * columns + column) if inside else np.int32(-1)


@compiled(inline="always")
def _count_within(length, first, count):
    """Return the number of a run's labels that are on a segment."""
    return min(max(int(np.floor(length + HALF)) + 1 - first, 0), count)


@compiled(nogil=True, cache=True)
def costs(alpha, beta, first, count, end, along, length, cut, rows, columns, out):
    """Compute the matching cost of each label of each pixel.

    Label l lies l pixels from the segment's end. Labels off beta and beyond the segment's length cost
    `NOWHERE`; those beyond the length cost `UNSEEN` where it is beta's edge that cuts the segment.

    Args:
        alpha: flat planes of alpha, as `planes_of` computes them.
        beta: flat planes of beta.
        first: first label of each run (h, w, runs).
        count: labels per run.
        end: ends of the segments (h, w, 2), pixels of beta.
        along: unit vectors (h, w, 2) from end to start.
        length: lengths (h, w), pixels of beta; negative for none.
        cut: 1 where beta's edge may cut the segment (h, w).
        rows: height of beta.
        columns: width of beta.
        out: costs (h, w, runs, lanes), uint8, to write; lanes from `count` on have no label.
    """
    height, width, runs, lanes = out.shape
    size, places, best_label = runs * lanes, np.empty(runs * lanes, np.int32), np.empty(lanes, np.uint8)
    for y in range(height):
        for x in range(width):
            last, pixel = length[y, x] + HALF, pixel_of(alpha, y * width + x)
            for lane in range(0, size, LANES):
                low, high = _halves(first[y, x], runs, lane)
                _places(end[y, x], along[y, x], low, high, last, rows, columns, places[lane:])
            beyond = UNSEEN if cut[y, x] else NOWHERE
            for run in range(runs):
                within = _count_within(length[y, x], first[y, x, run], count)
                targets, costs = places[run * lanes :], out[y, x, run]
                for k in range(within):
                    best_label[k] = dissimilarity(pixel, pixel_of(beta, max(targets[k], 0)))
                for k in range(lanes):
                    cost = best_label[k] if targets[k] >= 0 else NOWHERE
                    cost = cost if k < within else beyond
                    costs[k] = cost if k < count else NO_LABEL


@instruction(lambda cost, i: Vector(types.int16))
def _costs_at(code, cost, i: index):
    """Load the costs of a pixel's lanes from an index on, in parts."""
    stored = code.get(code.kinds[0], cost, i)
    wide = code.zext(stored, ir.VectorType(ir.IntType(16), LANES))
    return code.mul(wide, wide.type([PARTS] * LANES))


@instruction(lambda path, i, j: Vector(types.int16))
def _load_halves(code, path, i: index, j: index):
    """Load half a vector from either index."""
    low, high = (code.get(code.kinds[0], path, start, NARROW) for start in (i, j))
    return code.shuffle(low, high, [*range(LANES)])


@instruction(lambda *_: types.void)
def _store_halves(code, path, i: index, j: index, vector):
    """Store half a vector at either index."""
    for start, lanes in ((i, range(NARROW)), (j, range(NARROW, LANES))):
        code.put(code.kinds[0], path, start, code.shuffle(vector, None, [*lanes]))


def _lesser(code, a, b):
    return code.select(code.icmp_unsigned("<", a, b), a, b)


_less = instruction(lambda a, b: a)(_lesser)
"""Return the lesser of two, lane by lane, of values that are not negative."""
_subtract = instruction(lambda a, b: a)(lambda code, a, b: code.sub(a, b))


@instruction(lambda path, small: path)
def _spread(code, path, small):
    """Return the costs of two runs' labels, and those beside them, for a neighbour without a jump's penalty.

    Each run is in half a vector. One lane farther on, so that lane 0 is of the label before the run.
    """
    back = [[half + (k - n) % NARROW for half in (0, NARROW) for k in range(NARROW)] for n in (1, 2)]
    one_back, two_back = (code.shuffle(path, None, lanes) for lanes in back)
    return _lesser(code, one_back, code.add(_lesser(code, two_back, path), small))


@instruction(lambda *_: types.UniTuple(types.int64, 4))
def _shifts(code, here, there, reach: index):
    """Return the shifts from the neighbour's first labels to a pixel's, at most `reach`.

    To the first and second from the first and second, and from the second and first. Beyond `reach` they have
    no labels in common, not even beside them.
    """
    a, b = (code.get(kind, pointer, ir.IntType(64)(0), 2) for kind, pointer in zip(code.kinds, (here, there)))
    a, b = code.shuffle(a, None, [0, 1, 0, 1]), code.shuffle(b, None, [0, 1, 1, 0])
    most = code.repeat(code.trunc(reach, ir.IntType(32)), 4)
    least, shift = code.neg(most), code.sub(a, b)
    shift = code.select(code.icmp_signed("<", shift, most), shift, most)
    shift = code.select(code.icmp_signed(">", shift, least), shift, least)
    wide = code.sext(shift, ir.VectorType(ir.IntType(64), 4))
    return code.pack([code.extract_element(wide, ir.IntType(32)(k)) for k in range(4)])


@instruction(lambda path: path.scalar)
def _least(code, path):
    """Return the least of a vector's lanes."""
    kind = ir.FunctionType(path.type.element, [path.type])
    name = f"llvm.vector.reduce.umin.v{LANES}i16"
    return code.call(cgutils.get_or_insert_function(code.module, kind, name), [path])


@compiled(inline="always")
def _jumps(guide, beside, small, large, out):
    """Write penalties of labels that differ by more than one, by alpha's brightness; in parts."""
    for i in range(len(guide)):
        out[i] = np.int16(max(small + ONE, large / (ONE + abs(guide[i] - beside[i]) / EDGE)) * PARTS + HALF)


@compiled(nogil=True, cache=True)
def aggregate(cost, guide, first, count, small, large, total):
    """Sum costs over eight semi-global paths (Hirschmüller 2008).

    Args:
        cost: costs (h, w, runs, lanes), as `costs` writes them.
        guide: alpha (h, w), whose edges lower the large penalty.
        first: first label of each run (h, w, runs).
        count: labels per run.
        small: penalty of neighbours whose labels differ by one.
        large: penalty of those that differ by more, where alpha shows no edge.
        total: sums (h, w, runs, lanes), int16, in units of 1 / `PARTS`, to write.
    """
    height, width, runs, lanes = cost.shape
    reach = count + 1
    pad = (reach + NARROW) // NARROW * NARROW
    # Three rows of paths that the next row reads, two along the row, and one of zeros, from which the first
    # go on.
    slots, stride = 3 * width + 4 * height + 7, runs * (lanes + pad)
    paths, fewest = np.full(slots * stride + lanes + 2 * pad, WALL, np.int16), np.zeros(slots, np.int16)
    for run in range(runs):
        begin = (slots - 1) * stride + run * (lanes + pad) + pad
        paths[begin : begin + lanes] = 0
    planes, jumps = (cost.reshape(-1), first.reshape(-1), total.reshape(-1)), np.zeros((4, width), np.int16)
    for way in range(2):
        _sweep(way, cost.shape, planes, guide, reach, pad, small, large, paths, fewest, jumps)


@compiled(error_model="numpy")
def _sweep(way, shape, planes, guide, reach, pad, small, large, paths, fewest, jumps):
    """Add four paths at once, so that costs and sums go through memory twice in all.

    They come from the pixel before in the row, and from three of the row before. With `way` 1 rows and
    columns are taken from the last. Paths lie where those of pixels were that are no longer needed: in each
    row 0, 1, or 2 slots before their place in the one before, so that the slots that a pixel reads are one
    from those it writes.
    """
    height, width, runs, lanes = shape
    cost, first, total = pointers(planes)
    paths, fewest, ahead, above, behind, beside = pointers(
        (paths, fewest, jumps[0], jumps[1], jumps[2], jumps[3])
    )
    context = cost, first, total, paths, fewest, runs, lanes, pad, reach, splat(np.int16(small * PARTS))
    side, none = 3 * width + 4 * height + 4, 3 * width + 4 * height + 6
    step = 1 - 2 * way
    for row in range(height):
        y = row if way == 0 else height - 1 - row
        for k in range(4):
            dx, dy = ((1 - k) * step, -step) if k < 3 else (-step, 0)
            if row > 0 or k == 3:
                left, right = max(-dx, 0), width - max(dx, 0)
                there = guide[y + dy, left + dx : right + dx]
                _jumps(guide[y, left:right], there, small, large, jumps[k, left:right])
        from_above, from_behind = width + 2 * height + 1 - row, 2 * (width + 2 * height + 1 - row)
        for i in range(width):
            x = i if way == 0 else width - 1 - i
            p = y * width + x
            q = p - step * width
            before = i + 1 if row > 0 and i < width - 1 else none
            _advance(context, p, p if before == none else q + step, before, i, ahead[x], way == 0)
            now = from_above + i
            _advance(context, p, q if row > 0 else p, now + 1 if row > 0 else none, now, above[x], False)
            now = from_behind + i
            before = now + 1 if row > 0 and i > 0 else none
            _advance(context, p, p if before == none else q - step, before, now, behind[x], False)
            now, before = side + i % 2, side + (i + 1) % 2 if i > 0 else none
            _advance(context, p, p if before == none else p - step, before, now, beside[x], False)


@compiled(inline="always")
def _advance(context, p, q, before, now, jump, is_first):
    """Advance a path from pixel q, in slot `before`, to p, in slot `now`, and add its costs to the sums."""
    cost, first, total, paths, fewest, runs, lanes, pad, reach, penalty = context
    base, leap, lowest = splat(fewest[before]), splat(np.int16(fewest[before] + jump)), splat(WALL)
    stride = lanes + pad
    start, end = pad + before * runs * stride, pad + now * runs * stride
    ours, theirs = from_index(first, runs * p), from_index(first, runs * q)
    for lane in range(0, runs * lanes, LANES):
        index = p * runs * lanes + lane
        stay = _reached(paths, start + lane, ours, theirs, reach, stride, runs, penalty)
        path = add_int(_costs_at(cost, index), _subtract(_less(stay, leap), base))
        _keep(paths, end + lane, stride, runs, penalty, path)
        lowest = _less(lowest, path)
        store(total, index, path if is_first else add_int(path, load(total, index)))
    fewest[now] = _least(lowest)


@compiled(inline="always")
def _reached(paths, start, ours, theirs, reach, stride, runs, penalty):
    """Return the costs of a vector of a pixel's labels if they come from a neighbour's without a jump.

    The path of the neighbour begins at `start`, its runs `stride` apart. `ours` and `theirs` are the first
    labels of both. Around a path are walls, so that values read for labels that the neighbour lacks are more
    than any jump.
    """
    if runs == 1:
        here = start + min(max(ours[0] - theirs[0], -reach), reach)
        beside = _less(load(paths, here - 1), load(paths, here + 1))
        return _less(load(paths, here), add_int(beside, penalty))
    shifts, low = _shifts(ours, theirs, reach), start + 1
    high = low + stride
    same = _load_halves(paths, low + shifts[0], high + shifts[1])
    return _less(same, _load_halves(paths, high + shifts[2], low + shifts[3]))


@compiled(inline="always")
def _keep(paths, start, stride, runs, penalty, path):
    """Store a vector of a path for `_reached`.

    Of two runs, the costs of labels beside are computed here already: then a pixel after it reads 4 half
    vectors instead of 12, which takes half the time.
    """
    if runs == 1:
        store(paths, start, path)
    else:
        _store_halves(paths, start, start + stride, _spread(path, penalty))


@compiled(nogil=True, cache=True)
def winners(total, first, count, segments, hw, corner, large, claims, labels):
    """Find the best label of each pixel of a block of alpha.

    Args:
        total: sums of costs (h, w, runs, lanes) of alpha, as `aggregate` writes them.
        first: first label of each run (h, w, runs).
        count: labels per run.
        segments: end, along, length and cut of alpha's segments, as for `costs`.
        hw: height and width of beta.
        corner: first row and column of the block in `total`.
        large: the large penalty.
        claims: int32, for each pixel of beta, and one more, the least cost with which a pixel of alpha
            matches it and that pixel's label (16 bits each), at first the largest int32; updated.
        labels: three arrays to write, of the block: disparity (h, w), the best label to a fraction; numbers
            (h, w, 1 or 3): the best label, its margin, by which the best of labels not beside it costs more
            (the cost of that is `UNRELATED` if there is none), at least 0 and at most 1, and its cost, both
            in units of 8 large penalties; and position (h, w) in beta, pixels counted row by row (height
            times width for none).
    """
    (end, along, length, cut), (rows, columns), (top, left) = segments, hw, corner
    disparity, facts, positions = labels
    height, width, measured = facts.shape[0], facts.shape[1], facts.shape[2] > 1
    _, _, runs, lanes = total.shape
    nowhere, most = rows * columns, np.float32(8 * PARTS) * large
    places = np.empty(runs * lanes, np.int32)
    for y in range(height):
        for x in range(width):
            here = y + top, x + left
            starts, far = first[here], length[here]
            for lane in range(0, runs * lanes, LANES):
                low, high = _halves(starts, runs, lane)
                _places(end[here], along[here], low, high, far + HALF, rows, columns, places[lane:])
            best = np.int32(WALL) << 16
            for run in range(runs):
                sums, start, targets = total[here][run], starts[run], places[run * lanes :]
                within = _count_within(far, start, count)
                for k in range(within):
                    claim = np.int32(sums[k]) << 16 | np.int32(start + k)
                    place = targets[k] if targets[k] >= 0 else nowhere
                    claims[place] = min(claims[place], claim)
                    best = min(best, claim)
                # The very first label is taken if there is no other.
                for k in range(within, count if cut[here] else 1 - run):
                    best = min(best, np.int32(sums[k]) << 16 | np.int32(start + k))
            label, least = best & 0xFFFF, best >> 16
            of_best = 0 if label < starts[0] + count else 1
            sums, k = total[here][of_best], label - starts[of_best]
            last = count if cut[here] else _count_within(far, starts[of_best], count)
            shift = _rounding(end[here], along[here], np.float32(label))
            disparity[y, x] = np.float32(label) + shift + _between(sums, k, last - 1)
            place = places[of_best * lanes + k]
            positions[y, x] = place if place >= 0 else nowhere
            facts[y, x, 0] = np.float32(label)
            if measured:
                second = WALL
                for run in range(runs):
                    sums, start = total[here][run], starts[run]
                    last = count if cut[here] else _count_within(far, start, count)
                    second = min(second, _lowest(sums, 0, min(label - 1 - start, last)))
                    second = min(second, _lowest(sums, max(label + 2 - start, 0), last))
                if second == WALL:  # there is no other label: what a point that is not the same would cost
                    second = max(np.int32(UNRELATED * most), least)
                facts[y, x, 1] = min(np.float32(second - least) / most, ONE)
                facts[y, x, 2] = np.float32(least) / most


@compiled(inline="always")
def _lowest(costs, first, last):
    """Return the least of costs from `first` to before `last`."""
    least = WALL
    for i in range(first, last):
        least = min(least, costs[i])
    return least


@compiled(inline="always")
def _rounding(end, along, label):
    """Return the distance along its segment from a label's position to the pixel of beta it rounds to."""
    x, y = end[0] + label * along[0], end[1] + label * along[1]
    return (np.floor(x + HALF) - x) * along[0] + (np.floor(y + HALF) - y) * along[1]


@compiled(inline="always")
def _between(total, best, last):
    """Return the offset of the minimum from the label, by two lines of equal slope through neighbours."""
    if not 0 < best < last:
        return np.float32(0)
    before, after = np.float32(total[best - 1]), np.float32(total[best + 1])
    deepest = max(before, after) - np.float32(total[best])
    return HALF * (before - after) / deepest if deepest > 0 else np.float32(0)


@compiled(nogil=True, cache=True)
def costs_at(alpha, beta, places, out):
    """Compute the matching cost of each pixel of alpha at explicit pixels of beta.

    Args:
        alpha: flat planes of alpha, as `planes_of` computes them.
        beta: flat planes of beta.
        places: pixels of beta (h, w, labels), counted row by row; -1 for none, which costs `NOWHERE`.
        out: costs (h, w, 1, lanes), uint8, to write; lanes after the last place have no label.
    """
    height, width, labels = places.shape
    for y in range(height):
        for x in range(width):
            pixel, costs = pixel_of(alpha, y * width + x), out[y, x, 0]
            costs[labels:] = NO_LABEL
            for label in range(labels):
                target = places[y, x, label]
                cost = dissimilarity(pixel, pixel_of(beta, max(target, 0)))
                costs[label] = cost if target >= 0 else NOWHERE


for _entry in (costs, aggregate, winners, costs_at):
    renew_with(_entry, [Path(__file__), Path(__file__).with_name("cost.py"), *SOURCES])


COLUMNS = 32
"""Number of columns whose numbers are written at a time: they stay in a core's first cache."""


@compiled(inline="always")
def soft(x):
    """Return x for small x, with absolute values of at most 1."""
    return x / (np.float32(1) + abs(x))


@compiled(nogil=True, cache=True)
def compared(alpha, beta, end, towards, candidates, scales, out):
    """Compare alpha with beta at each candidate disparity, with 2 x 2 pixels as channels.

    Beyond h or w alpha's last row or column is repeated, beyond beta's edge its nearest pixel.

    Args:
        alpha: brightness (h, w) of alpha.
        beta: brightness of beta.
        end: ends (h, w, 2) of the segments, pixels of beta.
        towards: unit vectors (h, w, 2) from end to start.
        candidates: disparities (n, h, w), pixels from the end; the first is the pixel's own match.
        scales: differences of disparity and of brightness that are mapped to 1/2.
        out: numbers (h / 2, w / 2, 4 + 8 n), or more rows and columns, to write; of each plane four for the 2
            x 2 pixels: alpha minus 1/2; for each candidate but the first the difference of its disparity from
            the first one's, by `soft`; for each the excess of alpha's brightness over beta's, by `soft`; and
            1 where the first is on beta, else 0.
    """
    n, height, width = candidates.shape
    rows, columns = beta.shape
    pixels, level = np.float32(1) / np.float32(scales[0]), np.float32(1) / np.float32(scales[1])
    right, bottom, zero, half = np.float32(columns - 1), np.float32(rows - 1), np.float32(0), np.float32(0.5)
    for row in range(2 * out.shape[0]):
        r = min(row, height - 1)
        for first in range(0, 2 * out.shape[1], COLUMNS):
            for k in range(n):
                for column in range(first, min(first + COLUMNS, 2 * out.shape[1])):
                    c = min(column, width - 1)
                    target = out[row // 2, column // 2]
                    channel = 2 * (row % 2) + column % 2
                    far = candidates[k, r, c]
                    x = end[r, c, 0] + far * towards[r, c, 0]
                    y = end[r, c, 1] + far * towards[r, c, 1]
                    if k:
                        target[4 * k + channel] = soft((far - candidates[0, r, c]) * pixels)
                    else:
                        on = -half <= x and x <= right + half and -half <= y and y <= bottom + half
                        target[channel] = alpha[r, c] - half
                        target[8 * n + channel] = np.float32(on)
                    x, y = min(max(x, zero), right), min(max(y, zero), bottom)
                    left, top = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
                    u, v = x - np.float32(left), y - np.float32(top)
                    beside, below = min(left + 1, columns - 1), min(top + 1, rows - 1)
                    above = beta[top, left] + u * (beta[top, beside] - beta[top, left])
                    under = beta[below, left] + u * (beta[below, beside] - beta[below, left])
                    target[4 * (n + k) + channel] = soft((alpha[r, c] - above - v * (under - above)) * level)


TINY = np.finfo(np.float32).tiny


@compiled(nogil=True, cache=True)
def weighted_terms(values, weight, centre, reach, out):
    """Compute the terms of the weighted least squares of planes z = value + right x + down y.

    Args:
        values: values z + centre (h, w).
        weight: their weights.
        centre: number that is subtracted from the values.
        reach: pixels that are the unit of x and y, which are counted from the middle.
        out: terms (3, h, w, 4) to write: weights; weights times x, y, x x, x y, y y, z, x z, y z and
            themselves; and two zeros.
    """
    (height, width), centre, reach = values.shape, np.float32(centre), np.float32(reach)
    one, two, three = out
    for r in range(height):
        y = (np.float32(r) - np.float32(0.5) * np.float32(height - 1)) / reach
        for c in range(width):
            x = (np.float32(c) - np.float32(0.5) * np.float32(width - 1)) / reach
            w, z = weight[r, c], values[r, c] - centre
            wx, wy = w * x, w * y
            one[r, c, 0], one[r, c, 1], one[r, c, 2], one[r, c, 3] = w, wx, wy, wx * x
            two[r, c, 0], two[r, c, 1], two[r, c, 2], two[r, c, 3] = wx * y, wy * y, w * z, wx * z
            three[r, c, 0], three[r, c, 1], three[r, c, 2], three[r, c, 3] = wy * z, w * w, 0, 0


@compiled(nogil=True, cache=True)
def planes_through(one, two, three, centre, reach, level, out):
    """Solve for the planes, from `weighted_terms` that are summed around each pixel.

    Args:
        one: first four terms (h, w, 4).
        two: next four.
        three: last four.
        centre: number that was subtracted from the values.
        reach: pixels that are the unit of x and y.
        level: number, in that unit squared, added to the variances of position, which makes slopes smaller:
            half as large where it is the variance.
        out: planes (4, h, w) to write: value, slope per full-size pixel to the right and downwards, and the
            mean of the weights, weighted by themselves.
    """
    (height, width), centre, reach = one.shape[:2], np.float32(centre), np.float32(reach)
    level = np.float32(level)
    for r in range(height):
        y = (np.float32(r) - np.float32(0.5) * np.float32(height - 1)) / reach
        for c in range(width):
            x = (np.float32(c) - np.float32(0.5) * np.float32(width - 1)) / reach
            share = np.float32(1) / max(one[r, c, 0], TINY)
            mx, my, mz = one[r, c, 1] * share, one[r, c, 2] * share, two[r, c, 2] * share
            xx, yy = one[r, c, 3] * share - mx * mx + level, two[r, c, 1] * share - my * my + level
            xy, xz = two[r, c, 0] * share - mx * my, two[r, c, 3] * share - mx * mz
            yz = three[r, c, 0] * share - my * mz
            within = np.float32(1) / (xx * yy - xy * xy)
            right, down = (xz * yy - yz * xy) * within, (yz * xx - xz * xy) * within
            out[0, r, c] = mz + right * (x - mx) + down * (y - my) + centre
            out[1, r, c], out[2, r, c] = right / (FINE * reach), down / (FINE * reach)
            out[3, r, c] = three[r, c, 1] * share


@compiled(nogil=True, cache=True)
def at_pixels(value, right, down, out):
    """Write planes of every second pixel at all pixels, `out` (h, w)."""
    height, width = out.shape
    for r in range(height):
        for c in range(width):
            y, x = r // FINE, c // FINE
            out[r, c] = value[y, x] + np.float32(c % FINE) * right[y, x] + np.float32(r % FINE) * down[y, x]
