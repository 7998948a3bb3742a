"""Luxonis' calibration of an OAK camera: the JSON that DepthAI writes from a device's memory.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes and lenses; each camera's
`extrinsics` take points of that camera into another one's (`toCameraSocket`), in centimetres; intrinsics are
of the stated size. The world is the first camera.

Written by: DepthAI, from an OAK's memory: perspective and fisheye.
Refused: units other than centimetres, other types; cameras whose K is zeros are left out.
Sample: real: an OAK-D's calib.json.
"""

from __future__ import annotations

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource, pose_of

PERSPECTIVE, FISHEYE = 0, 1
CENTIMETRES = 1
"""Accepted value of a `lengthUnit`, if there is one."""
SOCKETS = "ABCDEFGHIJ"


HEAD = r'(?s)"cameraData"|(?=.*"boardRev").*"boardName"'


def read(source: RigSource) -> Rig:
    """Read the calibrated cameras by their sockets: "CAM_A" (colour on most), "CAM_B", "CAM_C", ...

    The first of them is the world; lengths are metres. Cameras without a size are left out; so are, with a
    warning, those whose K is zeros.

    Raises:
        RigFileError: for a damaged file, no calibrated camera, other sockets, types or units, or extrinsics
            that are circular or relate not all cameras.
    """
    listed = source.json()["cameraData"]
    entries: dict[int, Entry] = {}
    left_out: list[str] = []
    for item in listed.each():
        if not isinstance(item.value, list) or len(item.value) != 2:
            raise listed.fail("is not a list of [socket, camera]; is the file whole?")
        socket = int(item.at(item.value[0], "socket").number())
        if not 0 <= socket < len(SOCKETS) or socket in entries:
            raise listed.fail(f"has socket {socket} twice, or a socket that no board has; keep one")
        entry = source.at(item.value[1], _name(socket))
        if entry.get("width").value and entry.get("height").value:
            if entry["intrinsicMatrix"].value and not entry["intrinsicMatrix"].tensor().any():
                left_out.append(entry.name)
                entry.use()
            else:
                entries[socket] = entry
    if left_out:
        source.warn(f"{', '.join(left_out)}: not calibrated, K is zeros: left out")
    if not entries:
        raise listed.fail("holds no calibrated camera; is the file whole?")
    root, first_to_root = _to_root(entries, min(entries))
    cameras = []
    for socket, entry in sorted(entries.items()):
        own_root, to_root = _to_root(entries, socket)
        if own_root != root:
            raise entry.fail(f"is related to no camera that {_name(min(entries))} is related to")
        cameras.append((entry.name, _camera(entry, to_root.inverse() @ first_to_root)))
    return source.rig(cameras)


def _name(socket: int) -> str:
    return f"CAM_{SOCKETS[socket]}"


def _to_root(entries: dict[int, Entry], socket: int) -> tuple[int, Pose]:
    """Return the camera at which a chain of extrinsics ends, and the pose from this one into it."""
    pose, passed = Pose.identity(), [socket]
    while True:
        extrinsics = entries[passed[-1]].get("extrinsics")
        to = int(extrinsics.get("toCameraSocket", -1).number()) if extrinsics.value else -1
        if to not in entries:  # -1 of the last one
            return passed[-1], pose
        if to in passed:
            raise extrinsics["toCameraSocket"].fail(f"is {to}: the chain of extrinsics is a circle")
        unit = extrinsics.get("lengthUnit", CENTIMETRES)
        if unit.value != CENTIMETRES:
            raise unit.fail(f"is {unit.value}; centimetres (1) are read")
        step = pose_of(extrinsics["rotationMatrix"], extrinsics["translation"].listed(*"xyz"), metres=0.01)
        pose, passed = step @ pose, [*passed, to]


def _camera(entry: Entry, pose: Pose) -> Camera:
    kind, lens = entry.get("cameraType", PERSPECTIVE), entry["distortionCoeff"]
    if kind.value not in (PERSPECTIVE, FISHEYE):
        raise kind.fail(f"is {kind.value}; perspective (0) and fisheye (1) are read")
    return entry.camera(pose, distortion=lens.of_model(kind))
