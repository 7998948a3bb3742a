"""The compiled loop of `pat.matching.tangents`: costs of explicit positions."""

from __future__ import annotations

from pat.attention.kernels.emit import compiled, separate_cache

from .cost import NOWHERE, dissimilarity, pixel_of
from .semi_global_numba import NO_LABEL


@compiled(nogil=True, cache=True)
def costs_at(own, other, places, out):
    """Cost of alpha's pixel and beta's at each of its places, pixels of beta counted row by row (-1: none): out (h, w,
    1, lanes), of which those after the last place have no label. `own` and `other` are flat planes of `cost`."""
    height, width, labels = places.shape
    for y in range(height):
        for x in range(width):
            pixel, costs = pixel_of(own, y * width + x), out[y, x, 0]
            costs[labels:] = NO_LABEL
            for label in range(labels):
                at = places[y, x, label]
                cost = dissimilarity(pixel, pixel_of(other, max(at, 0)))
                costs[label] = cost if at >= 0 else NOWHERE


separate_cache(costs_at)
