"""Boards calibrated here and by OpenCV 5, with the same detected points, judged on frames that neither used.

    ENV/bin/python -m tests.benchmarks.bench_opencv --boards out/boards --out
    tests/benchmarks/RESULTS_opencv.md

ENV is an environment of its own with opencv-contrib-python-headless 5, which needs NumPy 2, and what else the
project depends on. Rendered photographs are those of `python -m tests.calib.rendered --out out/boards`; a set
without its folder is left out. Frames are held out in five parts. Points of all pairs of cameras count: their
distance from the lines of the other camera's, in undistorted pixels. Lenses have OpenCV's first five terms.
*Parts refused*: in so many of the five there was an error in place of a rig, and their points do not count.
*Seconds*: of all cores together.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Camera, Distortion, Pose, Rig
from calib.boards.board import Board
from calib.boards.detect import BoardViews, Detection, collect_folder
from calib.boards.photos import FrameKey
from calib.boards.rig import calibrate
from calib.boards.target import parse_board
from calib.boards.validation import FOLDS, epipolar_errors
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_row
from tests.benchmarks.printed import DATA, head, print_tables, reproducible
from tests.calib.rendered import BOARD
from tests.calib.tracks import CALISCOPE_BOARD, caliscope_views

opencv: Any = cv2
"""OpenCV of version 5, which has more than stubs know of."""
Views = Mapping[str, BoardViews]
Calibrator = Callable[[Views, Board], Rig]
FEWEST = 6
"""Points of a frame that cameras must share: the least that a pose and its check need."""


def sets(data: Path, boards: Path) -> Iterator[tuple[str, Views, Board]]:
    """Detected points of sets of boards, by name."""
    folders = (
        ("OpenCV's pairs", data / "calibration/opencv_stereo", "chessboard:9x6:25mm"),
        ("Bumblebee2", data / "calibration/bumblebee2_chess", "chessboard:4x6:30mm"),
        ("rendered, 4 cameras", boards, BOARD),
    )
    for name, folder, board in folders:
        if folder.is_dir():
            yield name, collect_folder(folder, parse_board(board)).views, parse_board(board)
    yield "caliscope, 4 cameras", caliscope_views(data), parse_board(CALISCOPE_BOARD)


def here(views: Views, board: Board) -> Rig:
    return calibrate(views, board).rig


def multiview(views: Views, board: Board) -> Rig:
    """`calibrateMultiview` of OpenCV 5, from each camera's `calibrateCamera`.

    Points that a camera did not detect spoil its result, and all frames must have as many: each has the
    points that all its cameras share, without cameras that share too few, some of them repeated.
    """
    frames = [_common(views, key) for key in dict.fromkeys(key for v in views.values() for key in v.seen)]
    most = max(len(ids) for ids, _ in frames)
    points, pixels = [], [[] for _ in views]
    for ids, seen in frames:
        repeated = np.resize(np.arange(len(ids)), most)
        points.append(board.points[ids[repeated]].astype(np.float32))
        for mine, name in zip(pixels, views):
            x = seen[name].x if name in seen else np.zeros((len(ids), 2))
            mine.append(x[repeated].astype(np.float32))
    detected = np.array([[name in seen for _, seen in frames] for name in views], np.uint8)
    sizes = [v.hw[::-1] for v in views.values()]
    models = np.full(len(views), opencv.CALIB_MODEL_PINHOLE, np.uint8)
    Ks, lenses = zip(*(_single(v, board) for v in views.values()))
    flags = np.full(len(views), cv2.CALIB_USE_INTRINSIC_GUESS, np.int32)
    _, Ks, lenses, Rs, ts, *_ = opencv.calibrateMultiview(
        points, pixels, sizes, detected, models, Ks, lenses, None, None, flags, cv2.CALIB_USE_INTRINSIC_GUESS
    )
    return _rig(views, Ks, lenses, Rs, ts)


def _common(views: Views, key: FrameKey) -> tuple[np.ndarray, dict[str, Detection]]:
    """The points of a frame that its cameras share, and of each camera their pixels, in the same order."""
    seen = {name: v.seen[key] for name, v in views.items() if key in v.seen}
    while len(ids := reduce(np.intersect1d, (d.ids for d in seen.values()))) < FEWEST:
        del seen[min(seen, key=lambda name: len(seen[name].ids))]
    return ids, {
        n: Detection(ids, d.x[np.argsort(d.ids)][np.isin(np.sort(d.ids), ids)]) for n, d in seen.items()
    }


def stereo(views: Views, board: Board) -> Rig:
    """`stereoCalibrate` from each camera's `calibrateCamera`, of the frames that both cameras see."""
    a, b = views.values()
    shared = [_common(views, key) for key in a.seen if key in b.seen]
    shared = [(ids, seen) for ids, seen in shared if len(seen) == 2]
    points = [board.points[ids].astype(np.float32) for ids, _ in shared]
    pixels = ([seen[name].x.astype(np.float32) for _, seen in shared] for name in views)
    start = (*_single(a, board), *_single(b, board))
    _, K, lens, K_beta, lens_beta, R, t, *_ = cv2.stereoCalibrate(
        points, *pixels, *start, a.hw[::-1], flags=cv2.CALIB_USE_INTRINSIC_GUESS
    )
    return _rig(views, (K, K_beta), (lens, lens_beta), (np.eye(3), R), (np.zeros(3), t))


