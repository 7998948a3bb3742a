"""Planes through what is known around each pixel, as far as a guide connects it.

Moments are gathered by the domain transform (Gastal and Oliveira 2011): what lies beyond an edge of the guide
is far away. Planes are found for every second pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arraygeom.pixels import HW

from ..support.settings import tuned
from .positions import FINE

Plane = NDArray[np.float32]
"""One number a pixel (h, w)."""


@dataclass(frozen=True)
class SurfaceSettings:
    """Of planes."""

    level: float = tuned(
        0.005,
        "Middlebury, tune half: variance of position, in squares of the reach, below which planes are level",
    )


SETTINGS = SurfaceSettings()


class Planes(NamedTuple):
    """Of every second pixel: value, slopes a pixel to the right and down, and the mean weight around."""

    value: Plane
    right: Plane
    down: Plane
    around: Plane

    @classmethod
    def through(cls, values: Plane, weight: Plane, guide: NDArray[np.float32], reach: float) -> Planes:
        """Planes through weighted values (h, w) of every second pixel, by least squares.

        Values count to `reach` pixels around; a change of 1 in the guide (h, w, c) is as far. No weight is
        around what none reaches.
        """
        reach /= FINE
        y, x = np.mgrid[: weight.shape[0], : weight.shape[1]].astype(np.float32)
        x, y = ((t - t.mean()) / reach for t in (x, y))
        centre = np.median(values[weight > 0]) if weight.any() else 0.0
        z = values - centre
        terms = (1, x, y, x * x, x * y, y * y, z, x * z, y * z, weight)
        sums = _spread([term * weight for term in terms], guide, reach)
        total = np.maximum(sums[0], np.finfo(np.float32).tiny)
        mx, my, mxx, mxy, myy, mz, mxz, myz, around = sums[1:] / total
        level = SETTINGS.level
        xx, yy, xy = mxx - mx * mx + level, myy - my * my + level, mxy - mx * my
        xz, yz = mxz - mx * mz, myz - my * mz
        determinant = xx * yy - xy * xy
        right, down = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
        value = mz + right * (x - mx) + down * (y - my) + centre
        return cls(value, right / (FINE * reach), down / (FINE * reach), around)

    def at_pixels(self, hw: HW) -> Plane:
        """The values at all pixels."""
        y, x = np.ogrid[: hw[0], : hw[1]]
        value, right, down = (repeated(part, hw) for part in self[:3])
        return np.asarray(value + (x % FINE) * right + (y % FINE) * down, np.float32)


def repeated(plane: Plane, hw: HW) -> Plane:
    """What is known of every second pixel for those to its right and below it, too."""
    return plane.repeat(FINE, 0).repeat(FINE, 1)[: hw[0], : hw[1]]


def _spread(planes: Sequence[Plane], guide: NDArray[np.float32], reach: float) -> Plane:
    """Weighted sums around each pixel, those beyond an edge of the guide weighing less; four at a time."""
    over = cv2.ximgproc.createDTFilter(guide, reach, 1.0, cv2.ximgproc.DTF_RF)
    found = [over.filter(cv2.merge(planes[first : first + 4])) for first in range(0, len(planes), 4)]
    return np.asarray(np.concatenate(found, -1).transpose(2, 0, 1), np.float32)
