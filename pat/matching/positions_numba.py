"""The compiled loop of `pat.matching.tangents`: costs of explicit positions."""

from __future__ import annotations

from pat.attention.kernels import compiled, separate_cache

from .semi_global_numba import NOWHERE, dissimilarity


@compiled(nogil=True, cache=True)
def costs_at(own, own_bits, other, other_bits, places, out):
    """Dissimilarity of alpha's pixel (own) and beta's (other) at each of its places, pixels of beta counted row by row
    (-1: none): out (h, w, labels)."""
    height, width, labels = out.shape
    values, bits = other.ravel(), other_bits.ravel()
    for y in range(height):
        for x in range(width):
            for label in range(labels):
                at = max(places[y, x, label], 0)
                cost = dissimilarity(own[y, x], own_bits[y, x], values[at], bits[at])
                out[y, x, label] = cost if places[y, x, label] >= 0 else NOWHERE


separate_cache(costs_at)