def _single(views: BoardViews, board: Board) -> tuple[np.ndarray, np.ndarray]:
    """K and lens of a camera by its detected points."""
    points = [board.points[d.ids].astype(np.float32) for d in views.seen.values()]
    pixels = [d.x.astype(np.float32) for d in views.seen.values()]
    _, K, lens, *_ = cv2.calibrateCamera(points, pixels, views.hw[::-1], None, None)
    return K, lens


def _rig(views: Views, Ks, lenses, Rs, ts) -> Rig:
    cameras = {}
    for (name, v), K, lens, R, t in zip(views.items(), Ks, lenses, Rs, ts):
        R = cv2.Rodrigues(R)[0] if np.size(R) == 3 else R
        K, R, t, lens = (
            torch.from_numpy(np.array(value, float)) for value in (K, R, np.ravel(t), np.ravel(lens))
        )
        cameras[name] = Camera(
            hw=v.hw, K=K, cam_from_world=Pose(R, t), distortion=Distortion("brown-conrady", lens[:5])
        )
    return Rig(cameras)


class HeldOut(NamedTuple):
    """Distances (pixels) of held-out points by rigs calibrated without them; in how many parts is none."""

    errors: Float[np.ndarray, " n"]
    refused: int
    seconds: float


def held_out(calibrated: Calibrator, views: Views, board: Board) -> HeldOut:
    """The frames that two cameras share, held out in parts, judged by a calibration of the others."""
    frames = dict.fromkeys(key for v in views.values() for key in v.seen)
    shared = [key for key in frames if sum(key in v.seen for v in views.values()) > 1]
    errors: list[np.ndarray] = []
    refused, seconds = 0, 0.0
    for fold in range(FOLDS):
        out = set(shared[fold::FOLDS])
        used = {name: v.only(v.seen.keys() - out) for name, v in views.items()}
        start = time.process_time()
        try:
            rig = calibrated(used, board)
        except (ValueError, cv2.error):
            refused += 1
            continue
        seconds += time.process_time() - start
        errors += epipolar_errors(rig, {name: v.only(out) for name, v in views.items()}).values()
    return HeldOut(np.concatenate([np.zeros(0), *errors]), refused, seconds)


def rows(data: Path, boards: Path) -> Iterator[str]:
    yield head("boards | frames | calibrated by | median px | mean px | parts refused | seconds")
    for name, views, board in sets(data, boards):
        frames = len(set().union(*(v.seen for v in views.values())))
        by: dict[str, Calibrator] = {"calib": here, "calibrateMultiview": multiview}
        for label, calibrated in (by | {"stereoCalibrate": stereo} if len(views) == 2 else by).items():
            errors, refused, seconds = held_out(calibrated, views, board)
            found = ("", "") if not len(errors) else (f"{np.median(errors):.3f}", f"{errors.mean():.3f}")
            yield markdown_row([name, frames, label, *found, refused, f"{seconds:.0f}"])


def main(data: Path = DATA, boards: Path = Path("out/boards"), out: Path | None = None) -> None:
    """Print the table."""
    if not hasattr(cv2, "calibrateMultiview"):
        version = cv2.__version__
        raise SystemExit(f"OpenCV {version} has no calibrateMultiview: use an environment with OpenCV 5")
    reproducible()
    title = f"Boards calibrated here and by OpenCV {cv2.__version__}"
    print_tables(title, [rows(data, boards)], out)


if __name__ == "__main__":
    script(main)
