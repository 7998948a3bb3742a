"""Compiled loops of explicit fields, each in one thread, without Python's lock. Imported when needed."""

from __future__ import annotations

import numpy as np

from ..runtime.compiled import compiled

BUCKETS = 128
"""Number of buckets into which distances are sorted first."""
MORE = 1.15
"""Factor of the number of wanted pixels that should be within the first distance tried."""


@compiled(nogil=True, cache=True, error_model="numpy")
def nearest_pixels(first, last, line, centre, usable, window, tie, hw, xy, mask):
    """Write the pixels of a window that are nearest to a line, for some of alpha's pixels.

    Args:
        first: first pixel of alpha.
        last: pixel after the last.
        line: lines (n, 3) in beta, scaled to distances in pixels, in the type of computation.
        centre: whole pixels (n, 2) at the windows' centres, of the same type.
        usable: mask (n); others get no pixels.
        window: pixels from the centre to the edge of the window.
        tie: distance by which a pixel counts as farther than the one before it in the image.
        hw: height and width of beta.
        xy: pixels (n, count, 2) to write, the nearest first; 0 where masked.
        mask: mask (n, count) to write, True where there is a pixel.
    """
    count, most = mask.shape[1], (2 * window + 1) ** 2
    keys, pixels = np.empty(most, line.dtype), np.empty((most, 2), np.int32)
    order, begins = np.empty(most, np.int32), np.empty(BUCKETS + 1, np.int32)
    sorted_keys, buckets = np.empty(most, line.dtype), np.empty(most, np.int32)
    for p in range(first, last):
        count_near = 0
        if usable[p]:
            count_near, limit = _within(line[p], centre[p], window, tie, hw, count, keys, pixels)
            _sort(keys, count_near, limit, order, begins, buckets, sorted_keys)
        for i in range(count):
            mask[p, i] = i < count_near
            xy[p, i, 0] = pixels[order[i], 0] if i < count_near else 0
            xy[p, i, 1] = pixels[order[i], 1] if i < count_near else 0


@compiled(inline="always")
def _within(line, centre, window, tie, hw, count, keys, pixels):
    """Collect at least `count` pixels up to some distance, or all; return their number and the distance."""
    x, y, a, b = int(centre[0]), int(centre[1]), line[0], line[1]
    at_centre = centre[0] * a + centre[1] * b + line[2]
    spans = window * (abs(a) + abs(b))
    nearest, farthest = max(abs(at_centre) - spans, 0), abs(at_centre) + spans + tie * hw[0] * hw[1]
    columns = 2 * window + 1
    step = nearest + max(MORE * count / columns, 0.5) * max(abs(a), abs(b)) / 2 + tie * hw[0] * hw[1]
    collected = _collect(line, at_centre, x, y, window, tie, hw, step, keys, pixels)
    while collected < count and step < farthest:
        step = nearest + 2 * (step - nearest)
        collected = _collect(line, at_centre, x, y, window, tie, hw, step, keys, pixels)
    return collected, step


@compiled(inline="always")
def _collect(line, at_centre, x, y, window, tie, hw, limit, keys, pixels):
    """Collect the window's pixels with keys up to a limit: by columns, or by rows if the line is steep."""
    a, b = line[0], line[1]
    steep = abs(a) > abs(b)
    slope, other = (b, a) if steep else (a, b)
    along, across = (y, x) if steep else (x, y)
    length, width = (hw[0], hw[1]) if steep else (hw[1], hw[0])
    collected, reach, inverse = 0, limit / abs(other) + 0.01, 1 / other
    for u in range(max(along - window, 0), min(along + window, length - 1) + 1):
        middle = across - (at_centre + slope * (u - along)) * inverse
        begin = max(across - window, 0, int(np.ceil(middle - reach)))
        end = min(across + window, width - 1, int(np.floor(middle + reach)))
        for v in range(begin, end + 1):
            column, row = (v, u) if steep else (u, v)
            distance = np.float32(column - x) * a + np.float32(row - y) * b + at_centre
            key = abs(distance) + keys.dtype.type(row * hw[1] + column) * tie
            if key <= limit:
                keys[collected], pixels[collected, 0], pixels[collected, 1] = key, column, row
                collected += 1
    return collected


@compiled(inline="always")
def _sort(keys, n, limit, order, begins, buckets, ordered):
    """Sort keys in 0 .. limit into buckets, then by insertion: `order` and, in that order, `ordered`."""
    scale = keys.dtype.type(BUCKETS / limit)
    begins[:] = 0
    for i in range(n):
        buckets[i] = min(np.int32(keys[i] * scale), BUCKETS - 1)
    for i in range(n):
        begins[buckets[i] + 1] += 1
    for k in range(BUCKETS):
        begins[k + 1] += begins[k]
    for i in range(n):
        slot = begins[buckets[i]]
        order[slot], ordered[slot] = i, keys[i]
        begins[buckets[i]] = slot + 1
    for i in range(1, n):
        one, key, slot = order[i], ordered[i], i
        while slot > 0 and ordered[slot - 1] > key:
            order[slot], ordered[slot] = order[slot - 1], ordered[slot - 1]
            slot -= 1
        order[slot], ordered[slot] = one, key
