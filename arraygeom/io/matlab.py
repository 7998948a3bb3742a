"""MATLAB's stereoParameters and cameraParameters: the struct (`toStruct`) in .mat, or JSON (`jsonencode`).

Source convention: pixels with the first centre at 1 (shift -1); OpenCV-like axes; lengths in `WorldUnits`, by
default millimetres. The old names are of row vectors (x2 = x1 R + t, [x y 1] ~ X K): `IntrinsicMatrix` and
`RotationOfCamera2` are transposed. The new ones (`K`, `PoseCamera2`, since R2022b) are of columns and are
not. The world is camera 1. A `FundamentalMatrix` in the file has to agree with the pose: that catches a
transposed one.

Fisheyes: the struct of fisheyeIntrinsics or fisheyeParameters, a camera "camera1" (Scaramuzza's model). A
point u, v off `DistortionCenter`, after `StretchMatrix` is undone, is seen along (u, v, a0 + a2 r^2 + a3 r^3
+ a4 r^4); a0 is the focal length here.

Written by: MATLAB's Computer Vision Toolbox, names of before and since R2022b, .mat of version 5 to 7, JSON;
fisheyes.
Refused: objects in place of structs; version 7.3; an F that contradicts the pose.
Sample: hand-written: matlab_old.json, matlab_new.json, matlab_fisheye.json.
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
from .source import Entry, RigSource, pose_of

FISHEYE = "MappingCoefficients"
METRES = {
    1e-3: ("mm", "millimeters", "millimetres"),
    1e-2: ("cm", "centimeters", "centimetres"),
    1.0: ("m", "meters", "metres"),
    0.0254: ("in", "inches"),
}
UNITS = {name: metres for metres, names in METRES.items() for name in names}


def recognises(path: Path, head: str) -> bool:
    """Return True for a MAT-file, or a text with MATLAB's names of parameters in its first characters `head`.

    The file is not opened: one with suffix .mat counts whatever it holds.
    """
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
    """Read the pair "camera1" and "camera2" in metres from the first, or a single "camera1" at the origin.

    A size that is not stated is the requested one, else guessed, with a warning.

    Raises:
        RigFileError: for a damaged file, a MATLAB object in place of a struct, unknown units, or a
            fundamental matrix that contradicts the pose.
        ImportError: without scipy, for a MAT-file.
    """
    fields = _outermost(source)
    if "CameraParameters1" not in fields:
        return source.rig([("camera1", _camera(fields, Pose.identity()))])
    poses = Pose.identity(), _pose(fields)
    cameras = [_camera(fields[f"CameraParameters{i}"], pose) for i, pose in enumerate(poses, 1)]
    if (F := fields.get("FundamentalMatrix")).value is not None:
        _check_fundamental(F, *cameras)
    return source.rig(zip(("camera1", "camera2"), cameras))


def _outermost(source: RigSource) -> Entry:
    """Return the struct itself, or the first variable of the file that holds one."""
    is_text = source.path.suffix != ".mat" and not source.content().startswith(b"MATLAB ")
    fields = source.json().value if is_text else load_variables(source)
    second = any(name.endswith("Camera2") or name == "CameraParameters2" for name in fields)
    for value in (fields,) if second else (fields, *fields.values()):
        if isinstance(value, dict) and ("CameraParameters1" in value or _is_camera(value)):
            return source.at(value)
    raise source.fail(
        "CameraParameters1",
        "is missing, and the second camera's is here; is the file whole?"
        if second
        else "is missing: MATLAB objects cannot be read, save the struct, "
        "s = toStruct(stereoParams); save(f, 's', '-v7')",
    )


def _is_camera(fields: dict[str, Any]) -> bool:
    return bool(fields.keys() & {"IntrinsicMatrix", "K", FISHEYE}) or _is_fisheye(fields.get("Intrinsics"))


def _is_fisheye(fields: Any) -> bool:
    return isinstance(fields, dict) and FISHEYE in fields


def _camera(fields: Entry, pose: Pose) -> Camera:
    fisheye = fields["Intrinsics"] if _is_fisheye(fields.get("Intrinsics").value) else fields
    if FISHEYE in fisheye:
        K, lens = _fisheye(fisheye)
        return Camera(K=K, cam_from_world=pose, hw=_size(fisheye, K), distortion=lens)
    fields.use("WorldUnits")  # of the board's poses
    stated = fields["K", "IntrinsicMatrix"]
    K = (stated if "K" in fields else stated.transposed(3)).intrinsics(first_pixel=1.0)
    return Camera(K=K, cam_from_world=pose, hw=_size(fields, K), distortion=_lens(fields))


def _fisheye(fields: Entry) -> tuple[Tensor, Distortion | None]:
    a0, a2, a3, a4 = fields[FISHEYE].numbers((4,)).tolist()
    if not a0 > 0:
        raise fields[FISHEYE].fail(f"begins with {a0:g}; it is positive, about the focal length in pixels")
    K = torch.eye(3, dtype=torch.float64)
    K[:2, :2] = fields.get("StretchMatrix", [[1, 0], [0, 1]]).numbers((2, 2)) * a0
    K[:2, 2] = fields["DistortionCenter"].numbers((2,))
    lens = fields.at([a2 * a0, a3 * a0**2, a4 * a0**3], FISHEYE).lens(SCARAMUZZA)
    return fields.at(K, "StretchMatrix").intrinsics(first_pixel=1.0), lens


def _size(fields: Entry, K: Tensor) -> HW:
    size = fields.get("ImageSize")
    if size.value is None or np.size(size.value) == 0:
        return fields.source.size_unstated(K)
    return fields.at(size.numbers((2,)).flip(0), "ImageSize").size()


def _lens(fields: Entry) -> Distortion | None:
    if not any(f"{kind}Distortion" in fields for kind in ("Radial", "Tangential")):
        raise fields.fail("has no RadialDistortion: state it, [0 0] of an undistorted image")
    radial, tangential = (
        fields.get(f"{kind}Distortion", []).numbers().tolist() for kind in ("Radial", "Tangential")
    )
    if not radial and not tangential:
        return None
    if len(radial) not in (2, 3) or len(tangential) not in (0, 2):
        raise fields.fail("has no 2 or 3 numbers of RadialDistortion and 2 of TangentialDistortion")
    c = [*radial[:2], *(tangential or [0.0, 0.0]), *radial[2:]]
    return fields.at(c, "RadialDistortion").brown_conrady()


def _pose(fields: Entry) -> Pose:
    """Read the pose X_2 = R X_1 + t, in metres."""
    unit = str(fields.get("WorldUnits").value or "mm").strip().lower()
    if unit not in UNITS:
        raise fields["WorldUnits"].fail(f"is '{unit}'; known: {', '.join(UNITS)}")
    if "PoseCamera2" not in fields:
        R = fields["RotationOfCamera2"].transposed(3)
        return pose_of(R, fields["TranslationOfCamera2"], metres=UNITS[unit])
    pose = fields["PoseCamera2"]
    if "A" in pose:
        return pose["A"].pose_matrix(metres=UNITS[unit])
    return pose_of(pose["R", "Rotation"], pose["Translation"], metres=UNITS[unit])


def _check_fundamental(F: Entry, one: Camera, two: Camera) -> None:
    """Check that points both pinholes see are on the lines of F as stated, which is of pixels counted from 1.

    Raises:
        RigFileError: if their median distance is a pixel or more.
    """
    h, w = one.hw
    x = pixel_grid((4, 4), dtype=torch.float64).reshape(-1, 2) * torch.tensor([w / 4, h / 4])
    baseline = two.centre.norm()
    rays = to_homogeneous(x) @ torch.linalg.inv(one.K).T
    X = two.cam_from_world.apply(torch.cat([rays * baseline * 5, rays * baseline * 50]))
    x_two = to_homogeneous(X[:, :2] / X[:, 2:]) @ two.K.T
    lines = epipolar_lines(shift_origin(F.numbers((3, 3)), 1.0), torch.cat([x, x]))
    distance = (lines * x_two).sum(-1).abs().median()
    if not distance < 1:
        raise F.fail(
            f"contradicts the pose of camera 2 by {distance:.3g} px; "
            "is the rotation transposed, or the pose inverted?"
        )
