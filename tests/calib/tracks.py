"""Corners observed in other tools' data sets, with the published rigs and reprojection errors."""

from __future__ import annotations

import bz2
import csv
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from arraygeom import Pose, Rig, triangulate
from arraygeom.io import read_rig
from calib.boards.bundle import BundleProblem, Observations
from calib.boards.detect import BoardViews, Detection
from tests.calib.board_scenes import all_free

CALISCOPE_BOARD = "charuco:4x5:54mm"
CALISCOPE_RMS, FIFTEEN_RMS = 1.6625, 0.8070
"""The published rigs' own reprojection errors (root mean square, pixels) on the published corners."""


def free_points(cameras, X, seen) -> BundleProblem:
    """Independent points in the world (n, 3), metres: each is the origin of a board of its own."""
    eye = torch.eye(3, dtype=torch.float64).expand(len(X), 3, 3)
    frames = tuple(range(len(X)))
    return BundleProblem(dict(cameras), Pose(eye, torch.from_numpy(X)), seen, frames, all_free(cameras))


class Tracks(NamedTuple):
    """A published rig, and its corners as the images' own points."""

    rig: Rig
    problem: BundleProblem


def fifteen_cameras(data: Path) -> Tracks:
    """pycalib's 15 action cameras: 6,560 observations of free points, triangulated by the published rig."""
    folder = data / "rigs" / "pycalib_gopro15"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rig = read_rig(folder / "output.json", hw=(2988, 5312))
    lines = bz2.decompress((folder / "kp.txt.bz2").read_bytes()).decode().splitlines()[1:6561]
    rows = np.array([line.split() for line in lines], float)
    x, seen = np.zeros((15, 1404, 2)), np.zeros((15, 1404), dtype=bool)
    index = rows[:, :2].astype(int).T
    x[tuple(index)], seen[tuple(index)] = rows[:, 2:], True
    cameras, pixels = list(rig.cameras.values()), torch.from_numpy(x)
    points = triangulate(cameras, pixels, seen=torch.from_numpy(seen), residual=torch.inf).X.numpy()
    observations = {
        name: Observations(np.flatnonzero(s), np.zeros((s.sum(), 3)), p[s])
        for name, s, p in zip(rig.names, seen, x)
    }
    return Tracks(rig, free_points(rig.cameras, points, observations))


def caliscope(data: Path) -> Tracks:
    """Its four cameras, with corners as the free points that it published."""
    folder = data / "rigs" / "caliscope_4cam"
    rig = read_rig(folder / "camera_array.toml")
    corners = {}
    for row in csv.DictReader((folder / "xyz_CHARUCO.csv").open()):
        corners[row["sync_index"], row["keypoint_id"]] = [float(row[f"{axis}_coord"]) for axis in "xyz"]
    index = {key: i for i, key in enumerate(corners)}
    seen: dict[str, list] = {name: [] for name in rig.names}
    for row in _caliscope_rows(data):
        if (key := (row["sync_index"], row["keypoint_id"])) in index:
            seen[f"cam{row['cam_id']}"].append((index[key], float(row["img_loc_x"]), float(row["img_loc_y"])))
    observations = {
        name: Observations(
            np.array([i for i, _, _ in s]), np.zeros((len(s), 3)), np.array([[x, y] for _, x, y in s])
        )
        for name, s in seen.items()
    }
    return Tracks(rig, free_points(rig.cameras, np.array(list(corners.values())), observations))


def caliscope_views(data: Path) -> dict[str, BoardViews]:
    """The same corners as views of a board."""
    found: dict[str, dict[int, list]] = {}
    for row in _caliscope_rows(data):
        corner = int(row["keypoint_id"]), float(row["img_loc_x"]), float(row["img_loc_y"])
        found.setdefault(f"cam{row['cam_id']}", {}).setdefault(int(row["sync_index"]), []).append(corner)
    return {
        name: BoardViews(
            (720, 1280), {k: _detection(corners) for k, corners in frames.items() if len(corners) >= 6}
        )
        for name, frames in sorted(found.items())
    }


def rms_and_mean(problem: BundleProblem) -> tuple[float, float]:
    """Return root mean square and mean of the residuals' lengths, pixels."""
    lengths = np.concatenate([np.linalg.norm(r, axis=1) for r in problem.residuals.values()])
    return float(np.sqrt((lengths**2).mean())), float(lengths.mean())


def _detection(corners: list) -> Detection:
    return Detection(np.array([i for i, _, _ in corners]), np.array([[x, y] for _, x, y in corners]))


def _caliscope_rows(data: Path) -> list[dict[str, str]]:
    with (data / "rigs" / "caliscope_4cam" / "xy_CHARUCO.csv").open() as file:
        return list(csv.DictReader(file))
