"""JSON of K, d, R and t, as pycalib writes: lists over the cameras, or one camera's matrices.

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; world->camera; the scale is
arbitrary and taken as metres. No image size is stated. Cameras are named cam0, cam1, ...
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..camera import Camera
from ..rig import Rig
from .source import RigSource

CONVENTION = "first pixel's centre at 0 (shift 0); world->camera; scale as in the file"


def recognises(path: Path, head: str) -> bool:
    return head.lstrip().startswith("{") and '"K"' in head


def read(source: RigSource) -> Rig:
    """All cameras of the lists K, d, R, t; or the one camera."""
    document = source.json()
    K, R, t = (source.get(document, key, "") for key in ("K", "R", "t"))
    d = document.get("d")
    single = source.numbers(K, None, "K").numel() == 9 and len(K) == 3
    Ks, Rs, ts, ds = ([K], [R], [t], [d]) if single else (K, R, t, d or [None] * len(K))
    if not len(Ks) == len(Rs) == len(ts) == len(ds):
        counts = f"{len(Ks)}, {len(Rs)}, {len(ts)} and {len(ds)}"
        raise source.fail("K, R, t, d", f"have {counts} cameras; they are lists of equal length")
    return source.rig(
        (f"cam{i}", _camera(source, i, *numbers)) for i, numbers in enumerate(zip(Ks, Rs, ts, ds))
    )


def _camera(source: RigSource, i: int, K: Any, R: Any, t: Any, d: Any) -> Camera:
    matrix = source.intrinsics(K, f"K[{i}]")
    pose, lens = source.pose(R, t, f"[{i}]"), source.brown_conrady(d, f"d[{i}]")
    return Camera(K=matrix, cam_from_world=pose, hw=source.size_unstated(matrix), distortion=lens)
