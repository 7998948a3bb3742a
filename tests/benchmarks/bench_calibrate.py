"""Accuracy of `pat calibrate`: real sets, published corner tracks, rendered photographs whose truth is known.

    python -m tests.benchmarks.bench_calibrate --boards out/boards --out tests/benchmarks/RESULTS_calibrate.md

Rendered photographs are those of `python -m tests.calib.rendered --out out/boards`. A table without its data
is left out, and says so. Seconds are of the whole, finding the board included, of all cores together.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from arraygeom import Camera, Rig
from arraygeom.io import read_rig
from calib.boards.detect import collect_folder
from calib.boards.rig import Calibration, calibrate
from calib.boards.solve import adjust, calibrate_single
from calib.boards.target import parse_board
from calib.boards.validation import epipolar_errors
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_header, markdown_row
from tests.benchmarks.printed import DATA, print_tables
from tests.calib.board_scenes import errors_of, pose_errors
from tests.calib.rendered import BOARD
from tests.calib.tracks import (
    CALISCOPE_BOARD,
    CALISCOPE_RMS,
    FIFTEEN_RMS,
    caliscope,
    caliscope_views,
    fifteen_cameras,
    rms_and_mean,
)

ACTION_CAMERAS = {1: 107599.7 / 64, 2: 107118.7 / 64, 3: 107622.3 / 64, 4: 107215.0 / 64}
"""Published focal lengths, pixels."""


class Figure(NamedTuple):
    """One row: what, the figure found, what it should be."""

    what: str
    found: str
    wanted: str


def opencv_pairs(data: Path) -> Iterator[Figure]:
    found, seconds = of_folder(data / "calibration/opencv_stereo", "chessboard:9x6:25mm")
    yield Figure("OpenCV's pairs: RMS", f"{found.rms:.3f} px", "at most 0.22 px")
    yield Figure("f, left", f"{focal(found.rig, 'left'):.2f} px", "535.9 px to 1 %")
    baseline = 1e3 * float(camera(found.rig, "right").centre.norm())
    yield Figure("baseline", f"{baseline:.3f} mm", "83.2 mm to 0.5 %")
    yield Figure("seconds", f"{seconds:.0f}", "")


def bumblebee_pairs(data: Path) -> Iterator[Figure]:
    folder = data / "calibration/bumblebee2_chess"
    found, seconds = of_folder(folder, "chessboard:4x6:30mm")
    published = read_rig(folder / "stereo.yaml", scale=1e-3)
    names = ("left", "right")
    theirs = float(epipolar_errors(published, found.views)[names].mean())
    yield Figure(
        "Bumblebee2: mean epipolar error", f"{found.epipolar[names].mean():.3f} px", "at most 0.08 px"
    )
    yield Figure("of the published rig, same corners", f"{theirs:.3f} px", "")
    if names in found.held_out:
        yield Figure("on frames held out", f"{found.held_out[names].mean():.3f} px", "")
    for name in names:
        off = focal(found.rig, name) / focal(published, name) - 1
        yield Figure(f"f, {name}, against published", f"{100 * off:+.2f} %", "agreement")
    ours, theirs_ = (rig.pair(*names).beta_from_alpha for rig in (found.rig, published))
    turn = np.degrees(np.arccos(np.clip((float((ours.R * theirs_.R).sum()) - 1) / 2, -1, 1)))
    yield Figure(
        "baseline against published",
        f"{100 * float(ours.t.norm() / theirs_.t.norm() - 1):+.2f} %",
        "agreement",
    )
    told = found.deviations()
    deviation = np.degrees(np.hypot(told["right.rotation.0"], told["right.rotation.1"]))
    yield Figure(
        "rotation against published", f"{turn:.2f} degrees (own deviation {deviation:.2f})", "agreement"
    )
    yield Figure("seconds", f"{seconds:.0f}", "")


def action_cameras(data: Path) -> Iterator[Figure]:
    folder, board = data / "calibration/pose2sim_4cam/intrinsics", parse_board("chessboard:4x7:60mm")
    for number, published in ACTION_CAMERAS.items():
        found = collect_folder(folder, board, patterns={"cam": f"int_cam{number:02d}_img/*.jpg"})
        alone = calibrate_single("cam", found.views["cam"], board)
        off = float(alone.problem.cameras["cam"].K[0, 0]) / published - 1
        rms = alone.problem.rms()
        yield Figure(f"action camera {number}: f", f"{100 * off:+.2f} % (RMS {rms:.3f} px)", "to 1.5 %")


def tracks(data: Path) -> Iterator[Figure]:
    problem, start = fifteen_cameras(data).problem, time.process_time()
    found = adjust(problem)
    rms, seconds = rms_and_mean(found.problem)[0], time.process_time() - start
    yield Figure(
        "15 cameras, free points: RMS", f"{rms:.4f} px in {seconds:.0f} s", f"at most {FIFTEEN_RMS:.4f}, 60 s"
    )
    problem, start = caliscope(data).problem, time.process_time()
    posed = {name: np.arange(15) < (6 if i else 0) for i, name in enumerate(problem.cameras)}
    rms = rms_and_mean(adjust(replace(problem, free=posed), rounds=0).problem)[0]
    seconds = time.process_time() - start
    yield Figure(
        "caliscope, free points, its intrinsics: RMS",
        f"{rms:.4f} px in {seconds:.0f} s",
        f"at most {CALISCOPE_RMS:.4f}, 60 s",
    )
    start = time.process_time()
    whole = calibrate(caliscope_views(data), parse_board(CALISCOPE_BOARD))
    seconds = time.process_time() - start
    yield Figure(
        "caliscope, `calibrate`, a rigid board, nothing known: RMS",
        f"{whole.rms:.4f} px in {seconds:.0f} s",
        f"at most {CALISCOPE_RMS:.4f}, 60 s",
    )


def rendered(boards: Path) -> Iterator[Figure]:
    """The photographs of `tests.calib.rendered` against the rig that took them."""
    true = Rig.load(boards / "true.yaml")
    found, seconds = of_folder(boards, BOARD, order=true.names)
    degrees, metres = pose_errors(found.fit, true)
    errors = errors_of(found.fit, true)
    relative = errors / np.sqrt(found.fit.covariance.diagonal())
    worst = int(np.abs(relative).argmax())
    square = float(errors @ np.linalg.solve(found.fit.covariance, errors))
    yield Figure("rendered photographs", f"{len(found.frames)} frames, 4 cameras", "10 or more")
    noise = ", ".join(f"{name} {sigma:.3f}" for name, sigma in found.fit.problem.sigma.items())
    yield Figure("noise of corners", f"{noise} px", "")
    yield Figure("worst rotation", f"{degrees:.4f} degrees", "at most 0.02")
    yield Figure("worst position", f"{1e3 * metres:.3f} mm", "at most 0.2")
    yield Figure(
        "worst parameter", f"{np.abs(relative).max():.2f} deviations ({found.fit.names[worst]})", "at most 3"
    )
    yield Figure("chi-square of all parameters", f"{square:.0f} of {len(errors)}", "")
    yield Figure("seconds", f"{seconds:.0f}", "")


def of_folder(folder: Path, board: str, *, order: tuple[str, ...] | None = None) -> tuple[Calibration, float]:
    """The rig as by `pat calibrate`, and the seconds it took."""
    start, known = time.process_time(), parse_board(board)
    views = collect_folder(folder, known).views
    found = calibrate({name: views[name] for name in order or views}, known)
    return found, time.process_time() - start


def camera(rig: Rig, name: str) -> Camera:
    found = rig[name]
    assert isinstance(found, Camera)
    return found


def focal(rig: Rig, name: str) -> float:
    return float(camera(rig, name).K[0, 0])


TABLES = {
    "opencv": opencv_pairs,
    "bumblebee": bumblebee_pairs,
    "action": action_cameras,
    "tracks": tracks,
    "rendered": rendered,
}


def rows(names: Sequence[str], data: Path, boards: Path) -> Iterator[str]:
    yield markdown_header(["what", "found", "wanted"], align="l")
    for name in names:
        source = boards if name == "rendered" else data
        missing = Figure(name, f"left out: no folder {source}", "")
        yield from map(markdown_row, TABLES[name](source) if source.is_dir() else [missing])


def main(
    data: Path = DATA,
    boards: Path = Path("out/boards"),
    only: tuple[Literal["opencv", "bumblebee", "action", "tracks", "rendered"], ...] = (),
    out: Path | None = None,
) -> None:
    """Print the tables."""
    print_tables("How good calibration is", [rows(only or tuple(TABLES), data, boards)], out)


if __name__ == "__main__":
    script(main)
