"""SYNTIM (INRIA) camera files, one a camera: `cam_NAME_g` (left) and `cam_NAME_d` (right).

Source convention: X_cam = R^T (X - t) in millimetres; K from u0, v0, au, av; no distortion; pixels are taken
to have the first centre at 0 (shift 0), which the files do not say; OpenCV axes. Name either file of a pair.

Written by: SYNTIM's stereo pairs (INRIA).
Refused: nothing of it.
Sample: real: 25 pairs.
"""

from __future__ import annotations

import re

from ..camera import Camera
from ..rig import Rig
from .source import RigSource, pose_of

SIDES = {"_g": "left", "_d": "right"}
NUMBER = r"([-+]?(?:nan|inf|[\d.]+(?:[eE][-+]?\d+)?))"


HEAD = r"(?s)(?=.*Intrinsic parameters:).*Scale factor"


def read(source: RigSource) -> Rig:
    """Read the pair "left" and "right" of a file cam_NAME_g or cam_NAME_d, or the one there is, in metres.

    Where the name ends otherwise, with a suffix too, the file gives one camera of its own whole name.

    Raises:
        RigFileError: for a damaged file, or none.
    """
    side = source.path.name[-2:]
    if side not in SIDES:
        return source.rig([(source.path.name, _camera(source))])
    files = {name: source.path.with_name(source.path.name[:-2] + end) for end, name in SIDES.items()}
    return source.rig((name, _camera(source.beside(file))) for name, file in files.items() if file.exists())


def _camera(source: RigSource) -> Camera:
    text = source.text()
    stated = reversed(re.findall(rf"\b(\w+)\s*=\s*{NUMBER}", text, re.IGNORECASE))
    fields = source.at({name.lower(): value for name, value in stated})
    rotation, _, translation = text.partition("Rotation:")[2].partition("Translation:")
    R, t = (
        source.at(re.findall(NUMBER, section, re.IGNORECASE), name)
        for section, name in ((rotation, "Rotation"), (translation, "Translation"))
    )
    R.numbers((3, 3))
    return Camera(
        K=fields.listed("au", "av", "u0", "v0").focal_and_centre(),
        cam_from_world=pose_of(R, t, metres=1e-3).inverse(),
        hw=fields.listed("dimx", "dimy").size(),
    )
