"""The compiled loops of `pat.networks.semi_global`, each on one image, in one thread and without Python's lock."""

from __future__ import annotations

import numpy as np

from pat.attention.kernels import compiled, separate_cache

NOWHERE = np.uint8(80)
"""Cost of a label that is not on beta: more than any other can have."""
UNSEEN = np.uint8(24)
"""Cost of a label beyond beta's edge, where the point may well be: about that of a mismatch."""
MOST = np.float32(1e9)
MOST_BITS = MOST.view(np.int32)
LEVELS = np.float32(30.0)
"""Cost of a difference of 1 in (normalised) brightness, which counts up to `TRUNCATED`."""
TRUNCATED = np.float32(20.0)
SMALL, LARGE = np.float32(12.0), np.float32(100.0)
"""Penalties of neighbours whose labels differ by one, and by more (the latter where alpha shows no edge)."""
EDGE = np.float32(8 / 255)
"""Difference of alpha's neighbours that halves the larger penalty."""
FARTHEST = np.float32(8)
"""A difference of labels in the left-right check counts as at most this."""
MOST_BEYOND = np.float32(0.3)
"""Brightness this far from the mean of what is around counts as no farther in a regression."""
ONE = np.float32(1.0)
HALF = np.float32(0.5)


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
            row[:3], row[3:-3], row[-3:] = above[0], above, above[-1]
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


@compiled(nogil=True, cache=True)
def costs(own, own_bits, other, other_bits, end, along, length, cut, out):
    """Dissimilarity of alpha's pixel (own) and beta's (other) at each label: out (h, w, labels).

    The label l lies l pixels from `end` along the unit vectors `along`; those beyond `length` are nowhere, or, where
    it is beta's edge that cuts the segment, not seen.
    """
    height, width, labels = out.shape
    rows, columns = other.shape
    for y in range(height):
        for x in range(width):
            disparity = length[y, x] + HALF
            beyond = UNSEEN if cut[y, x] else NOWHERE
            for label in range(labels):
                column, row = _pixel(end[y, x], along[y, x], label)
                if label > disparity:
                    out[y, x, label] = beyond
                elif column < 0 or row < 0 or column >= columns or row >= rows:
                    out[y, x, label] = NOWHERE
                else:
                    place = row, column
                    out[y, x, label] = dissimilarity(own[y, x], own_bits[y, x], other[place], other_bits[place])


@compiled(inline="always")
def _least(bits, first, last):
    """The least of costs from `first` to before `last`, none of which is negative: by their bits, as loops over floats
    that keep a minimum do not become vector instructions."""
    least = MOST_BITS
    for i in range(first, last):
        least = min(least, bits[i])
    return least


@compiled(inline="always")
def _advance(before, least, cost, total, now, bits, jump):
    """One step of a path: its costs `now` (from index 1; a wall at both ends; `bits` are the same), added to `total`;
    the least. A loop for each array that is written: else they do not become vector instructions."""
    labels, leap = len(cost), least + jump
    for i in range(labels):
        now[i + 1] = np.float32(cost[i]) + min(min(before[i], before[i + 2]) + SMALL, min(before[i + 1], leap)) - least
    for i in range(labels):
        total[i] += now[i + 1]
    return np.int32(_least(bits, 1, labels + 1)).view(np.float32)


@compiled(inline="always")
def _jump(a, b):
    return max(SMALL + ONE, LARGE / (ONE + abs(a - b) / EDGE))


@compiled(nogil=True, cache=True, fastmath=True)
def aggregate(cost, guide, total):
    """The sum over eight paths of semi-global matching (Hirschmüller 2008), added to total (h, w, labels)."""
    for dx in range(-1, 2):
        for way in range(2):
            _sweep(cost, guide, total, dx, way)
    for way in range(2):
        _sweep_rows(cost, guide, total, way)


@compiled(inline="always")
def _sweep_rows(cost, guide, total, way):
    """Paths along rows."""
    height, width, labels = cost.shape
    before, now = np.full((2, labels + 2), MOST, np.float32)
    before_bits, bits = before.view(np.int32), now.view(np.int32)
    first, step = (0, 1) if way == 0 else (width - 1, -1)
    for y in range(height):
        before[1:-1] = 0
        least = np.float32(0)
        for i in range(width):
            x = first + i * step
            jump = _jump(guide[y, x], guide[y, x - step]) if i > 0 else LARGE
            least = _advance(before, least, cost[y, x], total[y, x], now, bits, jump)
            before, before_bits, now, bits = now, bits, before, before_bits


