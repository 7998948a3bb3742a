"""The compiled loop of `choice`, in one thread and without Python's lock."""

from __future__ import annotations

import numpy as np

from arraygeom.runtime.compiled import compiled

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
