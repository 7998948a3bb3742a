"""JSON of K, d, R and t, as pycalib writes: lists over the cameras, or one camera's matrices.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; world->camera; the scale is
arbitrary and taken as metres. No image size is stated. Intrinsics alone are a camera at the origin. Cameras
are named cam0, cam1, ...
"""

from __future__ import annotations

import re
from pathlib import Path

from ..camera import Camera
from ..rig import Rig
from .source import K_NAME, LENS_NAME, R_NAME, T_NAME, Entry, RigSource, plain, pose_of


def recognises(path: Path, head: str) -> bool:
    """Return True for a JSON text with a list named like K."""
    lists = re.findall(r'"([^"\n]{1,60})"\s*:\s*\[', head) if head.lstrip().startswith("{") else []
    return any(re.fullmatch(K_NAME, plain(name)) for name in lists)


def read(source: RigSource) -> Rig:
    """Read all cameras of the lists K, d, R, t; or the one camera.

    Raises:
        RigFileError: for a damaged file, no K, or lists of different lengths.
    """
    document = source.json()
    K, d, R, t = (document.find(name) for name in (K_NAME, LENS_NAME, R_NAME, T_NAME))
    if K.value is None:
        raise source.fail("K", "is missing; is this a JSON of K, d, R and t?")
    single = K.numbers().numel() == 9
    if single and R.value is None and t.value is None:
        R, t = (document.at([0.0, 0.0, 0.0], name) for name in "Rt")
    lists = [[entry] if single else entry.each() for entry in (K, R, t)]
    lists.append([d] * len(lists[0]) if single or not d.value else d.each())
    if len({len(entries) for entries in lists}) > 1:
        counts = "{}, {}, {} and {}".format(*map(len, lists))
        raise source.fail("K, R, t, d", f"have {counts} cameras; they are lists of equal length")
    word = document.model()
    return source.rig((f"cam{i}", _camera(word, *numbers)) for i, numbers in enumerate(zip(*lists)))


def _camera(model: Entry, K: Entry, R: Entry, t: Entry, d: Entry) -> Camera:
    matrix = K.intrinsics()
    hw = model.source.size_unstated(matrix)
    return Camera(K=matrix, cam_from_world=pose_of(R, t), hw=hw, distortion=d.of_model(model))
