"""The compiled loops of `pat.matching.semi_global`, each on one image, in one thread and without Python's lock."""

from __future__ import annotations

import numpy as np

from pat.attention.kernels import compiled, separate_cache

NOWHERE = np.uint8(80)
"""Cost of a label that is not on beta: more than any other can have."""
UNSEEN = np.uint8(24)
"""Cost of a label beyond beta's edge, where the point may well be: about that of a mismatch."""
MOST = np.float32(1e9)
LEVELS = np.float32(30.0)
"""Cost of a difference of 1 in (normalised) brightness, which counts up to `TRUNCATED`."""
TRUNCATED = np.float32(20.0)
SMALL, LARGE = np.float32(12.0), np.float32(100.0)
"""Penalties of neighbours whose labels differ by one, and by more (the latter where alpha shows no edge)."""
EDGE = np.float32(4 / 255)
"""Difference of alpha's neighbours that halves the larger penalty."""
FARTHEST = np.float32(8)
"""A difference of labels in the left-right check counts as at most this."""
MOST_BEYOND = np.float32(0.3)
"""Brightness this far from the mean of what is around counts as no farther in a regression."""
ONE = np.float32(1.0)
HALF = np.float32(0.5)
PARTS = 16
"""Sums of costs are whole numbers of a 16th, of 16 bits: twice as many as floats go through memory in the same time."""
STEP = np.int16(SMALL * PARTS)
WALL = np.int16(30000)
"""More than a sum of costs along a path can be."""


@compiled(nogil=True, cache=True)
def census(image, out):
    """One bit for each of the 48 pixels around: whether it is darker (Zabih and Woodfill 1994)."""
    height, width = image.shape
    # A row around at a time, continued by three pixels to either side: then the loop along it is of vectors.
    row = np.empty(width + 6, image.dtype)
    for y in range(height):
        centre, bits = image[y], out[y]
        bits[:] = 0
        for dy in range(-3, 4):
            above = image[min(max(y + dy, 0), height - 1)]
            for x in range(3):
                row[x], row[width + 3 + x] = above[0], above[width - 1]
            for x in range(width):
                row[x + 3] = above[x]
            for dx in range(7):
                if dx != 3 or dy != 0:
                    for x in range(width):
                        bits[x] = (bits[x] << np.uint64(1)) | np.uint64(row[x + dx] < centre[x])


