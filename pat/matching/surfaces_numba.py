"""Compiled loops of `surfaces`, each in one thread and without Python's lock."""

from __future__ import annotations

import numpy as np

from arraygeom.runtime.compiled import compiled

from .positions import FINE

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
