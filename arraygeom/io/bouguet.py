"""Calib_Results.mat and Calib_Results_stereo.mat of Bouguet's Camera Calibration Toolbox for MATLAB.

Source convention: pixels with the first centre at 0 (shift 0), although of MATLAB; OpenCV's lens;
X_right = R X_left + T with R from the rotation vector `om` where it is not stated; millimetres. The world is
the left camera. K has the skew `alpha_c` times the first focal length.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .matfile import load_variables, readable_variables
from .source import RigSource

CONVENTION = "first pixel's centre at 0 (shift 0); X_right = R X_left + T, world = left camera; mm"
SIDES = ("left", "right")


def recognises(path: Path, head: str) -> bool:
    if not (path.is_file() and (path.suffix == ".mat" or head.startswith("MATLAB "))):
        return False
    try:
        names = readable_variables(path.read_bytes())
    except (OSError, ValueError):
        return False
    return "fc_left" in names or {"fc", "cc"} <= set(names)


def read(source: RigSource) -> Rig:
    """The pair "left" and "right", or one camera, "camera"."""
    fields = load_variables(source)
    if "fc_left" not in fields:
        return source.rig([("camera", _camera(source, fields, "", Pose.identity()))])
    R = source.get(fields, ("R", "om"), "")
    right = source.pose(R, source.get(fields, "T", ""), "R, T:", metres=1e-3)
    poses = Pose.identity(), right
    return source.rig((side, _camera(source, fields, f"_{side}", pose)) for side, pose in zip(SIDES, poses))


def _camera(source: RigSource, fields: dict[str, Any], which: str, pose: Pose) -> Camera:
    focal = source.numbers(source.get(fields, f"fc{which}", ""), None, f"fc{which}").tolist()
    fx, fy = (
        focal * 2
        if len(focal) == 1
        else focal
        if len(focal) == 2
        else source.numbers(focal, (2,), f"fc{which}")
    )
    cx, cy = source.numbers(source.get(fields, f"cc{which}", ""), (2,), f"cc{which}").tolist()
    skew = source.number(fields.get(f"alpha_c{which}", 0.0), f"alpha_c{which}")
    K = source.intrinsics([[fx, skew * fx, cx], [0, fy, cy], [0, 0, 1]], f"fc{which}, cc{which}")
    hw = source.size(fields["nx"], fields["ny"], "nx, ny") if "nx" in fields and "ny" in fields else None
    return Camera(
        K=K,
        cam_from_world=pose,
        hw=source.size_unstated(K) if hw is None else hw,
        distortion=source.brown_conrady(fields.get(f"kc{which}"), f"kc{which}"),
    )
