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
    """Write, for rows `top` to `bottom`, the number of the pixel with the weighted median of the values
    around.

    `out` (h, w) has the pixel's own number outside `where`. The window is a square of this `radius`; NaN does
    not count. `weights`, integers, are by 255ths of the difference in alpha. Values that are nearer to each
    other than a 4096th of the range around count as one.
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
