"""Compiled loop of `blocks.stacked`, single-threaded and without Python's lock."""

from __future__ import annotations

from arraygeom.runtime.compiled import compiled

COLUMNS = 32
"""Columns interleaved at a time: they stay in a core's first cache."""


@compiled(nogil=True, cache=True)
def unshuffle(upper, lower, out):
    """Rearrange 2x2 pixels into four channels, as torch's `pixel_unshuffle` by 2 does.

    Args:
        upper: the image's even rows (c, h, 2 w), float32.
        lower: its odd rows, of the same shape.
        out: array (h, w, 4 c) to write to.
    """
    channels, (height, width) = len(upper), out.shape[:2]
    for y in range(height):
        for left in range(0, width, COLUMNS):
            for c in range(channels):
                above, below, k = upper[c, y], lower[c, y], 4 * c
                for x in range(left, min(left + COLUMNS, width)):
                    out[y, x, k], out[y, x, k + 1] = above[2 * x], above[2 * x + 1]
                    out[y, x, k + 2], out[y, x, k + 3] = below[2 * x], below[2 * x + 1]
