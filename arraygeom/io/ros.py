"""ROS CameraInfo YAML: one camera a file, or a folder of such files as one rig.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres. `projection_matrix` P =
K' [I | t] acts on points of the *rectified* frame, which all cameras of a stereo pair share and which is the
world here; `rectification_matrix` takes the camera's frame into it: X_cam = R_rect^T (X_world + t). A P of
zeros states nothing: the camera is then at the world's origin, rotated by R_rect.
"""

from __future__ import annotations

from pathlib import Path

import torch

from ..camera import Camera
from ..distortion import Distortion
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource, decoded


def recognises(path: Path, head: str) -> bool:
    if path.is_dir():
        return any(_is_camera_info(decoded(file.read_bytes()[:4096])) for file in _yaml_files(path))
    return _is_camera_info(head)


def read(source: RigSource) -> Rig:
    """The cameras, under their `camera_name` (else the file's name)."""
    files = _yaml_files(source.path) if source.path.is_dir() else [source.path]
    infos = [file for file in files if len(files) == 1 or _is_camera_info(decoded(file.read_bytes()))]
    return source.rig(_camera(RigSource(file, hw=source.hw)) for file in infos)


def _yaml_files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix in {".yaml", ".yml"} and file.is_file())


def _is_camera_info(text: str) -> bool:
    return "camera_matrix:" in text and "distortion_model:" in text and "opencv-matrix" not in text


def _camera(source: RigSource) -> tuple[str, Camera]:
    info = source.yaml()
    camera = Camera(
        K=info["camera_matrix"]["data"].intrinsics(),
        cam_from_world=_pose(info),
        hw=info.listed("image_width", "image_height").size(),
        distortion=_lens(info),
    )
    return str(info.get("camera_name").value or source.path.stem), camera


def _pose(info: Entry) -> Pose:
    rect_from_cam = stereo = Pose.identity()
    if "rectification_matrix" in info:
        rect_from_cam = Pose(info["rectification_matrix"]["data"].rotation(), stereo.t)
    if "projection_matrix" in info:
        entry = info["projection_matrix"]["data"]
        P = entry.numbers((3, 4))
        if P.any():
            K = entry.source.at(P[:, :3], entry.name).intrinsics()
            stereo = Pose(stereo.R, torch.linalg.solve(K, P[:, 3]))
    return rect_from_cam.inverse() @ stereo


def _lens(info: Entry) -> Distortion | None:
    model, c = info["distortion_model"], "distortion_coefficients"
    if model.value in ("plumb_bob", "rational_polynomial"):
        return info[c]["data"].brown_conrady()
    if model.value in ("equidistant", "fisheye"):
        return info[c]["data"].kannala_brandt()
    if model.value in ("", "none"):
        return None
    raise model.fail(f"is '{model.value}'; supported: plumb_bob, rational_polynomial, equidistant")
