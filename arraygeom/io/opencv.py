"""OpenCV FileStorage (YAML, XML or JSON): one camera, or a stereo pair in one file or two; MC-Calib,
EasyMocap.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; X_2 = R X_1 + T, so the world
is camera 1; lengths in the unit of the calibration board, taken as metres. OpenCV's stereo sample writes
`intrinsics.yml` (M1 D1 M2 D2) and `extrinsics.yml` (R T ...): name either, or their folder. It states no
image size. EasyMocap's `intri.yml` and `extri.yml` are world->camera; MC-Calib's `camera_pose_matrix` is
camera->reference camera, inverted.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..camera import Camera
from ..distortion import KANNALA_BRANDT
from ..pixels import HW
from ..pose import Pose
from ..rig import Rig
from ..runtime.extras import needs
from ..runtime.safe_yaml import DEEPEST, LARGEST_TEXT
from .export import brown_conrady, calibrated, focal_and_centre
from .source import K_NAME, LENS_NAME, R_NAME, T_NAME, Entry, RigSource, plain, pose_of

MOST_NUMBERS = 10_000
"""Largest number of numbers of a matrix; a file may state any."""
PARTS = ("intri", "extri")


def recognises(path: Path, head: str) -> bool:
    """Return True for a text of OpenCV's FileStorage, or a folder with a pair's files."""
    if path.is_dir():
        return any(_named(path, kind) for kind in PARTS)
    return "opencv-matrix" in head or "opencv_storage" in head or '"type_id": "opencv' in head


def read(source: RigSource) -> Rig:
    """Read one camera "camera" at the origin, a stereo pair "left" and "right", or cameras named in the file.

    Raises:
        RigFileError: for a damaged file, half a pair, or cameras without a common frame.
    """
    entries: dict[str, Any] = {}
    for path in _files(source.path):
        entries |= _nodes(source.beside(path))
    nodes = source.at(entries).mapping()
    if "nb_camera" in nodes:
        numbers = range(int(nodes["nb_camera"].number()))
        return source.rig((f"camera_{i}", _of_group(nodes[f"camera_{i}"])) for i in numbers)
    if isinstance(names := nodes.value.get("names"), list):
        return source.rig((str(name), _named_camera(nodes, plain(name))) for name in names)
    R, t = nodes.find(R_NAME), nodes.find(T_NAME)
    if nodes.find(K_NAME, "2").value is None:
        if R.value is not None and t.value is not None and nodes.find(K_NAME).value is None:
            raise source.fail(
                "M1", "is missing: a pair's R and T are here without its intrinsics.yml beside them"
            )
        name = str(nodes.get("camera_name", "camera").value)
        return source.rig([(name, _camera(nodes, "", Pose.identity()))])
    if R.value is None or t.value is None:
        raise source.fail("R, T", "are missing: put the pair's extrinsics.yml beside its intrinsics.yml")
    poses = Pose.identity(), pose_of(R, t)
    names = [str(nodes.get(f"name{i}", default).value) for i, default in ((1, "left"), (2, "right"))]
    return source.rig((name, _camera(nodes, i, pose)) for i, name, pose in zip("12", names, poses))


def write(rig: Rig) -> str | dict[str, str]:
    """Format one camera as a file; two as `intrinsics.yml` and `extrinsics.yml` of a folder, with camera 1 as
    the world.

    Returns:
        A text, or texts by file name.

    Raises:
        ValueError: for more cameras, and for what the format cannot hold.
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


_NESTED_IN_LINE = rf"(?<![^\s,])(?:-[ \t]+|[^\s,:]{{1,80}}:[ \t]+){{{DEEPEST}}}"
_HEADER = "%YAML:1.0\n---\n"


def _camera(nodes: Entry, i: str, pose: Pose) -> Camera:
    entry = nodes.find(K_NAME, i)
    if entry.value is None:
        raise nodes.fail(f"has no camera_matrix{i}, nor K{i} or M{i}")
    K = entry.intrinsics()
    lens = nodes.find(LENS_NAME, i).of_model(nodes.model(i))
    return Camera(K=K, cam_from_world=pose, hw=_size(nodes, i, K), distortion=lens)


