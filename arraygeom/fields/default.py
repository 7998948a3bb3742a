"""The default field of a pair, and fields by name."""

from __future__ import annotations

from arraygeom import (
    Epipolar,
    HomographyDisplacement,
    Pair,
    ReceptiveField,
    Rectified,
)


def default_field(pair: Pair) -> ReceptiveField:
    """The field that what is known of a pair allows."""
    if pair.link is not None:
        return HomographyDisplacement(0.06 * max(pair.beta.hw))
    if pair.calibrated:
        return Epipolar()
    return Rectified(alpha_is="either", max_disparity=0.12 * pair.beta.hw[1])
