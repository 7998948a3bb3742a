"""Middlebury's calib.txt (2014 and 2021 stereo sets).

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; rectified, with cam1 at
`baseline` millimetres to the right of cam0; Z = baseline f / (d + doffs), with doffs the difference of the
principal points. Where the file states the range of disparities (vmin, vmax), the rig's depth range follows
from it, to infinity where d + doffs may be 0 or less.

Written by: Middlebury's stereo data of 2014 and 2021.
Refused: doffs that are not the difference of the principal points.
Sample: real: PlaytableP; [documented](https://vision.middlebury.edu/stereo/data/scenes2014/).
"""

from __future__ import annotations

import math

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import RigSource

HEAD = r"(?m)^cam0\s*=\s*\["


def read(source: RigSource) -> Rig:
    """Read the pair cam0 (the world) and cam1, in metres.

    Returns:
        The rig, with the depth range of the stated disparities, to infinity if they reach -doffs; without one
        if they are not stated or give no depth. A size that is not stated is the requested one, else guessed,
        with a warning.

    Raises:
        RigFileError: for a damaged file, a baseline that is not positive, or a contradictory `doffs`.
    """
    entries = source.lines("=", ".*")
    Ks = [entries[name].intrinsics() for name in ("cam0", "cam1")]
    baseline = entries["baseline"].number()
    if baseline <= 0:
        raise source.fail("baseline", f"is {baseline:g}; it is positive, in millimetres")
    apart = float(Ks[1][0, 2] - Ks[0][0, 2])
    doffs = entries.get("doffs", apart).number()
    if abs(doffs - apart) > 0.5:
        raise source.fail("doffs", f"is {doffs:g}, which is not the difference of the principal points")
    hw, metres, first = entries.sized("width", "height", K=Ks[0]), baseline * 1e-3, Pose.identity()
    poses = first, Pose(first.R, first.t.new_tensor([-metres, 0.0, 0.0]))
    cameras = [Camera(K=K, cam_from_world=pose, hw=hw) for K, pose in zip(Ks, poses)]
    depth = None
    if "vmin" in entries and "vmax" in entries:
        low, high = (entries[k].number() + doffs for k in ("vmin", "vmax"))
        scale = metres * float(Ks[0][0, 0])
        if low <= high and high > 0:
            depth = scale / high, scale / low if low > 0 else math.inf
    return source.rig(zip(("cam0", "cam1"), cameras), depth=depth)
