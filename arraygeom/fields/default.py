"""The default field of a pair, and fields by name: the one policy that fusion, drawings and refinement share."""

from __future__ import annotations

from typing import Any

from ..rig import Pair
from .curved import Curved, ThroughLenses
from .explicit import Dense, Local, NearestVoxels
from .protocol import ReceptiveField
from .straight import Epipolar, EpipolarLine, HomographyDisplacement, Rectified

FIELDS: dict[str, type[Any]] = {
    "epipolar": Epipolar,
    "line": EpipolarLine,
    "homography": HomographyDisplacement,
    "rectified": Rectified,
    "nearest": NearestVoxels,
    "local": Local,
    "dense": Dense,
    "curved": Curved,
}
"""The families that can be chosen by name; each can be made without arguments."""

LINE_SHARE = 0.06
"""Displacement from H x along the line of a pair with a link, as a share of beta's longer side."""
ROW_SHARE = 0.12
"""Largest disparity, either way, of a pair of which only the sizes are known, as a share of beta's width."""


def default_field(pair: Pair) -> ReceptiveField:
    """The field for a pair of pinhole views, which is what fusion uses.

    A pair with a link has `HomographyDisplacement`, also if it is calibrated: a link was measured between these very
    images. A calibrated one has `Epipolar`, which raises ValueError if the pair has no depth range: a search of the
    whole line is ambiguous and has to be asked for (`EpipolarLine`). A pair of which only the sizes are known counts as
    rectified, with alpha on either side.
    """
    if pair.link is not None:
        return HomographyDisplacement(LINE_SHARE * max(pair.beta.hw))
    if pair.calibrated:
        return Epipolar()
    return Rectified(ROW_SHARE * pair.beta.hw[1], alpha_is="either")


def recorded_field(pair: Pair, *, samples: int = 256, nodes: int = 64) -> ReceptiveField:
    """`default_field` for the images as recorded: through their lenses, and the whole line without a depth range.

    Drawings use it, which need no depth range. `samples` and `nodes` are those of `Curved` and `ThroughLenses`.
    """
    field = default_field(pair)
    if isinstance(field, Epipolar) and pair.depth is None:
        field = EpipolarLine()
    if not pair.has_lens:
        return field
    return Curved(samples, nodes=nodes) if isinstance(field, Epipolar) else ThroughLenses(field, samples)
