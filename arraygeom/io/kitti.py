"""KITTI's calibration: `calib.txt` (rectified) and `calib_cam_to_cam.txt` (raw, or rectified).

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres. P0..P3 act on points of
rectified camera 0, so P = K [I | t] and t = K^-1 P[:, 3]; that has small y and z terms, and t_x = -baseline.
The raw rig (S K D R T) has X_i = R X_0 + T. The rectified file states no image size. Cameras are named
cam0..cam3.

Written by: KITTI 2012, 2015 and raw: rectified cameras, or with `kitti-raw` those before.
Refused: files without P0 or K_00.
Sample: real: calib_cam_to_cam.txt of 2011_09_26, the object benchmark's calibration.
"""

from __future__ import annotations

import re

import torch

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import Entry, RigSource, pose_of

ENTRIES = r"(P|S|K|D|R|T)\d?(_rect)?(_\d\d)?"
"""Pattern of the names of lines that are read; others may be dates, say."""


HEAD = r"(?m)^(P0|P_rect_0\d):"


def read(source: RigSource) -> Rig:
    """Read the rectified cameras: P0..P3 of `calib.txt`, P_rect and S_rect of `calib_cam_to_cam.txt`.

    Returns:
        The rig of cam0, cam1 ..., in metres in the frame of rectified camera 0. Where no image size is
        stated, as in `calib.txt`, it is the one asked for, else twice the principal point, with a warning.

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
    """Reader of the cameras before rectification, in `calib_cam_to_cam.txt`; in `READERS` as a module is."""

    HEAD = r"(?m)^K_0\d:"

    @staticmethod
    def read(source: RigSource) -> Rig:
        """Read the unrectified cameras cam0, cam1 ... from S, K, D, R and T, in metres from camera 0.

        A size that is not stated is the requested one, else guessed, with a warning.

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
        pose, lens = pose_of(entries[f"R_{n}"], entries[f"T_{n}"]), entries[f"D_{n}"].brown_conrady()
        return entries.camera(pose, K=K, hw=entries.sized(f"S_{n}", K=K), distortion=lens)
