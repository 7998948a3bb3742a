"""JSON of Open3D: PinholeCameraParameters, or a PinholeCameraTrajectory of several.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres; `intrinsic_matrix` and
`extrinsic` (world->camera, 4 x 4) column by column. Cameras of a trajectory are named cam0, cam1, ...
"""

from __future__ import annotations

from pathlib import Path

from ..camera import Camera
from ..rig import Rig
from .source import Entry, RigSource


def recognises(path: Path, head: str) -> bool:
    return head.lstrip().startswith("{") and '"PinholeCamera' in head


def read(source: RigSource) -> Rig:
    """All cameras of a trajectory, or the one camera."""
    document = source.json()
    cameras = document["parameters"].each() if "parameters" in document else [document]
    return source.rig((f"cam{i}", _camera(fields)) for i, fields in enumerate(cameras))


def _camera(fields: Entry) -> Camera:
    intrinsic = fields["intrinsic"]
    return Camera(
        K=intrinsic["intrinsic_matrix"].transposed(3).intrinsics(),
        cam_from_world=fields["extrinsic"].transposed(4).pose_matrix(),
        hw=intrinsic.listed("width", "height").size(),
    )
