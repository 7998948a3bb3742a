"""KITTI's calibration: `calib.txt` (rectified) and `calib_cam_to_cam.txt` (raw, or rectified).

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres. P0..P3 act on points of
rectified camera 0, so P = K [I | t] and t = K^-1 P[:, 3]; that has small y and z terms, and t_x = -baseline.
The raw rig (S K D R T) has X_i = R X_0 + T. `calib.txt` states no image size. Cameras are named cam0..cam3.
"""

from __future__ import annotations

import re
from pathlib import Path

import torch

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource, pose_of

ENTRIES = r"(P|S|K|D|R|T)\d?(_rect)?(_\d\d)?"
"""Pattern of the names of lines that are read; others may be dates, say."""


def recognises(path: Path, head: str) -> bool:
    """Return True for a text with lines of rectified cameras."""
    return re.search(r"^(P0|P_rect_0\d):", head, re.MULTILINE) is not None


def read(source: RigSource) -> Rig:
    """Read the rectified cameras: P0..P3 of `calib.txt`, P_rect and S_rect of `calib_cam_to_cam.txt`.

    Raises:
        RigFileError: for a damaged file, or one without such a camera.
    """
    entries = source.lines(":", ENTRIES)
    names = [name for name in entries.value if re.fullmatch(r"P\d|P_rect_\d\d", name)]
    if not names:
        raise source.fail("P0", "is missing; is this a KITTI calibration file?")
    return source.rig((f"cam{int(name[-1])}", _rectified(entries, name)) for name in names)


def _rectified(entries: Entry, name: str) -> Camera:
    P, size = entries[name].numbers((3, 4)), name.replace("P_", "S_")
    K = entries.at(P[:, :3], name).intrinsics()
    pose = Pose(torch.eye(3, dtype=torch.float64), torch.linalg.solve(K, P[:, 3]))
    if size != name:  # the raw cameras' lenses are not those of the rectified images
        entries.use(name.replace("P_rect", "D"))
    hw = entries.sized(size, K=K) if size != name else entries.source.size_unstated(K)
    return Camera(K=K, cam_from_world=pose, hw=hw)


class Raw:
    """Reader of the cameras before rectification, in `calib_cam_to_cam.txt`."""

    @staticmethod
    def recognises(path: Path, head: str) -> bool:
        """Return True for a text with lines of raw cameras."""
        return re.search(r"^K_0\d:", head, re.MULTILINE) is not None

    @staticmethod
    def read(source: RigSource) -> Rig:
        """Read the unrectified cameras from S, K, D, R and T.

        Raises:
            RigFileError: for a damaged file, or one without such a camera.
        """
        entries = source.lines(":", ENTRIES)
        numbers = sorted(name[-2:] for name in entries.value if re.fullmatch(r"K_\d\d", name))
        if not numbers:
            raise source.fail("K_00", "is missing; is this KITTI's calib_cam_to_cam.txt?")
        return source.rig((f"cam{int(n)}", Raw._camera(entries, n)) for n in numbers)

    @staticmethod
    def _camera(entries: Entry, n: str) -> Camera:
        K = entries[f"K_{n}"].intrinsics()
        return Camera(
            K=K,
            cam_from_world=pose_of(entries[f"R_{n}"], entries[f"T_{n}"]),
            hw=entries.sized(f"S_{n}", K=K),
            distortion=entries[f"D_{n}"].brown_conrady(),
        )
