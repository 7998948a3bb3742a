"""SYNTIM (INRIA) camera files, one a camera: `cam_NAME_g` (left) and `cam_NAME_d` (right).

Source convention: X_cam = R^T (X - t) in millimetres; K from u0, v0, au, av; no distortion; pixels are taken
to have the first centre at 0 (shift 0), which the files do not say; OpenCV axes. Name either file of a pair.
"""

from __future__ import annotations

import re
from pathlib import Path

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import RigSource

CONVENTION = "first pixel's centre at 0 (shift 0); X_cam = R^T (X - t); millimetres"
SIDES = {"_g": "left", "_d": "right"}
NUMBER = r"([-+]?(?:nan|inf|[\d.]+(?:[eE][-+]?\d+)?))"


def recognises(path: Path, head: str) -> bool:
    return "Intrinsic parameters:" in head and "Scale factor" in head


def read(source: RigSource) -> Rig:
    """The pair "left", "right", or the one camera that is there."""
    side = source.path.name[-2:]
    if side not in SIDES:
        return source.rig([(source.path.name, _camera(source))])
    files = {name: source.path.with_name(source.path.name[:-2] + end) for end, name in SIDES.items()}
    return source.rig((name, _camera(RigSource(file))) for name, file in files.items() if file.exists())


def _camera(source: RigSource) -> Camera:
    text = source.text()
    values = {k: _value(source, text, k) for k in ("u0", "v0", "au", "av", "dimx", "dimy")}
    K = source.focal_and_centre([values[k] for k in ("au", "av", "u0", "v0")], "au, av, u0, v0")
    rotation, _, translation = text.partition("Rotation:")[2].partition("Translation:")
    rotation, translation = (
        " ".join(re.findall(NUMBER, part, re.IGNORECASE)) for part in (rotation, translation)
    )
    R, t = (
        source.numbers_in(rotation, (3, 3), "Rotation"),
        source.numbers_in(translation, (3,), "Translation"),
    )
    world_from_cam = source.pose(R, t, "Rotation, Translation:", metres=1e-3)
    hw = source.size(values["dimx"], values["dimy"], "dimx, dimy")
    return Camera(K=K, cam_from_world=Pose.inverse(world_from_cam), hw=hw)


def _value(source: RigSource, text: str, name: str) -> float:
    found = re.search(rf"\b{name}\s*=\s*{NUMBER}", text, re.IGNORECASE)
    if not found:
        raise source.fail(name, "is missing; is the file whole?")
    return float(source.numbers_in(found[1], (1,), name))
