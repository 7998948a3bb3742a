"""Kalibr camchain files.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; `T_cn_cnm1` takes points of
camera n-1 into camera n, so poses are chained products; metres. The world is camera 0, or the IMU where every
camera states `T_cam_imu`. `timeshift_cam_imu` (t_imu = t_cam + shift) becomes the sensor's time offset.
Camera models pinhole (with radtan, equidistant, fov or no distortion), omni (with radtan or none), ds and
eucm (with none).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch
import yaml

from ..camera import Camera
from ..distortion import BROWN_CONRADY, KANNALA_BRANDT, Distortion
from ..lenses.central import DOUBLE_SPHERE, EXTENDED_UNIFIED, FOV, UNIFIED
from ..lenses.model import LensModel
from ..pose import Pose
from ..rig import Rig
from ..sensor import Sensor
from .export import brown_conrady, calibrated, focal_and_centre, pose_rows
from .source import RigSource

CONVENTION = "first pixel's centre at 0 (shift 0); T_cn_cnm1 chained, world = cam0 (or the IMU); metres"

CAMERA_MODELS = {"pinhole": (), "omni": ("xi",), "ds": ("xi", "alpha"), "eucm": ("alpha", "beta")}
"""And what stands before the focal lengths in `intrinsics`."""
LENSES = {
    "pinhole": ("radtan", "equidistant", "fov", "none"),
    "omni": ("radtan", "none"),
    "ds": ("none",),
    "eucm": ("none",),
}
AGAIN = "calibrate again with --models pinhole-radtan, or ds-none for wide angles"


def recognises(path: Path, head: str) -> bool:
    return "cam0:" in head and "camera_model" in head


def read(source: RigSource) -> Rig:
    """Cameras cam0, cam1, ..."""
    chain = {name: fields for name, fields in source.yaml().items() if re.fullmatch(r"cam\d+", str(name))}
    if not chain:
        raise source.fail("cam0", "is missing; is this a Kalibr camchain?")
    names = sorted(chain, key=lambda name: int(name[3:]))
    if names != [f"cam{i}" for i in range(len(names))]:
        raise source.fail(names[-1], f"the chain has a gap: it holds {', '.join(names)}")
    poses = _poses(source, {name: source.mapping(chain[name], name) for name in names})
    return source.rig((name, _camera(source, name, chain[name], poses[name])) for name in names)


def write(rig: Rig) -> str:
    """Cameras cam0, cam1, ... in the rig's order, the names stored in `rostopic`.

    Kalibr's chain has no world: if cam0 is not at the origin, the world is written as the IMU.
    Raises ValueError for what the format cannot hold.
    """
    cameras = calibrated(rig, "Kalibr")
    first = cameras[0][1].cam_from_world
    at_origin = pose_rows(first.R, first.t) == torch.eye(4).tolist()
    document, before = {}, None
    for i, (name, camera) in enumerate(cameras):
        entry = _entry(name, camera)
        pose = camera.cam_from_world
        if before is not None:
            relative = pose @ before.inverse()
            entry["T_cn_cnm1"] = pose_rows(relative.R, relative.t)
        if not at_origin:
            entry["T_cam_imu"] = pose_rows(pose.R, pose.t)
        if camera.sensor.time_offset:
            entry["timeshift_cam_imu"] = camera.sensor.time_offset
        document[f"cam{i}"], before = entry, pose
    return yaml.safe_dump(document, default_flow_style=None, sort_keys=False)


def _poses(source: RigSource, chain: dict[str, dict[str, Any]]) -> dict[str, Pose]:
    if all("T_cam_imu" in fields for fields in chain.values()):
        return {n: source.pose_matrix(fields["T_cam_imu"], f"{n}.T_cam_imu") for n, fields in chain.items()}
    poses, pose = {}, Pose.identity()
    for i, (name, fields) in enumerate(chain.items()):
        if i > 0:
            pose = source.pose_matrix(source.get(fields, "T_cn_cnm1", name), f"{name}.T_cn_cnm1") @ pose
        poses[name] = pose
    return poses


def _camera(source: RigSource, name: str, fields: dict[str, Any], pose: Pose) -> Camera:
    model = source.get(fields, "camera_model", name)
    if model not in CAMERA_MODELS:
        raise source.fail(
            f"{name}.camera_model", f"is '{model}'; supported: {', '.join(CAMERA_MODELS)}: {AGAIN}"
        )
    first = len(CAMERA_MODELS[model])
    numbers = source.numbers(source.get(fields, "intrinsics", name), (first + 4,), f"{name}.intrinsics")
    K = source.focal_and_centre(numbers[first:], f"{name}.intrinsics")
    offset = source.number(fields.get("timeshift_cam_imu", 0.0), f"{name}.timeshift_cam_imu")
    return Camera(
        K=K,
        cam_from_world=pose,
        hw=source.size_of(source.get(fields, "resolution", name), f"{name}.resolution"),
        distortion=_lens(source, name, model, numbers[:first].tolist(), fields),
        sensor=Sensor(time_offset=offset),
    )


def _lens(
    source: RigSource, name: str, camera: str, before: list[float], fields: dict[str, Any]
) -> Distortion | None:
    """The lens of a camera model and a distortion model; `before` are the numbers before focal lengths."""
    model, entry = fields.get("distortion_model", "none"), f"{name}.distortion_coeffs"
    if model not in LENSES[camera]:
        known = ", ".join(LENSES[camera])
        raise source.fail(
            f"{name}.distortion_model", f"is '{model}'; supported for {camera}: {known}: {AGAIN}"
        )
    count = {"radtan": 4, "equidistant": 4, "fov": 1, "none": 0}[model]
    c = (
        source.numbers(source.get(fields, "distortion_coeffs", name), (count,), entry).tolist()
        if count
        else []
    )
    if camera == "omni":
        return source.lens(UNIFIED, [*before, *(c or [0.0] * 4)], f"{name}.intrinsics")
    if camera != "pinhole":
        return source.lens(
            DOUBLE_SPHERE if camera == "ds" else EXTENDED_UNIFIED, before, f"{name}.intrinsics"
        )
    lens = {"radtan": BROWN_CONRADY, "equidistant": KANNALA_BRANDT, "fov": FOV, "none": None}[model]
    return None if lens is None else source.lens(lens, c, entry)


def _entry(name: str, camera: Camera) -> dict[str, Any]:
    h, w = camera.hw
    model, before, distortion, c = _spelled(name, camera.distortion)
    return {
        "camera_model": model,
        "intrinsics": [*before, *focal_and_centre(name, camera)],
        "distortion_model": distortion,
        "distortion_coeffs": c,
        "resolution": [w, h],
        "rostopic": f"/{name}/image_raw",
    }


def _spelled(name: str, lens: LensModel | None) -> tuple[str, list[float], str, list[float]]:
    """Camera model, what stands before its focal lengths, distortion model and coefficients."""
    c = [] if lens is None else lens.coefficients.tolist()
    if lens is None:
        return "pinhole", [], "none", []
    if lens.model == UNIFIED:
        return ("omni", c[:1], "radtan", c[1:]) if any(c[1:]) else ("omni", c[:1], "none", [])
    if lens.model in (DOUBLE_SPHERE, EXTENDED_UNIFIED):
        return "ds" if lens.model == DOUBLE_SPHERE else "eucm", c, "none", []
    if lens.model in (FOV, KANNALA_BRANDT):
        return "pinhole", [], "fov" if lens.model == FOV else "equidistant", c
    return "pinhole", [], "radtan", brown_conrady(name, lens, at_most=4)