def _of_group(fields: Entry) -> Camera:
    """Read a camera of MC-Calib's; its pose takes the camera's points into the group's reference camera."""
    K, pose = fields["camera_matrix"].intrinsics(), fields["camera_pose_matrix"].pose_matrix().inverse()
    if fields.get("camera_group", 0).number():
        raise fields["camera_group"].fail("is not 0: cameras of several groups have no common frame")
    lens = fields["distortion_vector"].of_model(fields["distortion_type"])
    return Camera(K=K, cam_from_world=pose, hw=fields.sized("img_width", "img_height", K=K), distortion=lens)


def _named_camera(nodes: Entry, name: str) -> Camera:
    """Read a camera of EasyMocap's intri.yml and extri.yml."""
    K, matrix_R, vector_R, t = (nodes.find(kind + name) for kind in ("k", "rot", "r", "t"))
    R = vector_R if matrix_R.value is None else matrix_R
    if K.value is None or R.value is None or t.value is None:
        raise nodes.fail(f"has not all of K_{name}, R_{name}, T_{name}: put extri.yml beside intri.yml")
    matrix, lens = K.intrinsics(), nodes.find(LENS_NAME + name).of_model(nodes.model())
    w, h = nodes.find("w" + name), nodes.find("h" + name)
    stated = w.value is not None and h.value is not None
    hw = (
        nodes.at([w.value, h.value], f"W_{name}, H_{name}").size()
        if stated
        else nodes.source.size_unstated(matrix)
    )
    return Camera(K=matrix, cam_from_world=pose_of(R, t), hw=hw, distortion=lens)


def _size(nodes: Entry, i: str, K: Tensor) -> HW:
    for suffix in (i, ""):
        for width, height in (("image_width", "image_height"), ("image_Width", "image_Height")):
            if f"{width}{suffix}" in nodes and f"{height}{suffix}" in nodes:
                return nodes.listed(f"{width}{suffix}", f"{height}{suffix}").size()
        for name in ("image_size", "imageSize", "size"):
            if f"{name}{suffix}" in nodes:
                return nodes[f"{name}{suffix}"].size()
    return nodes.source.size_unstated(K)


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


def _nodes(source: RigSource) -> dict[str, Any]:
    """Return the outermost entries by name.

    Raises:
        RigFileError: for a file that OpenCV cannot read.
    """
    text = source.text(LARGEST_TEXT)
    with needs("calibration", "reading OpenCV's files"):
        import cv2
    _check_nesting(source, text)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        return {name: _value(root.getNode(name)) for name in root.keys()}  # noqa: SIM118
    except (cv2.error, SystemError):
        raise source.fail(
            None, "is not an OpenCV FileStorage (YAML, XML or JSON); is the file whole?"
        ) from None


def _check_nesting(source: RigSource, text: str) -> None:
    """Raise RigFileError for files that nest deeply: OpenCV's parsers recurse without a limit, and crash."""
    depth = 0
    # Tags, brackets, and what nests within a line of YAML: "- - - 1" and "a: b: c: 1".
    for token in re.finditer(r"<(/?)[\w!?](?:[^<>]*?(/?)>)?|[\[{]|[\]}]", text):
        mark = token[0]
        if mark in "]}" or token[1]:
            depth -= 1
        elif mark in "[{" or not (token[2] or mark[1] in "!?"):
            depth += 1
        if depth > DEEPEST:
            raise source.fail(
                f"line {text.count(chr(10), 0, token.start()) + 1}", f"is nested more than {DEEPEST} deep"
            )
    if re.search(_NESTED_IN_LINE, text):
        raise source.fail(None, f"is nested more than {DEEPEST} deep in a line")


def _value(node: Any) -> Any:
    if node.isString():
        return node.string()
    if node.isInt() or node.isReal():
        return node.real()
    if node.isSeq():
        return [_value(node.at(i)) for i in range(node.size())]
    if node.isMap() and node.getNode("data").empty():
        return {name: _value(node.getNode(name)) for name in node.keys()}  # noqa: SIM118
    if node.isMap():
        data = node.getNode("data")  # one by one: mat() takes whole numbers' bits for those of real ones
        numbers = _value(data) if data.size() <= MOST_NUMBERS else None
        return numbers if isinstance(numbers, list | None) else [numbers]
    return None


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
