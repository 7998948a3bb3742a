"""lensboy's camera: one JSON a camera, OpenCV's lens or a splined one.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes and coefficients; no pose: the
camera is at the world's origin. A splined lens displaces pinhole points by cubic B-splines over the
stereographic projection, whose outermost cells are beyond `fov_deg_x` and `fov_deg_y`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from ..camera import Camera
from ..lenses import Splined
from ..lenses.model import LensModel
from ..lenses.splined import PINHOLE
from ..pose import Pose
from ..rig import Rig
from .source import RigSource

CONVENTION = "first pixel's centre at 0 (shift 0); no pose: the camera is the world"
OLDEST = 3
"""The first version whose splines are these."""


def recognises(path: Path, head: str) -> bool:
    return '"lensboy-version"' in head


def read(source: RigSource) -> Rig:
    """The one camera, by its file's name."""
    fields = source.json()
    numbers = [source.get(fields, key, "") for key in ("fx", "fy", "cx", "cy")]
    camera = Camera(
        K=source.focal_and_centre(numbers, "fx, fy, cx, cy"),
        cam_from_world=Pose.identity(),
        hw=source.size_of(
            [source.get(fields, f"image_{side}", "") for side in ("width", "height")], "image_width"
        ),
        distortion=_lens(source, fields),
    )
    return source.rig([(source.path.stem, camera)])


def _lens(source: RigSource, fields: dict[str, Any]) -> LensModel | None:
    kind = source.get(fields, "type", "")
    if kind == "opencv":
        return source.brown_conrady(fields.get("distortion_coeffs"), "distortion_coeffs")
    if kind != "pinhole_splined":
        raise source.fail("type", f"is '{kind}'; opencv and pinhole_splined are read")
    version = str(fields["lensboy-version"]).partition(".")[0]
    if not version.isdecimal() or int(version) < OLDEST:
        raise source.fail(
            "lensboy-version", f"is {version}; splines from version {OLDEST} on are read: calibrate again"
        )
    counts = [
        int(source.number(source.get(fields, f"num_knots_{axis}", ""), f"num_knots_{axis}")) for axis in "xy"
    ]
    nx, ny = counts
    grids = [
        source.numbers(source.get(fields, f"d{axis}_grid", ""), (ny, nx), f"d{axis}_grid") for axis in "xy"
    ]
    spacing = []
    for axis, count in zip("xy", counts):
        degrees = source.number(source.get(fields, f"fov_deg_{axis}", ""), f"fov_deg_{axis}")
        if not 0 < degrees < 360 or count < 4:
            raise source.fail(
                f"fov_deg_{axis}", f"is {degrees:g} of {count} knots; wanted 0 to 360 and 4 knots or more"
            )
        spacing.append(4 * math.tan(math.radians(degrees) / 4) / (count - 3))
    return Splined(torch.stack(grids, -1), torch.tensor(spacing, dtype=torch.float64), base=PINHOLE)
