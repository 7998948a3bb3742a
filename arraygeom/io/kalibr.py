"""Kalibr camchain files.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; `T_cn_cnm1` takes points of
camera n-1 into camera n, so poses are chained products; metres. The world is camera 0, or the IMU where
every camera states `T_cam_imu`. `timeshift_cam_imu` (t_imu = t_cam + shift) becomes the sensor's time
offset. Camera models pinhole (with radtan, equidistant, fov or no distortion), omni (with radtan or none),
ds and eucm (with none). EuRoC's `sensor.yaml` has the same intrinsics; `T_BS` is camera->body, inverted.

Written by: Kalibr: pinhole, omni, ds, eucm; EuRoC's sensor.yaml and their folders.
Refused: other camera and distortion models; gaps in the chain.
Sample: real: Hilti's five fisheyes; [documented](https://github.com/ethz-asl/kalibr/wiki/yaml-formats).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from ..camera import Camera
from ..distortion import BROWN_CONRADY, KANNALA_BRANDT, Distortion
from ..lenses.central import DOUBLE_SPHERE, EXTENDED_UNIFIED, FOV, UNIFIED
from ..lenses.model import LensModel
from ..pose import Pose
from ..rig import Rig
from ..runtime.safe_yaml import dump_yaml
from ..sensor import Sensor
from .export import at_origin, brown_conrady, calibrated, focal_and_centre
from .source import LENS_NAME, Entry, RigSource, decoded

MODELS: dict[str, tuple[str | None, int, tuple[str, ...]]] = {
    "pinhole": (None, 0, ("radtan", "equidistant", "fov", "none")),
    "omni": (UNIFIED, 1, ("radtan", "none")),
    "ds": (DOUBLE_SPHERE, 2, ("none",)),
    "eucm": (EXTENDED_UNIFIED, 2, ("none",)),
}
"""Lens, number of numbers before the focal lengths, and distortion models, by camera model."""
DISTORTIONS = {"radtan": (BROWN_CONRADY, 4), "equidistant": (KANNALA_BRANDT, 4), "fov": (FOV, 1)}
"""Lens of a pinhole's distortion model, and the number of its coefficients."""
ALSO = ("plumb_bob", "radial-tangential", "fisheye")
"""Distortion models as named by EuRoC and ROS."""
AGAIN = "calibrate again with --models pinhole-radtan, or ds-none for wide angles"


def recognises(path: Path, head: str) -> bool:
    """Return True for a camchain, EuRoC's sensor.yaml, or a folder of these."""
    if path.is_dir():
        return bool(_sensors(path))
    return "T_BS" in head or re.search(r"(?ms)^cam\d+:.*(camera_model|intrinsics)", head) is not None


def read(source: RigSource) -> Rig:
    """Read cameras cam0, cam1, ...; EuRoC's sensor.yaml, or a folder of them, by the names of their folders.

    Lengths are metres. The world is cam0, the IMU if each camera states its place there, or EuRoC's body. A
    size that is not stated is the requested one, else guessed, with a warning.

    Raises:
        RigFileError: for a damaged file, a gap in the chain, or unsupported models.
    """
    if files := _sensors(source.path) if source.path.is_dir() else []:
        return source.rig((file.parent.name, _sensor(source.beside(file).yaml())) for file in files)
    if "T_BS" in source.text():
        return source.rig([(source.path.resolve().parent.name, _sensor(source.yaml()))])
    chain = {name: fields for name, fields in source.yaml().items() if re.fullmatch(r"cam\d+", name)}
    if not chain:
        raise source.fail("cam0", "is missing; is this a Kalibr camchain?")
    names = sorted(chain, key=lambda name: int(name[3:]))
    if names != [f"cam{i}" for i in range(len(names))]:
        raise source.fail(names[-1], f"the chain has a gap: it holds {', '.join(names)}")
    entries = [chain[name].mapping() for name in names]
    return source.rig(zip(names, map(_camera, entries, _poses(entries))))


