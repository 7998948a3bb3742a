"""MATLAB's stereoParameters and cameraParameters: the struct (`toStruct`) in .mat, or JSON (`jsonencode`).

Source convention: pixels with the first centre at 1 (shift -1); OpenCV-like axes; lengths in `WorldUnits`, by
default millimetres. The old names are of row vectors (x2 = x1 R + t, [x y 1] ~ X K): `IntrinsicMatrix` and
`RotationOfCamera2` are transposed. The new ones (`K`, `PoseCamera2`, since R2022b) are of columns and are
not. The world is camera 1. A `FundamentalMatrix` in the file has to agree with the pose: that catches a
transposed one.

Fisheyes: the struct of fisheyeIntrinsics or fisheyeParameters, a camera "camera1" (Scaramuzza's model). A
point u, v off `DistortionCenter`, after `StretchMatrix` is undone, is seen along (u, v, a0 + a2 r^2 + a3 r^3
+ a4 r^4); a0 is the focal length here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..camera import Camera
from ..distortion import Distortion
from ..epipolar import epipolar_lines, shift_origin
from ..lenses.central import SCARAMUZZA
from ..pixels import HW, pixel_grid, to_homogeneous
from ..pose import Pose
from ..rig import Rig
from .matfile import load_variables
from .source import RigSource

CONVENTION = (
    "first pixel's centre at 1 (shift -1); row vectors transposed, world = camera 1; WorldUnits, else mm"
)
FISHEYE = "MappingCoefficients"
UNITS = {
    "mm": 1e-3,
    "millimeters": 1e-3,
    "cm": 1e-2,
    "centimeters": 1e-2,
    "m": 1.0,
    "meters": 1.0,
    "in": 0.0254,
}
UNITS |= {"millimetres": 1e-3, "centimetres": 1e-2, "metres": 1.0, "inches": 0.0254}


def recognises(path: Path, head: str) -> bool:
    names = (
        "CameraParameters1",
        "PoseCamera2",
        "RotationOfCamera2",
        "IntrinsicMatrix",
        "RadialDistortion",
        FISHEYE,
    )
    return path.suffix == ".mat" or head.startswith("MATLAB ") or any(f'"{name}"' in head for name in names)


def read(source: RigSource) -> Rig:
    """The pair, named "camera1" and "camera2", or a single camera "camera1"."""
    fields = _outermost(source, _document(source))
    if "CameraParameters1" not in fields:
        return source.rig([("camera1", _camera(source, fields, "", Pose.identity()))])
    poses = Pose.identity(), _pose(source, fields)
    cameras = [
        _camera(source, source.mapping(source.get(fields, name, ""), name), name, pose)
        for name, pose in zip(("CameraParameters1", "CameraParameters2"), poses)
    ]
    if fields.get("FundamentalMatrix") is not None:
        _check_fundamental(
            source, source.numbers(fields["FundamentalMatrix"], (3, 3), "FundamentalMatrix"), *cameras
        )
    return source.rig(zip(("camera1", "camera2"), cameras))


def _document(source: RigSource) -> dict[str, Any]:
    with source.path.open("rb") as file:
        is_text = source.path.suffix != ".mat" and not file.read(7).startswith(b"MATLAB ")
    return source.json() if is_text else load_variables(source)


def _outermost(source: RigSource, fields: dict[str, Any]) -> dict[str, Any]:
    """The struct itself, or the first variable of the file that holds one."""
    for value in (fields, *fields.values()):
        if isinstance(value, dict) and ("CameraParameters1" in value or _is_camera(value)):
            return value
        if value is fields and any(
            name.endswith("Camera2") or name == "CameraParameters2" for name in fields
        ):
            raise source.fail(
                "CameraParameters1", "is missing, and the second camera's is here; is the file whole?"
            )
    raise source.fail(
        "CameraParameters1",
        "is missing: MATLAB objects cannot be read, save the struct, "
        "s = toStruct(stereoParams); save(f, 's', '-v7')",
    )


def _is_camera(fields: dict[str, Any]) -> bool:
    return bool(fields.keys() & {"IntrinsicMatrix", "K", FISHEYE}) or _is_fisheye(fields.get("Intrinsics"))


def _is_fisheye(fields: Any) -> bool:
    return isinstance(fields, dict) and FISHEYE in fields


def _camera(source: RigSource, fields: dict[str, Any], entry: str, pose: Pose) -> Camera:
    if _is_fisheye(fields.get("Intrinsics", fields)):
        return _fisheye(source, fields.get("Intrinsics", fields), entry, pose)
    if "K" in fields:
        K = source.intrinsics(fields["K"], f"{entry}.K", first_pixel=1.0)
    else:
        rows = source.numbers(
            source.get(fields, ("IntrinsicMatrix", "K"), entry), (3, 3), f"{entry}.IntrinsicMatrix"
        )
        K = source.intrinsics(rows.T, f"{entry}.IntrinsicMatrix", first_pixel=1.0)
    lens = _lens(source, fields, entry)
    return Camera(K=K, cam_from_world=pose, hw=_size(source, fields, entry, K), distortion=lens)


def _fisheye(source: RigSource, fields: dict[str, Any], entry: str, pose: Pose) -> Camera:
    a0, a2, a3, a4 = source.numbers(fields[FISHEYE], (4,), f"{entry}.{FISHEYE}").tolist()
    if not a0 > 0:
        raise source.fail(
            f"{entry}.{FISHEYE}", f"begins with {a0:g}; it is positive, about the focal length in pixels"
        )
    centre = source.numbers(source.get(fields, "DistortionCenter", entry), (2,), f"{entry}.DistortionCenter")
    stretch = source.numbers(fields.get("StretchMatrix", [[1, 0], [0, 1]]), (2, 2), f"{entry}.StretchMatrix")
    K = torch.eye(3, dtype=torch.float64)
    K[:2, :2], K[:2, 2] = stretch * a0, centre
    K = source.intrinsics(K, f"{entry}.StretchMatrix", first_pixel=1.0)
    lens = source.lens(SCARAMUZZA, [a2 * a0, a3 * a0**2, a4 * a0**3], f"{entry}.{FISHEYE}")
    return Camera(K=K, cam_from_world=pose, hw=_size(source, fields, entry, K), distortion=lens)


def _size(source: RigSource, fields: dict[str, Any], entry: str, K: Tensor) -> HW:
    size = fields.get("ImageSize")
    if size is None or np.size(size) == 0:
        return source.size_unstated(K)
    height, width = source.numbers(size, (2,), f"{entry}.ImageSize").tolist()
    return source.size(width, height, f"{entry}.ImageSize")


def _lens(source: RigSource, fields: dict[str, Any], entry: str) -> Distortion | None:
    radial = source.numbers(fields.get("RadialDistortion", []), None, f"{entry}.RadialDistortion").tolist()
    tangential = source.numbers(
        fields.get("TangentialDistortion", []), None, f"{entry}.TangentialDistortion"
    ).tolist()
    if not radial and not tangential:
        return None
    if len(radial) not in (2, 3) or len(tangential) not in (0, 2):
        raise source.fail(f"{entry}.RadialDistortion", "wanted 2 or 3 radial and 2 tangential coefficients")
    return source.brown_conrady([*radial[:2], *(tangential or [0.0, 0.0]), *radial[2:]], entry)


def _pose(source: RigSource, fields: dict[str, Any]) -> Pose:
    """X_2 = R X_1 + t, in metres."""
    unit = str(fields.get("WorldUnits") or "mm").strip().lower()
    if unit not in UNITS:
        raise source.fail("WorldUnits", f"is '{unit}'; known: {', '.join(UNITS)}")
    if "PoseCamera2" not in fields:
        R = source.numbers(source.get(fields, "RotationOfCamera2", ""), (3, 3), "RotationOfCamera2")
        return source.pose(
            R.T, source.get(fields, "TranslationOfCamera2", ""), "camera 2", metres=UNITS[unit]
        )
    pose = source.mapping(fields["PoseCamera2"], "PoseCamera2")
    if "A" in pose:
        return source.pose_matrix(pose["A"], "PoseCamera2.A", metres=UNITS[unit])
    R, t = source.get(pose, ("R", "Rotation"), "PoseCamera2"), source.get(pose, "Translation", "PoseCamera2")
    return source.pose(R, t, "PoseCamera2", metres=UNITS[unit])


def _check_fundamental(source: RigSource, F: Tensor, one: Camera, two: Camera) -> None:
    """Points both pinholes see have to be on the lines of F as stated, which is of pixels counted from 1."""
    h, w = one.hw
    x = pixel_grid((4, 4), dtype=torch.float64).reshape(-1, 2) * torch.tensor([w / 4, h / 4])
    baseline = two.centre.norm()
    rays = to_homogeneous(x) @ torch.linalg.inv(one.K).T
    X = two.cam_from_world.apply(torch.cat([rays * baseline * 5, rays * baseline * 50]))
    x_two = to_homogeneous(X[:, :2] / X[:, 2:]) @ two.K.T
    lines = epipolar_lines(shift_origin(F, 1.0), torch.cat([x, x]))
    distance = (lines * x_two).sum(-1).abs().median()
    if not distance < 1:
        raise source.fail(
            "FundamentalMatrix",
            f"contradicts the pose of camera 2 by {distance:.3g} px; "
            "is the rotation transposed, or the pose inverted?",
        )
