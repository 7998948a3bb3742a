"""ROS CameraInfo: the YAML of its calibrators or a message as text; a file a camera, or a folder of them.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres. `projection_matrix` P =
K' [I | t] acts on points of the *rectified* frame, which all cameras of a stereo pair share and which is the
world here; `rectification_matrix` takes the camera's frame into it: X_cam = R_rect^T (X_world + t). A P of
zeros states nothing: the camera is then at the world's origin, rotated by R_rect.

Written by: calibrators of ROS 1 and 2 (YAML), and `rostopic echo` or `ros2 topic echo` of CameraInfo.
Refused: models other than plumb_bob, rational_polynomial, equidistant.
Sample: hand-written: ros; [documented](https://docs.ros.org/en/api/sensor_msgs/html/msg/CameraInfo.html).
"""

from __future__ import annotations

import re
from pathlib import Path

import torch

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource, decoded


def recognises(path: Path, head: str) -> bool:
    """Return True for the text of a CameraInfo, or a folder with one."""
    if path.is_dir():
        return any(
            _is_camera_info(decoded(file.read_bytes()[:4096]))
            for file in path.glob("*.y*ml")
            if file.is_file()
        )
    return _is_camera_info(head)


def read(source: RigSource) -> Rig:
    """Read the cameras, under their `camera_name` (else the frame's, else the file's name).

    Raises:
        RigFileError: for a damaged file, or an unsupported lens.
    """
    files = source.files("*.y*ml")
    return source.rig(_camera(f) for f in files if len(files) == 1 or _is_camera_info(decoded(f.content())))


def _is_camera_info(text: str) -> bool:
    K = re.search(r"^(camera_matrix|K|k):", text, re.M)
    return K is not None and "distortion_model:" in text and "opencv-matrix" not in text


def _camera(source: RigSource) -> tuple[str, Camera]:
    info = source.document()
    if "distortion_model" not in info:
        raise source.fail("distortion_model", "is missing; is this a CameraInfo?")
    frame = (info.get("header").value or {}).get("frame_id")
    return str(info.get("camera_name").value or frame or source.path.stem), info.camera(_pose(info))


def _pose(info: Entry) -> Pose:
    rect_from_cam = stereo = Pose.identity()
    R, entry = (info.find(name) for name in ("rectificationmatrix|r", "projectionmatrix|p"))
    if R.value is not None and R.tensor().any():
        rect_from_cam = Pose(R.rotation(), stereo.t)
    if entry.value is not None:
        P = entry.numbers((3, 4))
        if P.any():
            K = entry.source.at(P[:, :3], entry.name).intrinsics()
            stereo = Pose(stereo.R, torch.linalg.solve(K, P[:, 3]))
    return rect_from_cam.inverse() @ stereo
