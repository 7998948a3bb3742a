"""Receptive fields: the sampling locations in beta for the point that an alpha pixel sees.

A field is anything that can be called with a `Pair` and alpha pixels x (*n, 2), and answers with `Segments`
or `Positions` over *n. The families here are frozen dataclasses; a plain function serves as well:

>>> import torch
>>> from arraygeom import Segments
>>> def right_here(pair, x):  # the same pixel in beta, and nothing else
...     return Segments(x, x, torch.ones_like(x[..., 0], dtype=torch.bool))

A rig whose numbers have batch axes *b takes pixels (*b, ..., 2), or with axes of length 1 in place of *b.
"""

from .around import AroundDepth, AroundMatches
from .curved import Curved, ThroughLenses
from .default import FIELDS, default_field, named_field, recorded_field
from .explicit import Dense, Local, NearestVoxels
from .protocol import ReceptiveField, SamplingLocations, lazily, sampling_locations
from .ray_depth import ray_depth
from .straight import (
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Rectified,
    approximated,
    covering_displacement,
    pinhole_track,
)
from .widened import Moved, Widened

__all__ = [
    "FIELDS",
    "AroundDepth",
    "AroundMatches",
    "Curved",
    "Dense",
    "Epipolar",
    "EpipolarLine",
    "HomographyDisplacement",
    "Local",
    "Moved",
    "NearestVoxels",
    "ReceptiveField",
    "Rectified",
    "SamplingLocations",
    "ThroughLenses",
    "Widened",
    "approximated",
    "covering_displacement",
    "default_field",
    "lazily",
    "named_field",
    "pinhole_track",
    "ray_depth",
    "recorded_field",
    "sampling_locations",
]