@compiled(inline="always")
def _count(bits):
    """Ones among 64 bits."""
    bits = bits - ((bits >> np.uint64(1)) & np.uint64(0x5555555555555555))
    bits = (bits & np.uint64(0x3333333333333333)) + ((bits >> np.uint64(2)) & np.uint64(0x3333333333333333))
    bits = (bits + (bits >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (bits * np.uint64(0x0101010101010101)) >> np.uint64(56)


@compiled(inline="always")
def _pixel(end, along, label):
    """Column and row of beta's pixel at a label: so many pixels from `end`."""
    disparity = np.float32(label)
    return int(np.floor(end[0] + disparity * along[0] + HALF)), int(np.floor(end[1] + disparity * along[1] + HALF))


@compiled(inline="always")
def dissimilarity(own, own_bits, other, other_bits):
    """Of two pixels, by brightness and census."""
    return np.uint8(_count(own_bits ^ other_bits)) + np.uint8(min(abs(own - other) * LEVELS, TRUNCATED))


@compiled(inline="always")
def _places(end, along, count, rows, columns, out):
    """Where the first labels are in beta, pixels counted row by row; -1 for those that are not on it."""
    for label in range(count):
        disparity = np.float32(label)
        column = np.int32(np.floor(end[0] + disparity * along[0] + HALF))
        row = np.int32(np.floor(end[1] + disparity * along[1] + HALF))
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        out[label] = np.int32(row * columns + column) if inside else np.int32(-1)


@compiled(inline="always")
def _count_within(length, labels):
    """How many labels are on a segment."""
    return min(max(int(np.floor(length + HALF)) + 1, 0), labels)


@compiled(nogil=True, cache=True)
def costs(own, own_bits, other, other_bits, end, along, length, cut, out):
    """Dissimilarity of alpha's pixel (own) and beta's (other) at each label: out (h, w, labels).

    The label l lies l pixels from `end` along the unit vectors `along`; those beyond `length` are nowhere, or, where
    it is beta's edge that cuts the segment, not seen.
    """
    height, width, labels = out.shape
    rows, columns = other.shape
    values, bits = other.ravel(), other_bits.ravel()
    places = np.empty(labels, np.int32)
    for y in range(height):
        for x in range(width):
            count, found = _count_within(length[y, x], labels), out[y, x]
            _places(end[y, x], along[y, x], count, rows, columns, places)
            for label in range(count):
                at = max(places[label], 0)
                cost = dissimilarity(own[y, x], own_bits[y, x], values[at], bits[at])
                found[label] = cost if places[label] >= 0 else NOWHERE
            found[count:] = UNSEEN if cut[y, x] else NOWHERE


@compiled(inline="always")
def _least(costs, first, last):
    """The least of costs from `first` to before `last`."""
    least = WALL
    for i in range(first, last):
        least = min(least, costs[i])
    return least


@compiled(inline="always")
def _advance(before, least, jump, cost, now):
    """One step of a path: its costs `now`, from index 1, a wall at both ends; the least. All in parts."""
    leap, fewest = np.int16(least + jump), WALL
    for i in range(len(cost)):
        step = np.int16(min(before[i], before[i + 2]) + STEP)
        stay = min(before[i + 1], leap)
        path = np.int16(np.int16(cost[i] * PARTS) + np.int16(min(step, stay) - least))
        now[i + 1], fewest = path, min(fewest, path)
    return fewest


@compiled(inline="always")
def jump_between(a, b, small, large):
    """The penalty of labels that differ by more than one, between pixels of alpha's brightness a and b."""
    return max(small + ONE, large / (ONE + abs(a - b) / EDGE))


@compiled(inline="always")
def _jump_in_parts(a, b):
    return np.int16(jump_between(a, b, SMALL, LARGE) * PARTS + HALF)


@compiled(nogil=True, cache=True)
def aggregate(cost, guide, total):
    """The sum over eight paths of semi-global matching (Hirschmüller 2008), in parts: total (h, w, labels), int16."""
    for way in range(2):
        _sweep(cost, guide, total, way)


@compiled
def _sweep(cost, guide, total, way):
    """Four paths at once, so that costs and sums go through memory twice in all: from the pixel before in the row, and
    from three of the row before. With `way` 1 rows and columns are taken from the last.

    Paths are kept where the next row reads them, by the column that will.
    """
    height, width, labels = cost.shape
    above, ahead, behind = np.zeros((3, width + 1, labels + 2), np.int16)
    side, next_side, next_above, pending, next_behind = np.zeros((5, labels + 2), np.int16)
    for kept in (above, ahead, behind):
        kept[:, 0], kept[:, -1] = WALL, WALL
    for kept in (side, next_side, next_above, pending, next_behind):
        kept[0], kept[-1] = WALL, WALL
    fewest = np.zeros((3, width + 1), np.int16)
    step = 1 - 2 * way
    for row in range(height):
        y = row if way == 0 else height - 1 - row
        side[1:-1] = 0
        pending[1:-1] = 0
        of_side, of_pending = np.int16(0), np.int16(0)
        for i in range(width):
            x = i if way == 0 else width - 1 - i
            here, values, sums = guide[y, x], cost[y, x], total[y, x]
            jump = _jump_in_parts(here, guide[y, x - step]) if i > 0 else STEP
            of_side = _advance(side, of_side, jump, values, next_side)
            jump = _jump_in_parts(here, guide[y - step, x]) if row > 0 else STEP
            of_above = _advance(above[i], fewest[0, i], jump, values, next_above)
            jump = _jump_in_parts(here, guide[y - step, x + step]) if row > 0 and i < width - 1 else STEP
            fewest[1, i] = _advance(ahead[i + 1], fewest[1, i + 1], jump, values, ahead[i])
            jump = _jump_in_parts(here, guide[y - step, x - step]) if row > 0 and i > 0 else STEP
            of_behind = _advance(behind[i], fewest[2, i], jump, values, next_behind)
            _add(sums, next_side, next_above, ahead[i], next_behind, way == 0)
            _copy(next_above, above[i])
            _copy(pending, behind[i])
            fewest[0, i], fewest[2, i] = of_above, of_pending
            pending, next_behind, of_pending = next_behind, pending, of_behind
            side, next_side = next_side, side


@compiled(inline="always")
def _copy(path, out):
    for k in range(1, len(path) - 1):
        out[k] = path[k]


@compiled(inline="always")
def _add(total, a, b, c, d, first):
    """Sums of four paths, written or added."""
    for k in range(len(total)):
        four = np.int16(np.int16(a[k + 1] + b[k + 1]) + np.int16(c[k + 1] + d[k + 1]))
        total[k] = four if first else np.int16(total[k] + four)


@compiled(nogil=True, cache=True)
def winners(total, end, along, length, cut, rows, columns, top, left, claims, disparity, facts, labels, positions):
    """Of each pixel of a part that begins at `top`, `left`: the best label, to a fraction (disparity) and whole
    (labels); where it is in beta, pixels counted row by row (positions; rows * columns: not on it); its margin to the
    second best, and its cost (the last of facts (h, w, 3)). `total` is in parts.

    `claims`, of each pixel of beta and one more, keeps the least cost with which a pixel of alpha matches it, and that
    pixel's label: 16 bits of either.
    """
    height, width, _ = facts.shape
    nowhere, most = rows * columns, total.shape[2]
    at = np.empty(most, np.int32)
    for y in range(height):
        for x in range(width):
            here = y + top, x + left
            sums, count = total[here], _count_within(length[here], most)
            _places(end[here], along[here], count, rows, columns, at)
            for label in range(count):
                place = at[label] if at[label] >= 0 else nowhere
                claims[place] = min(claims[place], np.int32(sums[label]) << 16 | np.int32(label))
            last = most - 1 if cut[here] else min(most - 1, int(length[here] + HALF))
            best, second = _two_best(sums, last)
            lowest = sums[best]
            disparity[y, x] = np.float32(best) + _between(sums, best, last)
            labels[y, x], positions[y, x] = best, at[best] if best < count and at[best] >= 0 else nowhere
            facts[y, x, 1] = min(np.float32(second - lowest) / (8 * PARTS * LARGE), ONE)
            facts[y, x, 2] = np.float32(lowest) / (8 * PARTS * LARGE)


@compiled(nogil=True, cache=True)
def regression(brightness, total, first, second, colour, product, floor, along, mean_colour):
    """A band of `colour_transfer.diffused_from`, from smoothed sums of weights (total), and of weights times
    brightness, its square, the band (colour), and brightness times the band (product)."""
    height, width = brightness.shape
    for y in range(height):
        for x in range(width):
            share = ONE / total[y, x]
            mean, middle = first[y, x] * share, colour[y, x] * share
            variance = max(second[y, x] * share - mean * mean, np.float32(0))
            slope = (product[y, x] * share - middle * mean) / (variance + floor)
            beyond = min(max(brightness[y, x] - mean, -MOST_BEYOND), MOST_BEYOND)
            along[y, x], mean_colour[y, x] = middle + slope * beyond, middle


@compiled(inline="always")
def _two_best(total, last):
    """The best of the labels to `last`, and what the best does that is not beside it."""
    best, least = 0, _least(total, 0, last + 1)
    while total[best] > least:
        best += 1
    return best, min(_least(total, 0, best - 1), _least(total, best + 2, last + 1))


@compiled(inline="always")
def _between(total, best, last):
    """How far the best is from the label, by the two lines of equal slope through it and its neighbours."""
    if not 0 < best < last:
        return np.float32(0)
    before, after = np.float32(total[best - 1]), np.float32(total[best + 1])
    deepest = max(before, after) - np.float32(total[best])
    return HALF * (before - after) / deepest if deepest > 0 else np.float32(0)


for _entry in (census, costs, aggregate, winners, regression):
    separate_cache(_entry)
