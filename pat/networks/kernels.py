"""The compiled loops of `blocks` and `windows`, each in one thread and without Python's lock."""

from __future__ import annotations

import numpy as np

from arraygeom.compiled import compiled, separate_cache

ONE, LOWEST = np.float32(1), np.float32(-87)
"""Scores so far below the largest weigh nothing."""
ROWS = 16
"""Rows that a thread takes at a time."""
COLUMNS = 32
"""Columns whose channels are interleaved at a time: they stay in a core's first cache."""


@compiled(nogil=True, cache=True)
def unshuffle(upper, lower, out):
    """The 2x2 pixels of images, of their even and odd rows (c, h, 2 w), as channels of `out` (h, w, 4 c), a few columns
    at a time."""
    channels, (height, width) = len(upper), out.shape[:2]
    for y in range(height):
        for left in range(0, width, COLUMNS):
            for c in range(channels):
                above, below, k = upper[c, y], lower[c, y], 4 * c
                for x in range(left, min(left + COLUMNS, width)):
                    out[y, x, k], out[y, x, k + 1] = above[2 * x], above[2 * x + 1]
                    out[y, x, k + 2], out[y, x, k + 3] = below[2 * x], below[2 * x + 1]


@compiled(inline="always")
def _exponential(x):
    """Cephes' expf of a number at most 0; 0 below `LOWEST`."""
    y = max(x, LOWEST)
    n = np.floor(y * np.float32(1.44269504) + np.float32(0.5))
    y = y - n * np.float32(0.693359375) + n * np.float32(2.12194440e-4)
    p = np.float32(1.9875691500e-4) * y + np.float32(1.3981999507e-3)
    p = p * y + np.float32(8.3334519073e-3)
    p = p * y + np.float32(4.1665795894e-2)
    p = p * y + np.float32(1.6666665459e-1)
    p = p * y + np.float32(5.0000001201e-1)
    p = p * y * y + y + ONE
    scale = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    return p * scale if x >= LOWEST else np.float32(0)


@compiled(nogil=True, cache=True, fastmath={"contract"})
def attend_rows(query, key, value, out, size, spacing, top):
    """Some rows of one image (channels, h, w)."""
    channels, height, width = query.shape
    half = size // 2
    scores = np.empty((size * size, width), np.float32)
    largest, total = np.empty((2, width), np.float32)
    for y in range(top, min(top + ROWS, height)):
        scores[:] = -np.inf
        largest[:] = -np.inf
        for t in range(size * size):
            row, step = y + (t // size - half) * spacing, (t % size - half) * spacing
            first, last = max(0, -step), min(width, width - step)
            if row < 0 or row >= height or first >= last:
                continue
            score = scores[t, first:last]
            score[:] = 0
            for c in range(channels):
                own, other = query[c, y, first:last], key[c, row, first + step : last + step]
                for x in range(last - first):
                    score[x] += own[x] * other[x]
            most = largest[first:last]
            for x in range(last - first):
                most[x] = max(most[x], score[x])
        total[:] = 0
        for t in range(size * size):
            for x in range(width):
                weight = _exponential(scores[t, x] - largest[x])
                scores[t, x] = weight
                total[x] += weight
        for c in range(len(value)):
            mean = out[c, y]
            mean[:] = 0
            for t in range(size * size):
                row, step = y + (t // size - half) * spacing, (t % size - half) * spacing
                first, last = max(0, -step), min(width, width - step)
                if row < 0 or row >= height or first >= last:
                    continue
                weight, seen = scores[t, first:last], value[c, row, first + step : last + step]
                of = mean[first:last]
                for x in range(last - first):
                    of[x] += weight[x] * seen[x]
            for x in range(width):
                mean[x] /= total[x]


for _entry in (unshuffle, attend_rows):
    separate_cache(_entry)
