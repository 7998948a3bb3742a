"""The compiled loop of `choice`, in one thread and without Python's lock."""

from __future__ import annotations

import numpy as np

from arraygeom.compiled import compiled, separate_cache


@compiled(inline="always")
def soft(x):
    """x for small ones, at most 1."""
    return x / (np.float32(1) + abs(x))


@compiled(nogil=True, cache=True)
def compared(own, other, end, towards, candidates, scales, apart, unlike):
    """Of each pixel's candidates (n, h, w), disparities the first of which is its own: into `apart` (n, h, w)
    by how much they differ from that, and into `unlike` by how much alpha `own` (h, w) is brighter than beta
    `other` there; `scales` are what counts as a half of either, 1 at most.

    `apart[0]` is whether the first is on beta.
    """
    n, height, width = candidates.shape
    rows, columns = other.shape
    pixels, level = np.float32(1) / scales[0], np.float32(1) / scales[1]
    right, bottom, zero, one = np.float32(columns - 1), np.float32(rows - 1), np.float32(0), np.float32(1)
    for r in range(height):
        for k in range(n):
            for c in range(width):
                far = candidates[k, r, c]
                x = end[r, c, 0] + far * towards[r, c, 0]
                y = end[r, c, 1] + far * towards[r, c, 1]
                if k:
                    apart[k, r, c] = soft((far - candidates[0, r, c]) * pixels)
                else:
                    half = np.float32(0.5)
                    on = -half <= x and x <= right + half and -half <= y and y <= bottom + half
                    apart[0, r, c] = one if on else zero
                x, y = min(max(x, zero), right), min(max(y, zero), bottom)
                left, top = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
                u, v = x - np.float32(left), y - np.float32(top)
                beside, below = min(left + 1, columns - 1), min(top + 1, rows - 1)
                above = other[top, left] + u * (other[top, beside] - other[top, left])
                under = other[below, left] + u * (other[below, beside] - other[below, left])
                unlike[k, r, c] = soft((own[r, c] - above - v * (under - above)) * level)


separate_cache(compared)
