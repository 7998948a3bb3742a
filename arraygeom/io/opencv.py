"""OpenCV FileStorage (YAML, XML or JSON): one camera, or a stereo pair in one file or two; MC-Calib,
EasyMocap.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; X_2 = R X_1 + T, so the world
is camera 1; lengths in the unit of the calibration board, taken as metres. OpenCV's stereo sample writes
`intrinsics.yml` (M1 D1 M2 D2) and `extrinsics.yml` (R T ...): name either, or their folder. It states no
image size. EasyMocap's `intri.yml` and `extri.yml` are world->camera; MC-Calib's `camera_pose_matrix` is
camera->reference camera, inverted.

Written by: OpenCV's FileStorage and stereo sample; EasyMocap; MC-Calib.
Refused: half a pair; EasyMocap's intri.yml without extri.yml; MC-Calib's cameras of several groups.
Sample: real: OpenCV's left_intrinsics.yml; hand-written: opencv_stereo, easymocap, mccalib.yml.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..camera import Camera
from ..distortion import KANNALA_BRANDT
from ..rig import Rig
from .export import brown_conrady, calibrated, focal_and_centre
from .source import K_NAME, Entry, RigSource, plain, pose_of
from .usual import cameras_of

PARTS = ("intri", "extri")


def recognises(path: Path, head: str) -> bool:
    """Return True for a text of OpenCV's FileStorage, or a folder with a pair's files."""
    if path.is_dir():
        return any(_named(path, kind) for kind in PARTS)
    return "opencv-matrix" in head or "opencv_storage" in head or '"type_id": "opencv' in head


def read(source: RigSource) -> Rig:
    """Read one camera "camera", a stereo pair "left" (the world) and "right", or cameras named in the file.

    A pair's other file is read from beside its first. One camera without a stated pose is at the origin. A
    size not stated is the requested one, else guessed, with a warning. Lengths are taken as metres.

    Raises:
        RigFileError: for a damaged file, half a pair, or cameras without a common frame.
    """
    entries: dict[str, Any] = {}
    for path in _files(source.path):
        entries |= source.beside(path).document().value
    nodes = source.at(entries)
    if "nb_camera" in nodes:
        numbers = range(int(nodes["nb_camera"].number()))
        return source.rig((f"camera_{i}", _of_group(nodes[f"camera_{i}"])) for i in numbers)
    if isinstance(names := nodes.value.get("names"), list):
        return source.rig((str(name), _named_camera(nodes, plain(name))) for name in names)
    return source.rig(cameras_of(nodes, alone="camera"))


def write(rig: Rig) -> str | dict[str, str]:
    """Format one camera as a file; two as `intrinsics.yml` and `extrinsics.yml` of a folder.

    The world is the first camera: its place is left out, and so are depth range, links and sensors.

    Returns:
        A text, or texts by file name.

    Raises:
        ValueError: for no cameras or more than two, uncalibrated ones, batches, and a K (skewed or mirrored,
            say) or lens that the format cannot hold.
    """
    cameras = calibrated(rig, "OpenCV")
    if len(cameras) == 1:
        return _HEADER + f"camera_name: {_quoted(cameras[0][0])}\n" + _camera_text(*cameras[0], "")
    if len(cameras) != 2:
        raise ValueError(
            f"OpenCV files hold one camera or two and the rig has {len(cameras)}: use the native format"
        )
    (_, one), (_, two) = cameras
    relative = two.cam_from_world @ one.cam_from_world.inverse()
    names = "".join(f"name{i}: {_quoted(name)}\n" for i, (name, _) in enumerate(cameras, 1))
    intrinsics = "".join(_camera_text(name, camera, str(i)) for i, (name, camera) in enumerate(cameras, 1))
    return {
        "intrinsics.yml": _HEADER + names + intrinsics,
        "extrinsics.yml": _HEADER + _matrix_text("R", relative.R) + _matrix_text("T", relative.t[:, None]),
    }


_HEADER = "%YAML:1.0\n---\n"


def _of_group(fields: Entry) -> Camera:
    """Read a camera of MC-Calib's; its pose takes the camera's points into the group's reference camera."""
    if fields.get("camera_group", 0).number():
        raise fields["camera_group"].fail("is not 0: cameras of several groups have no common frame")
    return fields.camera(fields["camera_pose_matrix"].pose_matrix().inverse())


def _named_camera(nodes: Entry, name: str) -> Camera:
    """Read a camera of EasyMocap's intri.yml and extri.yml."""
    matrix_R, vector_R, t = (nodes.find(kind + name) for kind in ("rot", "r", "t"))
    R = vector_R if matrix_R.value is None else matrix_R
    if R.value is None or t.value is None or nodes.find(K_NAME, name).value is None:
        raise nodes.fail(f"has not all of K_{name}, R_{name}, T_{name}: put extri.yml beside intri.yml")
    return nodes.camera(pose_of(R, t), side=name)


def _files(path: Path) -> list[Path]:
    """Return the file, or the two files of a pair."""
    if path.is_dir():
        return [file for kind in PARTS if (file := _named(path, kind))]
    for kind, other in (PARTS, PARTS[::-1]):
        if kind in path.stem and (beside := path.with_name(path.name.replace(kind, other))).exists():
            return [path, beside]
    return [path]


def _named(folder: Path, kind: str) -> Path | None:
    suffixes = (".yml", ".yaml", ".xml", ".json")
    candidates = [folder / f"{kind}{end}{suffix}" for end in ("nsics", "nsic", "") for suffix in suffixes]
    return next((path for path in candidates if path.exists()), None)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _camera_text(name: str, camera: Camera, i: str) -> str:
    fx, fy, cx, cy = focal_and_centre(name, camera)
    lens, (h, w) = camera.distortion, camera.hw
    fisheye = lens is not None and lens.model == KANNALA_BRANDT
    text = f"image_width{i}: {w}\nimage_height{i}: {h}\n" + (f"fisheye_model{i}: 1\n" if fisheye else "")
    text += _matrix_text(
        f"M{i}" if i else "camera_matrix", camera.K.new_tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    )
    c = camera.K.new_tensor([] if fisheye else brown_conrady(name, lens, at_most=14))
    c = (
        lens.coefficients
        if fisheye and lens is not None
        else torch.nn.functional.pad(c, (0, max(0, 5 - len(c))))
    )
    return text + _matrix_text(f"D{i}" if i else "distortion_coefficients", c[None])


def _matrix_text(name: str, M: Tensor) -> str:
    numbers = [repr(x) for x in M.double().flatten().tolist()]
    lines = [", ".join(numbers[i : i + 3]) for i in range(0, len(numbers), 3)]
    rows, columns = M.shape
    data = ",\n       ".join(lines)
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"
