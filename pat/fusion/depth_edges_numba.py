"""The compiled loop of `depth_edges`, in one thread and without Python's lock."""

from __future__ import annotations

import numpy as np

from arraygeom.runtime.compiled import compiled


@compiled(inline="always")
def below(some, share, n, most):
    """Return the sum of the shares of the first n values up to `most`."""
    total = np.int32(0)
    for i in range(n):
        total += share[i] * np.int32(some[i] <= most)
    return total


@compiled(nogil=True, cache=True)
def weighted_medians(values, alpha, where, weights, radius, top, bottom, out):
    """Find the pixel whose value is the weighted median of the values in a window around each pixel.

    Values that are nearer to each other than a 4096th of the window's range count as equal; NaN does not
    count.

    Args:
        values: values (h, w), float32.
        alpha: brightness (h, w), 0 to 1.
        where: mask (h, w) of the pixels to compute.
        weights: weight, an integer, for each difference in alpha in steps of 1/255; the last one holds
            beyond.
        radius: pixels from the centre of the square window to its edge.
        top: first row.
        bottom: row after the last.
        out: number of the pixel found, y w + x, to write (h, w); a pixel's own outside `where`.
    """
    height, width = values.shape
    some = np.empty((2 * radius + 1) ** 2, np.float32)
    share, place = np.empty(len(some), np.int32), np.empty(len(some), np.int32)
    last, scale = len(weights) - 1, np.float32(255)
    for r in range(top, bottom):
        for c in range(width):
            out[r, c] = r * width + c
            if not where[r, c]:
                continue
            centre, n, total = alpha[r, c], 0, np.int32(0)
            low, high = np.float32(np.inf), np.float32(-np.inf)
            for y in range(max(r - radius, 0), min(r + radius + 1, height)):
                for x in range(max(c - radius, 0), min(c + radius + 1, width)):
                    value = values[y, x]
                    if value == value:
                        some[n], place[n] = value, y * width + x
                        share[n] = weights[min(int(abs(alpha[y, x] - centre) * scale), last)]
                        total += share[n]
                        low, high = min(low, value), max(high, value)
                        n += 1
            least = low
            for _ in range(12):
                middle = np.float32(0.5) * (low + high)
                if 2 * below(some, share, n, middle) < total:
                    low = middle
                else:
                    high = middle
            best = np.float32(np.inf)
            for i in range(n):
                if (some[i] > low or low == least) and some[i] < best:
                    best, out[r, c] = some[i], place[i]
