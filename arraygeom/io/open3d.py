"""JSON of Open3D: PinholeCameraParameters, or a PinholeCameraTrajectory of several.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres; `intrinsic_matrix` and
`extrinsic` (world->camera, 4 x 4) column by column; intrinsics alone (`intrinsic.json` of its Azure Kinect
recorder) are a camera at the origin. Cameras are named cam0, cam1, ...
"""

from __future__ import annotations

from pathlib import Path

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource


def recognises(path: Path, head: str) -> bool:
    """Return True for a JSON text with Open3D's classes or keys."""
    return head.lstrip().startswith("{") and ('"PinholeCamera' in head or '"intrinsic_matrix"' in head)


def read(source: RigSource) -> Rig:
    """Read all cameras of a trajectory, or the one camera.

    Raises:
        RigFileError: for a damaged file.
    """
    document = source.json()
    cameras = document["parameters"].each() if "parameters" in document else [document]
    return source.rig((f"cam{i}", _camera(fields)) for i, fields in enumerate(cameras))


def _camera(fields: Entry) -> Camera:
    intrinsic = fields if "intrinsic_matrix" in fields else fields["intrinsic"]
    K = intrinsic["intrinsic_matrix"].transposed(3).intrinsics()
    posed = intrinsic is not fields
    return Camera(
        K=K,
        cam_from_world=fields["extrinsic"].transposed(4).pose_matrix() if posed else Pose.identity(),
        hw=intrinsic.sized("width", "height", K=K),
    )
