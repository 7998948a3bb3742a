"""mrcal's .cameramodel: one camera a file, or a folder of them.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; `rt_cam_ref`, in older files
`extrinsics`, is a rotation vector and a translation in metres that take points of the reference frame into
the camera's. LENSMODEL_SPLINED_STEREOGRAPHIC's displacements are of stereographic points: the camera model
`Splined`.

Written by: mrcal 1 and 2: pinhole, OpenCV 4 to 12, LONLAT, splined stereographic.
Refused: its other models: convert them with mrcal-convert-lensmodel.
Sample: hand-written: mrcal; [documented](https://mrcal.secretsauce.net/cameramodels.html).
"""

from __future__ import annotations

import ast
import math
import re
from pathlib import Path

from ..camera import Camera
from ..lenses import Equirectangular, Splined
from ..lenses.model import LensModel
from ..rig import Rig
from .source import Entry, RigSource, pose_of

SUFFIX = ".cameramodel"
LENSES = {"LENSMODEL_PINHOLE": 0, **{f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)}}
"""Number of coefficients after fx, fy, cx, cy, by lens model."""
SPHERE = "LENSMODEL_LONLAT"
SPLINED = re.compile(
    r"LENSMODEL_SPLINED_STEREOGRAPHIC_order=([23])_Nx=(\d+)_Ny=(\d+)_fov_x_deg=(\d+(?:\.\d+)?)"
)
LONGEST = 1_000_000
"""Largest number of characters of a file: splined models have thousands of numbers."""


def recognises(path: Path, head: str) -> bool:
    """Return True for a file with mrcal's suffix or lens models, or a folder of such files."""
    return any(path.glob(f"*{SUFFIX}")) if path.is_dir() else path.suffix == SUFFIX or "LENSMODEL_" in head


def read(source: RigSource) -> Rig:
    """Read the cameras by the names of their files.

    Raises:
        RigFileError: for a damaged file, or an unsupported lens model.
    """
    return source.rig((file.path.stem, _camera(file)) for file in source.files(f"*{SUFFIX}"))


def _camera(source: RigSource) -> Camera:
    fields = _fields(source)
    rt, numbers = fields["rt_cam_ref", "extrinsics"], fields["intrinsics"]
    R, t = (source.at(half, rt.name) for half in rt.numbers((6,)).split(3))
    K = fields.at(numbers.numbers()[:4], "intrinsics").focal_and_centre()
    return fields.camera(pose_of(R, t), K=K, distortion=_lens(fields["lensmodel"], numbers))


def _lens(model: Entry, numbers: Entry) -> LensModel | None:
    """Read the lens of a model from the numbers after focal lengths and centre."""
    name = str(model.value)
    splined = SPLINED.fullmatch(name)
    if not splined and name not in LENSES and name != SPHERE:
        supported = ", ".join([*LENSES, SPHERE, "LENSMODEL_SPLINED_STEREOGRAPHIC"])
        raise model.fail(f"is '{name}'; of mrcal's {supported} are read: use mrcal-convert-lensmodel")
    if not splined:
        rest = numbers.numbers((4 + LENSES.get(name, 0),))[4:]
        return Equirectangular() if name == SPHERE else model.source.at(rest, "intrinsics").brown_conrady()
    order, nx, ny = (int(number) for number in splined.groups()[:3])
    knots = numbers.numbers((4 + 2 * nx * ny,))[4:].reshape(ny, nx, 2)
    edge = 2 * math.tan(math.radians(float(splined[4])) / 4)
    try:
        return Splined(knots, knots.new_full((2,), 2 * edge / max(nx - order, 1)), order)
    except ValueError as error:
        raise model.fail(str(error)) from None


def _fields(source: RigSource) -> Entry:
    """Return the entries of the file, a dictionary of Python's literals with comments."""
    text = source.text(LONGEST)
    try:
        document = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        raise source.fail(None, "is not a dictionary of numbers and texts; is the file whole?") from None
    fields = source.at(document).mapping().value
    return source.at({k.decode() if isinstance(k, bytes) else str(k): value for k, value in fields.items()})
