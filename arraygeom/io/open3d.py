"""JSON of Open3D: PinholeCameraParameters, or a PinholeCameraTrajectory of several.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres; `intrinsic_matrix` and
`extrinsic` (world->camera, 4 x 4) column by column; intrinsics alone (`intrinsic.json` of its Azure Kinect
recorder) are a camera at the origin. Cameras are named cam0, cam1, ...

Written by: Open3D: PinholeCameraParameters, PinholeCameraTrajectory, intrinsic.json.
Refused: nothing of it.
Sample: hand-written: open3d.json;
[documented](https://www.open3d.org/docs/release/python_api/open3d.camera.PinholeCameraParameters.html).
"""

from __future__ import annotations

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource

HEAD = r'(?s)\s*\{.*"(PinholeCamera|intrinsic_matrix")'


def read(source: RigSource) -> Rig:
    """Read all cameras of a trajectory, or the one camera.

    Raises:
        RigFileError: for a damaged file.
    """
    document = source.json()
    cameras = document["parameters"].each() if "parameters" in document else [document]
    return source.rig((f"cam{i}", _camera(fields)) for i, fields in enumerate(cameras))


def _camera(fields: Entry) -> Camera:
    posed = "intrinsic_matrix" not in fields
    intrinsic = fields["intrinsic"] if posed else fields
    pose = fields["extrinsic"].transposed(4).pose_matrix() if posed else Pose.identity()
    return intrinsic.camera(pose, K=intrinsic["intrinsic_matrix"].transposed(3).intrinsics(), distortion=None)
