"""JSON of K, d, R and t, as pycalib writes: lists over the cameras, or one camera's matrices.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; world->camera; the scale is
arbitrary and taken as metres. No image size is stated. Cameras are named cam0, cam1, ...
"""

from __future__ import annotations

from pathlib import Path

from ..camera import Camera
from ..rig import Rig
from .source import Entry, RigSource, pose_of


def recognises(path: Path, head: str) -> bool:
    return head.lstrip().startswith("{") and '"K"' in head


def read(source: RigSource) -> Rig:
    """All cameras of the lists K, d, R, t; or the one camera."""
    document = source.json()
    K, d = document["K"], document.get("d")
    single = K.numbers().numel() == 9 and len(K.value) == 3
    lists = [[entry] if single else entry.each() for entry in (K, document["R"], document["t"])]
    lists.append([d] * len(lists[0]) if single or not d.value else d.each())
    if len({len(entries) for entries in lists}) > 1:
        counts = "{}, {}, {} and {}".format(*map(len, lists))
        raise source.fail("K, R, t, d", f"have {counts} cameras; they are lists of equal length")
    return source.rig((f"cam{i}", _camera(source, *numbers)) for i, numbers in enumerate(zip(*lists)))


def _camera(source: RigSource, K: Entry, R: Entry, t: Entry, d: Entry) -> Camera:
    matrix = K.intrinsics()
    hw = source.size_unstated(matrix)
    return Camera(K=matrix, cam_from_world=pose_of(R, t), hw=hw, distortion=d.brown_conrady())
