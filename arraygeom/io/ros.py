"""ROS CameraInfo YAML: one camera a file, or a folder of such files as one rig.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres. `projection_matrix` P =
K' [I | t] acts on points of the *rectified* frame, which all cameras of a stereo pair share and which is the
world here; `rectification_matrix` takes the camera's frame into it: X_cam = R_rect^T (X_world + t). A P of
zeros states nothing: the camera is then at the world's origin, rotated by R_rect.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ..camera import Camera
from ..distortion import Distortion
from ..pose import Pose
from ..rig import Rig
from .source import RigSource

CONVENTION = "first pixel's centre at 0 (shift 0); P on rectified points, world = the rectified frame; metres"


def recognises(path: Path, head: str) -> bool:
    if path.is_dir():
        return any(_is_camera_info(file.read_text(errors="replace")[:4096]) for file in _yaml_files(path))
    return _is_camera_info(head)


def read(source: RigSource) -> Rig:
    """The cameras, under their `camera_name` (else the file's name)."""
    files = _yaml_files(source.path) if source.path.is_dir() else [source.path]
    infos = [file for file in files if len(files) == 1 or _is_camera_info(file.read_text(errors="replace"))]
    return source.rig(_camera(RigSource(file, hw=source.hw)) for file in infos)


def _yaml_files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix in {".yaml", ".yml"} and file.is_file())


def _is_camera_info(text: str) -> bool:
    return "camera_matrix:" in text and "distortion_model:" in text and "opencv-matrix" not in text


def _camera(source: RigSource) -> tuple[str, Camera]:
    info = source.yaml()
    K = source.intrinsics(_data(source, info, "camera_matrix"), "camera_matrix")
    width, height = (source.get(info, f"image_{k}", "") for k in ("width", "height"))
    camera = Camera(
        K=K,
        cam_from_world=_pose(source, info),
        hw=source.size(width, height, "image_width, image_height"),
        distortion=_lens(source, info),
    )
    return str(info.get("camera_name") or source.path.stem), camera


def _pose(source: RigSource, info: dict[str, Any]) -> Pose:
    R = torch.eye(3, dtype=torch.float64)
    if "rectification_matrix" in info:
        R = source.rotation(_data(source, info, "rectification_matrix"), "rectification_matrix")
    rect_from_cam, t = Pose(R, torch.zeros(3, dtype=torch.float64)), torch.zeros(3, dtype=torch.float64)
    if "projection_matrix" in info:
        P = source.numbers(_data(source, info, "projection_matrix"), (3, 4), "projection_matrix")
        if P.any():
            t = torch.linalg.solve(source.intrinsics(P[:, :3], "projection_matrix"), P[:, 3])
    return rect_from_cam.inverse() @ Pose(torch.eye(3, dtype=torch.float64), t)


def _lens(source: RigSource, info: dict[str, Any]) -> Distortion | None:
    model, entry = source.get(info, "distortion_model", ""), "distortion_coefficients"
    if model in ("plumb_bob", "rational_polynomial"):
        return source.brown_conrady(_data(source, info, entry), entry)
    if model in ("equidistant", "fisheye"):
        return source.kannala_brandt(_data(source, info, entry), entry)
    if model in ("", "none"):
        return None
    raise source.fail(
        "distortion_model", f"is '{model}'; supported: plumb_bob, rational_polynomial, equidistant"
    )


def _data(source: RigSource, info: dict[str, Any], name: str) -> Any:
    return source.get(source.mapping(source.get(info, name, ""), name), "data", name)
