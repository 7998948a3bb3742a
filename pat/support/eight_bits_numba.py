"""The compiled loop of `eight_bits`, in one thread and without Python's lock."""

from __future__ import annotations

import numpy as np

from arraygeom.compiled import compiled, separate_cache


@compiled(nogil=True, cache=True)
def rounded(image, top, left, scale, zero, out):
    """An image (h, w, c) in steps of 1 / `scale`, into `out` (rows, columns, c): its rows from `top` on, from
    `left` columns before it. `zero` stands for 0, which is all there is around it."""
    height, width, channels = image.shape
    per, least, most = np.float32(scale), np.float32(0), np.float32(255)
    offset, beyond = np.float32(zero) + np.float32(0.5), np.uint8(zero)
    for i in range(out.shape[0]):
        y = top + i
        for j in range(out.shape[1]):
            x, target = j - left, out[i, j]
            if 0 <= y < height and 0 <= x < width:
                source = image[y, x]
                for c in range(channels):
                    target[c] = np.uint8(min(max(source[c] * per + offset, least), most))
            else:
                target[:] = beyond


separate_cache(rounded)
