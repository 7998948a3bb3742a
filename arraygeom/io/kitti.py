"""KITTI's calibration: `calib.txt` (rectified) and `calib_cam_to_cam.txt` (raw, or rectified).

Source convention: pixels with the first centre at 0 (shift 0); OpenCV axes; metres. P0..P3 act on points of
rectified camera 0, so P = K [I | t] and t = K^-1 P[:, 3]; that has small y and z terms, and t_x = -baseline.
The raw rig (S K D R T) has X_i = R X_0 + T. `calib.txt` states no image size. Cameras are named cam0..cam3.
"""

from __future__ import annotations

import re
from pathlib import Path

import torch
from torch import Tensor

from ..camera import Camera
from ..pose import Pose
from ..rig import Rig
from .source import RigSource

CONVENTION = (
    "first pixel's centre at 0 (shift 0); P = K [I | t] on rectified camera 0, raw X_i = R X_0 + T; metres"
)


def recognises(path: Path, head: str) -> bool:
    return re.search(r"^(P0|P_rect_0\d):", head, re.MULTILINE) is not None


def read(source: RigSource) -> Rig:
    """The rectified cameras: P0..P3 of `calib.txt`, P_rect and S_rect of `calib_cam_to_cam.txt`."""
    entries = _entries(source)
    names = [name for name in entries if re.fullmatch(r"P\d|P_rect_\d\d", name)]
    if not names:
        raise source.fail("P0", "is missing; is this a KITTI calibration file?")
    return source.rig((f"cam{int(name[-1])}", _rectified(source, entries, name)) for name in names)


def _rectified(source: RigSource, entries: dict[str, Tensor], name: str) -> Camera:
    P = source.numbers(entries[name], (3, 4), name)
    K = source.intrinsics(P[:, :3], name)
    pose = Pose(torch.eye(3, dtype=torch.float64), torch.linalg.solve(K, P[:, 3]))
    size = entries.get(name.replace("P_", "S_")) if "_" in name else None
    hw = source.size_unstated(K) if size is None else source.size_of(size, f"size of {name}")
    return Camera(K=K, cam_from_world=pose, hw=hw)


def _entries(source: RigSource) -> dict[str, Tensor]:
    """The lines `name: numbers`; lines of other things (dates) are passed over."""
    entries: dict[str, Tensor] = {}
    for line in source.text().splitlines():
        name, colon, values = line.partition(":")
        if not colon or not re.fullmatch(r"(P|S|K|D|R|T)\d?(_rect)?(_\d\d)?", name):
            continue
        if name in entries:
            raise source.fail(name, "occurs twice; keep one")
        entries[name] = source.numbers_in(values, None, name)
    return entries


class Raw:
    """Reader of the cameras as they are, before rectification, in `calib_cam_to_cam.txt`."""

    CONVENTION = CONVENTION

    @staticmethod
    def recognises(path: Path, head: str) -> bool:
        return re.search(r"^K_0\d:", head, re.MULTILINE) is not None

    @staticmethod
    def read(source: RigSource) -> Rig:
        """The unrectified cameras: S, K, D, R and T."""
        entries = _entries(source)
        numbers = sorted(name[-2:] for name in entries if re.fullmatch(r"K_\d\d", name))
        if not numbers:
            raise source.fail("K_00", "is missing; is this KITTI's calib_cam_to_cam.txt?")
        return source.rig((f"cam{int(n)}", Raw._camera(source, entries, n)) for n in numbers)

    @staticmethod
    def _camera(source: RigSource, entries: dict[str, Tensor], n: str) -> Camera:
        S, K, D, R, T = (source.get(entries, f"{letter}_{n}", "") for letter in "SKDRT")
        return Camera(
            K=source.intrinsics(K, f"K_{n}"),
            cam_from_world=source.pose(R, T, f"R_{n}, T_{n}:"),
            hw=source.size_of(S, f"S_{n}"),
            distortion=source.brown_conrady(D, f"D_{n}"),
        )
