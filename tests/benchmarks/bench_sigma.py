"""Stated standard deviations against the jackknife on real boards: without each frame, all is fitted again.

    python -m tests.benchmarks.bench_sigma --out tests/benchmarks/RESULTS_sigma.md

*stated / jackknife*: of all free parameters, the median, and the share within 30 %. A jackknife over a dozen
frames is itself good to some 20 %. *raised*: the largest factor by which `calibrate` raised what the corners'
noise alone gives.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calib.boards.bundle import BundleProblem, Solved, intrinsic_values
from calib.boards.detect import collect_folder
from calib.boards.rig import Calibration, calibrate
from calib.boards.solve import readjusted
from calib.boards.target import parse_board
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_row
from tests.benchmarks.printed import DATA, head, print_tables, reproducible


def sets(data: Path) -> Iterator[tuple[str, Calibration]]:
    """The real sets of boards, calibrated."""
    boards = data / "calibration"
    for folder, board in (
        ("opencv_stereo", "chessboard:9x6:25mm"),
        ("bumblebee2_chess", "chessboard:4x6:30mm"),
    ):
        known = parse_board(board)
        yield folder, calibrate(collect_folder(boards / folder, known).views, known)
    known = parse_board("chessboard:4x7:60mm")
    for i in range(1, 5):
        pattern = {"cam": f"int_cam{i:02d}_img/*.jpg"}
        views = collect_folder(boards / "pose2sim_4cam" / "intrinsics", known, patterns=pattern).views
        yield f"pose2sim camera {i}", calibrate(views, known)


def jackknifed(fit: Solved) -> np.ndarray:
    """The jackknife's standard deviations of the free parameters."""
    count = len(fit.problem.frames)
    values = []
    for left_out in range(count):
        again = readjusted(fit.problem.of_boards(np.arange(count) != left_out))
        values.append(difference(again, fit.problem))
    found = np.array(values)
    return np.sqrt((count - 1) / count * ((found - found.mean(0)) ** 2).sum(0))


def difference(a: BundleProblem, b: BundleProblem) -> np.ndarray:
    """Return the difference of all free parameters, in the order of the fit's names; rotations to first
    order."""
    parts = []
    for name, mask in b.free.items():
        change = intrinsic_values(a.cameras[name]) - intrinsic_values(b.cameras[name])
        R = (a.cameras[name].R @ b.cameras[name].R.T).numpy()
        change[:3] = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        change[3:6] = (a.cameras[name].t - b.cameras[name].t).numpy()
        parts.append(change[mask])
    return np.concatenate(parts)


def rows(data: Path) -> Iterator[str]:
    yield head(
        "boards | frames | RMS px | parameters | stated / jackknife | within 30 % | f | raised | shape"
    )
    notes = []
    for name, found in sets(data):
        ratio = np.sqrt(found.fit.covariance.diagonal()) / jackknifed(found.fit)
        focal = [r for r, n in zip(ratio, found.fit.names) if "focal" in n]
        shape = "; ".join(note.split(";")[0] for note in found.notes if note.startswith("the board is"))
        near = np.abs(np.log(ratio)) < np.log(1.3)
        others = ", ".join(f"{n} {r:.2f}" for r, n in zip(ratio[~near], np.array(found.fit.names)[~near]))
        notes.append(f"- {name}: {others or 'none'}")
        cells = f"{np.median(ratio):.2f}", f"{np.mean(near):.0%}", f"{np.mean(focal):.2f}"
        count = len(found.fit.problem.frames)
        yield markdown_row(
            [name, count, f"{found.rms:.3f}", len(ratio), *cells, f"{found.fit.raised:.1f}", shape or "flat"]
        )
    yield "\n".join(["", "Stated / jackknife of the parameters that are not within 30 %:", "", *notes])


def main(data: Path = DATA, out: Path | None = None) -> None:
    """Print the table."""
    reproducible()
    print_tables("Stated sigma on real boards", [rows(data)], out)


if __name__ == "__main__":
    script(main)
