"""transforms.json of nerfstudio and instant-ngp.

Source convention: pixels with the first centre at 0.5 (shift -0.5); OpenGL axes (y up, optical axis -z),
rotated into ours; `transform_matrix` is camera->world, inverted; the scale is the file's own, taken as
metres. Intrinsics may stand at the top or in each frame.

Written by: nerfstudio (k1 ... or distortion_params), instant-ngp, NeRF's synthetic scenes (with --size).
Refused: equirectangular and other models; a perspective k4.
Sample: real: instant-ngp's fox; [documented](https://docs.nerf.studio/quickstart/data_conventions.html).
"""

from __future__ import annotations

import json
import math
from collections import ChainMap
from typing import Any

import torch

from ..camera import Camera
from ..distortion import KANNALA_BRANDT, Distortion
from ..pose import Pose
from ..rig import Rig
from .export import brown_conrady, calibrated, focal_and_centre
from .source import Entry, RigSource

FISHEYES = ("OPENCV_FISHEYE", "FISHEYE")
PERSPECTIVES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
# Ours (y down, z forward) from OpenGL's (y up, z back).
FLIP = Pose(
    torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)), torch.zeros(3, dtype=torch.float64)
)


HEAD = '"(transform_matrix|fl_x|camera_angle_x)"'


def read(source: RigSource) -> Rig:
    """Read one camera for each frame, named by its `file_path`, in the file's scale, taken as metres.

    A size not stated is the requested one, else guessed by a stated focal length and centre, with a warning.

    Raises:
        RigFileError: for a damaged file, an unsupported lens, equal names, or no size.
    """
    document = source.json()
    frames, shared = document["frames"].each(), document.value
    cameras = []
    for frame in frames:
        fields = Entry(source, ChainMap(frame.mapping().value, shared), frame.name)
        cameras.append((str(fields["file_path"].value), _camera(fields)))
    return source.rig(cameras)


def write(rig: Rig) -> str:
    """Format a transforms.json with intrinsics in each frame.

    Depth range, links and sensors are left out.

    Returns:
        The text of the file.

    Raises:
        ValueError: for no cameras, uncalibrated ones, batches, and a K or lens that the format cannot hold.
    """
    frames = [_frame(name, camera) for name, camera in calibrated(rig, "nerfstudio")]
    return json.dumps({"frames": frames}, indent=1) + "\n"


def _camera(fields: Entry) -> Camera:
    stated = [fields.get(f"fl_{axis}", fields.get("fl_x").value).value for axis in "xy"]
    centre = [fields.get(key).value for key in ("cx", "cy")]
    known = None not in (*stated, *centre)
    K = fields.at([*stated, *centre], "fl_x, fl_y").focal_and_centre(first_pixel=0.5) if known else None
    h, w = fields.sized("w", "h", K=K)
    fx = _focal(fields, "x", w)
    fy = _focal(fields, "y", h) if "fl_y" in fields or "camera_angle_y" in fields else fx
    centre = [fields.get(k, n / 2).number() for k, n in (("cx", w), ("cy", h))]
    K = fields.at([fx, fy, *centre], "fl_x, fl_y").focal_and_centre(first_pixel=0.5)
    pose = FLIP @ fields["transform_matrix"].pose_matrix().inverse()
    return Camera(K=K, cam_from_world=pose, hw=(h, w), distortion=_lens(fields))


def _focal(fields: Entry, axis: str, size: int) -> float:
    """Return the stated focal length, or that of the field of view in radians."""
    stated = fields[f"fl_{axis}", f"camera_angle_{axis}"]
    if fields.get(f"fl_{axis}").value is not None:
        return stated.number()
    angle = stated.number()
    if not 0 < angle < math.pi:
        raise stated.fail(f"is {angle:g}; wanted radians between 0 and pi")
    return size / 2 / math.tan(angle / 2)


def _lens(fields: Entry) -> Distortion | None:
    model = fields.get("camera_model", "OPENCV")
    name = str(model.value).upper()
    if name not in FISHEYES + PERSPECTIVES:
        raise model.fail(f"is {name}; supported: {', '.join(PERSPECTIVES + FISHEYES)}")
    value = {k: fields.get(k, 0.0).number() for k in ("k1", "k2", "p1", "p2", "k3", "k4")}
    if (listed := fields.get("distortion_params")).value is not None:
        value |= dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), listed.numbers((6,)).tolist()))
    if fields.get("is_fisheye").value or name in FISHEYES:
        if value["p1"] or value["p2"]:
            raise fields.at(None, "p1, p2").fail("are not 0, and a fisheye of this format has none")
        return fields.at([value[k] for k in ("k1", "k2", "k3", "k4")], "k1").kannala_brandt()
    if value["k4"] != 0:
        raise fields["k4"].fail("is the r^8 term of a perspective lens, which OpenCV's model does not have")
    return fields.at(list(value.values())[: 5 if "k3" in fields or value["k3"] else 4], "k1").brown_conrady()


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
    return fields | {"transform_matrix": world_from_gl.matrix.tolist()}
