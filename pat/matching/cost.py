"""Cost of two pixels: their difference in the order of brightness around them, and in brightness itself.

Another cost is another file with these names: `planes_of` prepares an image (numbers, 64-bit words, a few
channels a pixel), `pixel_of` takes a pixel of that, `dissimilarity` compares two, and `UNSEEN` and `NOWHERE`
are on its scale. One image, one thread, without Python's lock, without torch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from arraygeom.runtime.compiled import compiled

from ..support.settings import physics, size, tuned


@dataclass(frozen=True)
class CensusSettings:
    """Settings of the matching cost, whose unit is one bit of the census transform.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    brightness: float = tuned(30.0, "Middlebury, tune half: what a difference of 1 in brightness costs")
    truncated: float = size(20.0, "What brightness costs at most; half or twice as much does as well")
    unseen: int = physics(24, "About half of the bits: a label beyond beta's edge, where the point may be")
    nowhere: int = physics(80, "More than any other cost: of a label that is not on beta")


SETTINGS = CensusSettings()
BRIGHTNESS, TRUNCATED = np.float32(SETTINGS.brightness), np.float32(SETTINGS.truncated)
UNSEEN, NOWHERE = np.uint8(SETTINGS.unseen), np.uint8(SETTINGS.nowhere)


def planes_of(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.uint64]]:
    """Compute the planes of an image's pixels (h, w) that `dissimilarity` compares: brightness and census."""
    bits = np.empty(image.shape, np.uint64)
    census(image, bits)
    return image, bits


@compiled(inline="always")
def pixel_of(planes, i):
    """Return the compared numbers of a pixel, from planes as of `planes_of`, but flat."""
    return planes[0][i], planes[1][i]


@compiled(inline="always")
def dissimilarity(alpha, beta):
    """Return the cost of a pixel of alpha and one of beta, less than `NOWHERE`."""
    apart = min(abs(alpha[0] - beta[0]) * BRIGHTNESS, TRUNCATED)
    return np.uint8(_count(alpha[1] ^ beta[1])) + np.uint8(apart)


@compiled(inline="always")
def _count(bits):
    """Return the number of ones among 64 bits."""
    bits = bits - ((bits >> np.uint64(1)) & np.uint64(0x5555555555555555))
    bits = (bits & np.uint64(0x3333333333333333)) + ((bits >> np.uint64(2)) & np.uint64(0x3333333333333333))
    bits = (bits + (bits >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (bits * np.uint64(0x0101010101010101)) >> np.uint64(56)


@compiled(nogil=True, cache=True)
def census(image, out):
    """Compute the 7 x 7 census transform (Zabih and Woodfill 1994): a bit for each neighbour that is darker.

    Args:
        image: brightness (h, w); beyond its borders it is extended by the nearest pixel.
        out: 48 bits of each pixel (h, w), uint64, to write.
    """
    height, width = image.shape
    # A row around at a time, continued by three pixels to either side: then the loop along it is of vectors.
    row = np.empty(width + 6, image.dtype)
    for y in range(height):
        centre, bits = image[y], out[y]
        bits[:] = 0
        for dy in range(-3, 4):
            above = image[min(max(y + dy, 0), height - 1)]
            for x in range(3):
                row[x], row[width + 3 + x] = above[0], above[width - 1]
            for x in range(width):
                row[x + 3] = above[x]
            for dx in range(7):
                if dx != 3 or dy != 0:
                    for x in range(width):
                        bits[x] = (bits[x] << np.uint64(1)) | np.uint64(row[x + dx] < centre[x])