@compiled(inline="always")
def _sweep(cost, guide, total, dx, way):
    """Paths from row to row, that move by `dx` columns on the way."""
    height, width, labels = cost.shape
    before, now = np.full((2, width, labels + 2), MOST, np.float32)
    before_bits, bits = before.view(np.int32), now.view(np.int32)
    fewest, fewer = np.zeros((2, width), np.float32)
    first, step = (0, 1) if way == 0 else (height - 1, -1)
    for i in range(height):
        y = first + i * step
        for x in range(width):
            origin = x - dx
            if i == 0 or origin < 0 or origin >= width:
                now[x, 1:-1] = cost[y, x]
                total[y, x] += cost[y, x]
                fewer[x] = cost[y, x].min()
            else:
                jump = _jump(guide[y, x], guide[y - step, origin])
                there, fell = before[origin], fewest[origin]
                fewer[x] = _advance(there, fell, cost[y, x], total[y, x], now[x], bits[x], jump)
        before, before_bits, now, bits = now, bits, before, before_bits
        fewest, fewer = fewer, fewest


@compiled(nogil=True, cache=True)
def winners(total, end, along, length, cut, rows, columns, disparity, facts):
    """Each pixel's best label, to a fraction (disparity); and facts (h, w, 3): its distance from the best label of all
    alpha pixels that match the same pixel of beta, its margin to the second best, and its cost."""
    claims = _claims(total, end, along, length, rows, columns)
    height, width, labels = total.shape
    for y in range(height):
        for x in range(width):
            last = labels - 1 if cut[y, x] else min(labels - 1, int(length[y, x] + HALF))
            best, second = _two_best(total[y, x], last)
            lowest = total[y, x, best]
            disparity[y, x] = np.float32(best) + _between(total[y, x], best, last)
            column, row = _pixel(end[y, x], along[y, x], best)
            facts[y, x, 0] = ONE
            if best <= length[y, x] + HALF and 0 <= row < rows and 0 <= column < columns:
                facts[y, x, 0] = min(np.float32(abs(claims[row, column] - best)) / FARTHEST, ONE)
            facts[y, x, 1] = min((second - lowest) / (8 * LARGE), ONE)
            facts[y, x, 2] = lowest / (8 * LARGE)


@compiled(nogil=True, cache=True)
def regression(brightness, totals, products, band, floor, out):
    """A band of `pat.networks.semi_global._diffused`, from smoothed sums of weights, and of weights times brightness,
    its square and each band (totals), and brightness times each band (products)."""
    total, first, second, colour, product = totals[0], totals[1], totals[2], totals[3 + band], products[band]
    height, width = brightness.shape
    for y in range(height):
        for x in range(width):
            share = ONE / total[y, x]
            mean, middle = first[y, x] * share, colour[y, x] * share
            variance = max(second[y, x] * share - mean * mean, np.float32(0))
            slope = (product[y, x] * share - middle * mean) / (variance + floor)
            beyond = min(max(brightness[y, x] - mean, -MOST_BEYOND), MOST_BEYOND)
            out[0, band, y, x], out[1, band, y, x] = middle + slope * beyond, middle


@compiled(inline="always")
def _claims(total, end, along, length, rows, columns):
    """For each pixel of beta the label of the alpha pixel that matches it at the least cost."""
    height, width, labels = total.shape
    lowest = np.full((rows, columns), MOST, np.float32)
    claims = np.full((rows, columns), -labels, np.int32)
    for y in range(height):
        for x in range(width):
            for label in range(min(labels - 1, int(length[y, x] + HALF)) + 1):
                column, row = _pixel(end[y, x], along[y, x], label)
                if 0 <= row < rows and 0 <= column < columns and total[y, x, label] < lowest[row, column]:
                    lowest[row, column], claims[row, column] = total[y, x, label], label
    return claims


@compiled(inline="always")
def _two_best(total, last):
    """The best of the labels to `last`, and what the best does that is not beside it."""
    bits, best = total.view(np.int32), 0
    least = _least(bits, 0, last + 1)
    while bits[best] > least:
        best += 1
    second = min(_least(bits, 0, best - 1), _least(bits, best + 2, last + 1))
    return best, np.int32(second).view(np.float32)


@compiled(inline="always")
def _between(total, best, last):
    """How far the best is from the label, by the two lines of equal slope through it and its neighbours."""
    if not 0 < best < last:
        return np.float32(0)
    before, after = total[best - 1], total[best + 1]
    deepest = max(before, after) - total[best]
    return HALF * (before - after) / deepest if deepest > 0 else np.float32(0)


for _entry in (census, costs, aggregate, winners, regression):
    separate_cache(_entry)
