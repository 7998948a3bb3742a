"""lensboy's camera: one JSON a camera, OpenCV's lens or a splined one.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes and coefficients; no pose: the
camera is at the world's origin. A splined lens displaces pinhole points by cubic B-splines over the
stereographic projection, whose outermost cells are beyond `fov_deg_x` and `fov_deg_y`.

Written by: lensboy: opencv and pinhole_splined.
Refused: splines of versions before 3.
Sample: hand-written: lensboy.json.
"""

from __future__ import annotations

import math

import torch

from ..lenses import Splined
from ..lenses.model import LensModel
from ..lenses.splined import PINHOLE
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource

OLDEST = 3
"""First version whose splines have this form."""


HEAD = '"lensboy-version"'


def read(source: RigSource) -> Rig:
    """Read the one camera, at the origin and named by its file.

    Raises:
        RigFileError: for a damaged file, an unsupported lens, or splines of an older version.
    """
    fields = source.json()
    return source.rig([(source.path.stem, fields.camera(Pose.identity(), distortion=_lens(fields)))])


def _lens(fields: Entry) -> LensModel | None:
    kind = fields["type"]
    if kind.value == "opencv":
        return fields["distortion_coeffs"].brown_conrady()
    if kind.value != "pinhole_splined":
        raise kind.fail(f"is '{kind.value}'; opencv and pinhole_splined are read")
    version = str(fields["lensboy-version"].value).partition(".")[0]
    if not version.isdecimal() or int(version) < OLDEST:
        raise fields["lensboy-version"].fail(
            f"is {version}; splines from version {OLDEST} on are read: calibrate again"
        )
    nx, ny = counts = [int(fields[f"num_knots_{axis}"].number()) for axis in "xy"]
    knots = torch.stack([fields[f"d{axis}_grid"].numbers((ny, nx)) for axis in "xy"], -1)
    spacing = []
    for axis, count in zip("xy", counts):
        field = fields[f"fov_deg_{axis}"]
        degrees = field.number()
        if not 0 < degrees < 360 or count < 4:
            raise field.fail(f"is {degrees:g} of {count} knots; wanted 0 to 360 and 4 knots or more")
        spacing.append(4 * math.tan(math.radians(degrees) / 4) / (count - 3))
    return Splined(knots, torch.tensor(spacing, dtype=torch.float64), base=PINHOLE)