def _sensors(folder: Path) -> list[Path]:
    """List EuRoC's files of cameras, in a data set's folder or its mav0."""
    files = [file for place in ("", "*/", "mav0/*/") for file in sorted(folder.glob(f"{place}sensor.yaml"))]
    return [file for file in files if "camera" in decoded(file.read_bytes()[:4096])]


def _sensor(fields: Entry) -> Camera:
    """Read a camera of EuRoC's; the world is the body, to which T_BS takes points of the camera."""
    return _camera(fields, fields["T_BS"]["data"].pose_matrix().inverse())


def write(rig: Rig) -> str:
    """Format cameras cam0, cam1, ... in the rig's order, with their names in `rostopic`.

    Kalibr's chain has no world: if cam0 is not at the origin, the world is written as the IMU. Depth range,
    links, and of sensors all but the time offset are left out.

    Returns:
        The text of a YAML file.

    Raises:
        ValueError: for no cameras, uncalibrated ones, batches, and a K or lens that the format cannot hold.
    """
    cameras = calibrated(rig, "Kalibr")
    has_imu = not at_origin(cameras[0][1].cam_from_world)
    document, before = {}, None
    for i, (name, camera) in enumerate(cameras):
        entry = _entry(name, camera)
        pose = camera.cam_from_world
        if before is not None:
            entry["T_cn_cnm1"] = (pose @ before.inverse()).matrix.tolist()
        if has_imu:
            entry["T_cam_imu"] = pose.matrix.tolist()
        if camera.sensor.time_offset:
            entry["timeshift_cam_imu"] = camera.sensor.time_offset
        document[f"cam{i}"], before = entry, pose
    return dump_yaml(document, default_flow_style=None)


def _poses(chain: list[Entry]) -> list[Pose]:
    """Return poses of the cameras from camera 0, or from the IMU if all of them state that."""
    if all("T_cam_imu" in fields for fields in chain):
        return [fields["T_cam_imu"].pose_matrix() for fields in chain]
    poses = [Pose.identity()]
    for fields in chain[1:]:
        poses.append(fields["T_cn_cnm1"].pose_matrix() @ poses[-1])
    return poses


def _camera(fields: Entry, pose: Pose) -> Camera:
    model, listed = fields["camera_model"], fields["intrinsics"]
    if model.value not in MODELS:
        raise model.fail(f"is '{model.value}'; supported: {', '.join(MODELS)}: {AGAIN}")
    first = MODELS[model.value][1]
    numbers = listed.numbers((first + 4,))
    K = fields.at(numbers[first:], "intrinsics").focal_and_centre()
    lens = _lens(model.value, numbers[:first].tolist(), fields)
    sensor = Sensor(time_offset=fields.get("timeshift_cam_imu", 0.0).number())
    return fields.camera(pose, K=K, distortion=lens, sensor=sensor)


def _lens(camera: str, before: list[float], fields: Entry) -> Distortion | None:
    """Read the lens of a camera model, by the numbers `before` focal lengths, and a distortion model."""
    lens, _, supported = MODELS[camera]
    model = fields.get("distortion_model")
    coefficients = fields.find(LENS_NAME)
    if model.value in (None, *ALSO) and camera == "pinhole":
        return coefficients.of_model(model)
    if (model.value or "none") not in supported:
        raise model.fail(f"is '{model.value}'; supported for {camera}: {', '.join(supported)}: {AGAIN}")
    bent, count = DISTORTIONS.get(model.value, (None, 0))
    if not count and coefficients.value is not None and coefficients.numbers().any():
        raise coefficients.fail("has coefficients, and distortion_model names none of them: state it")
    if count and coefficients.value is None:
        raise fields.fail(f"has distortion_model {model.value} and no distortion_coeffs")
    c = coefficients.numbers((count,)).tolist() if count else []
    if lens is not None:
        c = [0.0] * 4 if lens == UNIFIED and not c else c
        return fields.at([*before, *c], "intrinsics").lens(lens)
    return None if bent is None else fields.at(c, "distortion_coeffs").lens(bent)


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
    """Return camera model, the numbers before its focal lengths, distortion model and coefficients."""
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
