"""Luxonis' calibration of an OAK camera: the JSON that DepthAI writes from a device's memory.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes and lenses; each camera's
`extrinsics` take points of that camera into another one's (`toCameraSocket`), in centimetres; intrinsics are
of the stated size. The world is the first camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import RigSource

CONVENTION = (
    "first pixel's centre at 0 (shift 0); "
    "extrinsics to another camera of the box, in centimetres; world = first"
)
PERSPECTIVE, FISHEYE = 0, 1
CENTIMETRES = 1
"""What a `lengthUnit`, if there is one, may be."""
SOCKETS = "ABCDEFGHIJ"


def recognises(path: Path, head: str) -> bool:
    return '"cameraData"' in head or ('"boardName"' in head and '"boardRev"' in head)


def read(source: RigSource) -> Rig:
    """The calibrated cameras by their sockets: "CAM_A" (colour on most), "CAM_B", "CAM_C", ..."""
    listed = source.get(source.json(), "cameraData", "")
    entries: dict[int, dict[str, Any]] = {}
    for item in listed if isinstance(listed, list) else []:
        if not isinstance(item, list) or len(item) != 2:
            raise source.fail("cameraData", "is not a list of [socket, camera]; is the file whole?")
        socket = int(source.number(item[0], "cameraData socket"))
        if not 0 <= socket < len(SOCKETS) or socket in entries:
            raise source.fail(
                "cameraData", f"has socket {socket} twice, or a socket that no board has; keep one"
            )
        entry = source.mapping(item[1], _name(socket))
        if entry.get("width") and entry.get("height"):  # others are not calibrated
            entries[socket] = entry
    if not entries:
        raise source.fail("cameraData", "holds no calibrated camera; is the file whole?")
    root, first_to_root = _to_root(source, entries, min(entries))
    cameras = []
    for socket in sorted(entries):
        own_root, to_root = _to_root(source, entries, socket)
        if own_root != root:
            raise source.fail(
                _name(socket), f"is related to no camera that {_name(min(entries))} is related to"
            )
        cameras.append(
            (
                _name(socket),
                _camera(source, entries[socket], _name(socket), to_root.inverse() @ first_to_root),
            )
        )
    return source.rig(cameras)


def _name(socket: int) -> str:
    return f"CAM_{SOCKETS[socket]}"


def _to_root(source: RigSource, entries: dict[int, dict[str, Any]], socket: int) -> tuple[int, Pose]:
    """The camera that a chain of extrinsics ends at, and its points from the first camera's."""
    pose, passed = Pose.identity(), [socket]
    while True:
        name = _name(passed[-1])
        extrinsics = entries[passed[-1]].get("extrinsics") or {}
        to = int(source.number(extrinsics.get("toCameraSocket", -1), f"{name}.toCameraSocket"))
        if to not in entries:  # -1 of the last one
            return passed[-1], pose
        if to in passed:
            raise source.fail(f"{name}.toCameraSocket", f"is {to}: the chain of extrinsics is a circle")
        if extrinsics.get("lengthUnit", CENTIMETRES) != CENTIMETRES:
            raise source.fail(
                f"{name}.lengthUnit", f"is {extrinsics['lengthUnit']}; centimetres (1) are read"
            )
        shift = source.mapping(source.get(extrinsics, "translation", name), f"{name}.translation")
        t = [source.get(shift, axis, f"{name}.translation") for axis in "xyz"]
        step = source.pose(source.get(extrinsics, "rotationMatrix", name), t, name, metres=0.01)
        pose, passed = step @ pose, [*passed, to]


def _camera(source: RigSource, entry: dict[str, Any], name: str, pose: Pose) -> Camera:
    kind, lens = entry.get("cameraType", PERSPECTIVE), entry.get("distortionCoeff") or []
    if kind not in (PERSPECTIVE, FISHEYE):
        raise source.fail(f"{name}.cameraType", f"is {kind}; perspective (0) and fisheye (1) are read")
    entered = f"{name}.distortionCoeff"
    if kind == FISHEYE:  # padded with zeros to fourteen numbers by some versions
        numbers = source.numbers(lens, None, entered)
        lens = numbers[:4] if not bool(torch.count_nonzero(numbers[4:])) else numbers
    return Camera(
        K=source.intrinsics(source.get(entry, "intrinsicMatrix", name), f"{name}.intrinsicMatrix"),
        cam_from_world=pose,
        hw=source.size(entry["width"], entry["height"], f"{name}.width, height"),
        distortion=(source.kannala_brandt if kind == FISHEYE else source.brown_conrady)(lens, entered),
    )
