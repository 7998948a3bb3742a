"""Middlebury's calib.txt (2014 and 2021 stereo sets).

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; rectified, with cam1 at
`baseline` millimetres to the right of cam0; Z = baseline f / (d + doffs), with doffs the difference of the
principal points. Where the file states the range of disparities (vmin, vmax), the rig's depth range follows
from it.
"""

from __future__ import annotations

import re
from pathlib import Path

from torch import Tensor

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import RigSource

CONVENTION = "first pixel's centre at 0 (shift 0); rectified, cam1 at +baseline along x; millimetres"


def recognises(path: Path, head: str) -> bool:
    return re.search(r"^cam0\s*=\s*\[", head, re.MULTILINE) is not None


def read(source: RigSource) -> Rig:
    """The pair cam0, cam1."""
    entries = _entries(source)
    Ks = [source.intrinsics(source.get(entries, name, ""), name) for name in ("cam0", "cam1")]
    width, height, baseline = (
        source.number(source.get(entries, k, ""), k) for k in ("width", "height", "baseline")
    )
    if baseline <= 0:
        raise source.fail("baseline", f"is {baseline:g}; it is positive, in millimetres")
    doffs = source.number(entries.get("doffs", Ks[1][0, 2] - Ks[0][0, 2]), "doffs")
    if abs(doffs - float(Ks[1][0, 2] - Ks[0][0, 2])) > 0.5:
        raise source.fail("doffs", f"is {doffs:g}, which is not the difference of the principal points")
    hw = source.size(width, height, "width, height")
    first, metres = Pose.identity(), baseline * 1e-3
    poses = first, Pose(first.R, first.t.new_tensor([-metres, 0.0, 0.0]))
    cameras = [Camera(K=K, cam_from_world=pose, hw=hw) for K, pose in zip(Ks, poses)]
    return source.rig(zip(("cam0", "cam1"), cameras), depth=_depth(source, entries, Ks[0], metres, doffs))


def _depth(
    source: RigSource, entries: dict[str, Tensor], K: Tensor, baseline: float, doffs: float
) -> tuple[float, float] | None:
    """(near, far) in metres, of the disparities vmax and vmin."""
    if not {"vmin", "vmax"} <= entries.keys():
        return None
    low, high = (source.number(entries[k], k) + doffs for k in ("vmin", "vmax"))
    if not 0 < low <= high:
        return None
    return baseline * float(K[0, 0]) / high, baseline * float(K[0, 0]) / low


def _entries(source: RigSource) -> dict[str, Tensor]:
    entries: dict[str, Tensor] = {}
    for line in source.text().splitlines():
        name, equals, value = (part.strip() for part in line.partition("="))
        if not equals:
            continue
        if name in entries:
            raise source.fail(name, "occurs twice; keep one")
        if value.startswith("[") and not value.endswith("]"):
            raise source.fail(name, "has no closing bracket; is the file whole?")
        entries[name] = source.numbers_in(re.sub("[;,]", " ", value.strip("[] ")), None, name)
    return entries
