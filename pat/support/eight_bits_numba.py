"""The compiled loop of `eight_bits`, in one thread and without Python's lock."""

from __future__ import annotations

import numpy as np

from arraygeom.runtime.compiled import compiled


@compiled(nogil=True, cache=True)
def rounded(image, top, left, scale, zero, out):
    """An image (h, w, c) in steps of 1 / `scale`, into `out` (rows, columns, c): its rows from `top` on, from
    `left` columns before it. `zero` stands for 0, which is all there is around it."""
    height, width = image.shape[:2]
    per, least, most = np.float32(scale), np.float32(0), np.float32(255)
    offset, beyond = np.float32(zero) + np.float32(0.5), np.uint8(zero)
    for i in range(out.shape[0]):
        y = top + i
        if 0 <= y < height:
            source, target = image[y].reshape(-1), out[i, left : left + width].reshape(-1)
            for k in range(len(source)):
                value = source[k] * per + offset
                value = value if value > least else least  # not min and max, which look after NaN one by one
                target[k] = np.int32(value if value < most else most)
            out[i, :left] = out[i, left + width :] = beyond
        else:
            out[i] = beyond
