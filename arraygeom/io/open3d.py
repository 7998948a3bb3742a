"""JSON of Open3D: PinholeCameraParameters, or a PinholeCameraTrajectory of several.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres; `intrinsic_matrix` and
`extrinsic` (world->camera, 4 x 4) column by column. Cameras of a trajectory are named cam0, cam1, ...
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..camera import Camera
from ..rig import Rig
from .source import RigSource

CONVENTION = "first pixel's centre at 0 (shift 0); world->camera, matrices column by column; metres"


def recognises(path: Path, head: str) -> bool:
    return head.lstrip().startswith("{") and '"PinholeCamera' in head


def read(source: RigSource) -> Rig:
    """All cameras of a trajectory, or the one camera."""
    document = source.json()
    cameras = document.get("parameters", [document])
    if not isinstance(cameras, list):
        raise source.fail("parameters", "is not a list of cameras")
    return source.rig((f"cam{i}", _camera(source, fields, f"cam{i}")) for i, fields in enumerate(cameras))


def _camera(source: RigSource, fields: Any, name: str) -> Camera:
    fields = source.mapping(fields, name)
    entry = f"{name}.intrinsic"
    intrinsic = source.mapping(source.get(fields, "intrinsic", name), entry)
    columns = source.numbers(
        source.get(intrinsic, "intrinsic_matrix", entry), (3, 3), f"{entry}.intrinsic_matrix"
    )
    extrinsic = source.numbers(source.get(fields, "extrinsic", name), (4, 4), f"{name}.extrinsic")
    width, height = (source.get(intrinsic, side, entry) for side in ("width", "height"))
    return Camera(
        K=source.intrinsics(columns.T, f"{entry}.intrinsic_matrix"),
        cam_from_world=source.pose_matrix(extrinsic.T, f"{name}.extrinsic"),
        hw=source.size(width, height, f"{entry} width, height"),
    )
