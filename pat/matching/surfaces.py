"""Planes through known values around each pixel, as far as a guide connects it.

Moments are gathered by the domain transform (Gastal and Oliveira 2011): a point beyond an edge of the guide
is far away. Planes are fitted for every second pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from arraygeom.pixels import HW

from ..support.settings import tuned
from . import surfaces_numba as kernels
from .positions import FINE

Plane = NDArray[np.float32]
"""Numbers of the pixels (h, w)."""


@dataclass(frozen=True)
class SurfaceSettings:
    """Settings of the fit of local planes to disparity.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    level: float = tuned(
        0.005, "Middlebury, tune half: variance of position, over reach^2, below which planes are level"
    )


SETTINGS = SurfaceSettings()


class Planes(NamedTuple):
    """Planes fitted around every second pixel in each direction, each attribute (h, w), float32.

    Attributes:
        value: value at the pixel.
        right: slope per full-size pixel to the right.
        down: slope per full-size pixel downwards.
        around: mean weight of the values around.
    """

    value: Plane
    right: Plane
    down: Plane
    around: Plane

    @classmethod
    def through(cls, values: Plane, weight: Plane, guide: NDArray[np.float32], reach: float) -> Planes:
        """Fit a plane around every pixel by weighted least squares, within edges of a guide.

        Args:
            values: values (h, w) of every second pixel.
            weight: their weights, at least 0.
            guide: image (h, w, c), float32; a change of 1 in it counts as far as `reach`.
            reach: full-size pixels to which values count.

        Returns:
            The planes; where no value reaches, `around` is about 0 and the rest means nothing.
        """
        reach /= FINE
        values, weight = (np.ascontiguousarray(plane, np.float32) for plane in (values, weight))
        centre = float(np.average(values, weights=weight + np.finfo(np.float32).tiny))  # for small numbers
        terms = np.empty((3, *values.shape, 4), np.float32)
        kernels.weighted_terms(values, weight, centre, reach, terms)
        over = cv2.ximgproc.createDTFilter(guide, reach, 1.0, cv2.ximgproc.DTF_RF)
        sums = (over.filter(term) for term in terms)
        planes = np.empty((4, *values.shape), np.float32)
        kernels.planes_through(*sums, centre, reach, SETTINGS.level, planes)
        return cls(*planes)

    def at_pixels(self, hw: HW) -> Plane:
        """Return the values at all pixels."""
        out = np.empty(hw, np.float32)
        kernels.at_pixels(*self[:3], out)
        return out


def repeated(plane: Plane, hw: HW) -> Plane:
    """Repeat a plane of every second pixel for those to its right and below it, too.

    Returns:
        The plane at all pixels.
    """
    return plane.repeat(FINE, 0).repeat(FINE, 1)[: hw[0], : hw[1]]
