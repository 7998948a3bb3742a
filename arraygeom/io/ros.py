"""ROS CameraInfo: the YAML of its calibrators or a message as text; a file a camera, or a folder of them.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres. `projection_matrix` P =
K' [I | t] acts on points of the *rectified* frame, which all cameras of a stereo pair share and which is the
world here; `rectification_matrix` takes the camera's frame into it: X_cam = R_rect^T (X_world + t). A P of
zeros states nothing: the camera is then at the world's origin, rotated by R_rect.
"""

from __future__ import annotations

import re
from pathlib import Path

import torch

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import LENS_NAME, Entry, RigSource, decoded


def recognises(path: Path, head: str) -> bool:
    """Return True for the text of a CameraInfo, or a folder with one."""
    if path.is_dir():
        return any(_is_camera_info(decoded(file.read_bytes()[:4096])) for file in _yaml_files(path))
    return _is_camera_info(head)


def read(source: RigSource) -> Rig:
    """Read the cameras, under their `camera_name` (else the frame's, else the file's name).

    Raises:
        RigFileError: for a damaged file, or an unsupported lens.
    """
    files = _yaml_files(source.path) if source.path.is_dir() else [source.path]
    infos = [file for file in files if len(files) == 1 or _is_camera_info(decoded(file.read_bytes()))]
    return source.rig(_camera(source.beside(file)) for file in infos)


def _yaml_files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix in {".yaml", ".yml"} and file.is_file())


def _is_camera_info(text: str) -> bool:
    K = re.search(r"^(camera_matrix|K|k):", text, re.M)
    return K is not None and "distortion_model:" in text and "opencv-matrix" not in text


def _camera(source: RigSource) -> tuple[str, Camera]:
    info = source.yaml(
        re.split(r"^---", source.text().removeprefix("---"), flags=re.M)[0]
    )  # the first message
    K = _numbers(info["camera_matrix", "K", "k"]).intrinsics()
    topic = "width" if "width" in info else "image_width", "height" if "height" in info else "image_height"
    lens = _numbers(info.find(LENS_NAME)).of_model(info["distortion_model"])
    camera = Camera(K=K, cam_from_world=_pose(info), hw=info.sized(*topic, K=K), distortion=lens)
    frame = (info.get("header").value or {}).get("frame_id")
    return str(info.get("camera_name").value or frame or source.path.stem), camera


def _numbers(entry: Entry) -> Entry:
    """Return the numbers of a file's matrix, or a message's."""
    return entry["data"] if isinstance(entry.value, dict) else entry


def _pose(info: Entry) -> Pose:
    rect_from_cam = stereo = Pose.identity()
    R, entry = (_numbers(info.find(name)) for name in ("rectificationmatrix|r", "projectionmatrix|p"))
    if R.value is not None and R.tensor().any():
        rect_from_cam = Pose(R.rotation(), stereo.t)
    if entry.value is not None:
        P = entry.numbers((3, 4))
        if P.any():
            K = entry.source.at(P[:, :3], entry.name).intrinsics()
            stereo = Pose(stereo.R, torch.linalg.solve(K, P[:, 3]))
    return rect_from_cam.inverse() @ stereo
