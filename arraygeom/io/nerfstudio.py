"""transforms.json of nerfstudio and instant-ngp.

Source convention: pixels with the first centre at 0.5 (shift -0.5); OpenGL axes (y up, optical axis -z),
rotated into ours; `transform_matrix` is camera->world, inverted; the scale is the file's own, taken as
metres. Intrinsics may stand at the top or in each frame.
"""

from __future__ import annotations

import json
import math
from collections import ChainMap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ..camera import Camera
from ..distortion import KANNALA_BRANDT, Distortion
from ..pose import Pose
from ..rig import Rig
from .export import brown_conrady, calibrated, focal_and_centre, pose_rows
from .source import RigSource

CONVENTION = (
    "first pixel's centre at 0.5 (shift -0.5); "
    "OpenGL camera->world, rotated and inverted; scale as in the file"
)
FISHEYES = ("OPENCV_FISHEYE", "FISHEYE")
PERSPECTIVES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
# Ours (y down, z forward) from OpenGL's (y up, z back).
FLIP = Pose(
    torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)), torch.zeros(3, dtype=torch.float64)
)


def recognises(path: Path, head: str) -> bool:
    return any(f'"{key}"' in head for key in ("transform_matrix", "fl_x", "camera_angle_x"))


def read(source: RigSource) -> Rig:
    """One camera for each frame, named by its `file_path`."""
    document = source.json()
    frames = source.get(document, "frames", "")
    if not isinstance(frames, list) or not frames:
        raise source.fail("frames", "is no list, or an empty one; is the file whole?")
    del document["frames"]
    cameras = []
    for i, frame in enumerate(frames):
        entry = f"frames[{i}]"
        fields = ChainMap(source.mapping(frame, entry), document)
        cameras.append((str(source.get(fields, "file_path", entry)), _camera(source, fields, entry)))
    return source.rig(cameras)


def write(rig: Rig) -> str:
    """A transforms.json with intrinsics in each frame. Raises ValueError for what the format cannot hold."""
    frames = [_frame(name, camera) for name, camera in calibrated(rig, "nerfstudio")]
    return json.dumps({"frames": frames}, indent=1) + "\n"


def _camera(source: RigSource, fields: Mapping[str, Any], entry: str) -> Camera:
    h, w = source.size(source.get(fields, "w", entry), source.get(fields, "h", entry), f"{entry} w, h")
    fx = _focal(source, fields, "x", w, entry)
    fy = _focal(source, fields, "y", h, entry) if fields.keys() & {"fl_y", "camera_angle_y"} else fx
    centre = [source.number(fields.get(k, n / 2), f"{entry} {k}") for k, n in (("cx", w), ("cy", h))]
    K = source.focal_and_centre([fx, fy, *centre], f"{entry} fl_x, fl_y", first_pixel=0.5)
    matrix = source.get(fields, "transform_matrix", entry)
    world_from_gl = source.pose_matrix(matrix, f"{entry}.transform_matrix")
    pose = FLIP @ world_from_gl.inverse()
    return Camera(K=K, cam_from_world=pose, hw=(h, w), distortion=_lens(source, fields, entry))


def _focal(source: RigSource, fields: Mapping[str, Any], axis: str, size: int, entry: str) -> float:
    """Stated, or from the field of view in radians."""
    if fields.get(f"fl_{axis}") is not None:
        return source.number(fields[f"fl_{axis}"], f"{entry} fl_{axis}")
    angle = source.number(
        source.get(fields, (f"camera_angle_{axis}",), f"{entry} fl_{axis}"), f"{entry} camera_angle"
    )
    if not 0 < angle < math.pi:
        raise source.fail(f"{entry} camera_angle_{axis}", f"is {angle:g}; wanted radians between 0 and pi")
    return size / 2 / math.tan(angle / 2)


def _lens(source: RigSource, fields: Mapping[str, Any], entry: str) -> Distortion | None:
    model = str(fields.get("camera_model", "OPENCV")).upper()
    if model not in FISHEYES + PERSPECTIVES:
        raise source.fail(
            f"{entry} camera_model", f"is {model}; supported: {', '.join(PERSPECTIVES + FISHEYES)}"
        )
    value = {
        k: source.number(fields.get(k, 0.0), f"{entry} {k}") for k in ("k1", "k2", "k3", "k4", "p1", "p2")
    }
    if fields.get("is_fisheye") or model in FISHEYES:
        return source.kannala_brandt([value[k] for k in ("k1", "k2", "k3", "k4")], entry)
    if not any(k in fields for k in value):
        return None
    if value["k4"] != 0:
        raise source.fail(
            f"{entry} k4", "is the r^8 term of a perspective lens, which OpenCV's model does not have"
        )
    c = [value[k] for k in ("k1", "k2", "p1", "p2", "k3")]
    return source.brown_conrady(c if "k3" in fields else c[:4], entry)


def _frame(name: str, camera: Camera) -> dict[str, Any]:
    fx, fy, cx, cy = focal_and_centre(name, camera, first_pixel=0.5)
    (h, w), lens = camera.hw, camera.distortion
    world_from_gl = camera.cam_from_world.inverse() @ FLIP
    fields: dict[str, Any] = {"file_path": name, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": w, "h": h}
    if lens is None:
        fields["camera_model"] = "PINHOLE"
    elif lens.model == KANNALA_BRANDT:
        fields |= {"camera_model": "OPENCV_FISHEYE"} | dict(
            zip(("k1", "k2", "k3", "k4"), lens.coefficients.tolist())
        )
    else:
        names = ("k1", "k2", "p1", "p2", "k3")
        fields |= {"camera_model": "OPENCV"} | dict(zip(names, brown_conrady(name, lens, at_most=5)))
    return fields | {"transform_matrix": pose_rows(world_from_gl.R, world_from_gl.t)}
