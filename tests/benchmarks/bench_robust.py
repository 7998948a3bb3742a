"""Board calibration with wrong corners: errors in stated deviations over many draws of simulated corners.

    python -m tests.benchmarks.bench_robust --draws 200 --out tests/benchmarks/RESULTS_robust.md

Two cameras, 14 frames, corners good to 0.1 px; a share of them lies up to 40 px elsewhere. *chi-square* is
that of all estimated parameters per degree of freedom (mean and largest of the draws), 1 if the stated
covariance is right. *refused*: draws that raise an error.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.progress import track

from arraygeom import Rig
from calib.boards.detect import BoardViews, Detection
from calib.boards.rig import Calibration, calibrate
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_row
from tests.benchmarks.printed import head, print_tables, reproducible
from tests.calib.board_scenes import BOARD, board_poses, errors_of, four_cameras, see

NOISE = 0.1


def spoiled(views: dict[str, BoardViews], share: float, g: np.random.Generator) -> dict[str, BoardViews]:
    """The views with a share of their corners displaced by 5 to 40 pixels."""
    found = {}
    for name, v in views.items():
        seen = {}
        for key, d in v.seen.items():
            wrong = g.uniform(size=len(d.ids)) < share
            angle, length = g.uniform(0, 2 * np.pi, len(d.ids)), g.uniform(5, 40, len(d.ids))
            off = np.stack([np.cos(angle), np.sin(angle)], -1) * length[:, None]
            seen[key] = Detection(d.ids, d.x + np.where(wrong[:, None], off, 0.0))
        found[name] = BoardViews(v.hw, seen)
    return found


def drawn(share: float, draw: int) -> tuple[Rig, Calibration]:
    """A rig and its calibration from one draw."""
    g = np.random.default_rng([draw, int(100 * share)])
    cameras = four_cameras().cameras
    rig = Rig({name: cameras[name] for name in ("mono", "colour")})
    views = see(rig, board_poses(14, seed=draw), noise=NOISE, seed=draw + 1)
    return rig, calibrate(spoiled(views, share, g), BOARD)


class Draw(NamedTuple):
    """One draw: its largest error in stated standard deviations, chi-square per degree, RMS in pixels."""

    worst: float
    square: float
    rms: float


def judged(share: float, draw: int) -> Draw:
    rig, found = drawn(share, draw)
    error, covariance = errors_of(found.fit, rig), found.fit.covariance
    worst = float(np.abs(error / np.sqrt(covariance.diagonal())).max())
    return Draw(worst, float(error @ np.linalg.solve(covariance, error)) / len(error), found.rms)


def rows(draws: range, shares: Sequence[float]) -> Iterator[str]:
    yield head("wrong corners | draws | worst error, sigma | beyond 5 sigma | chi-square | RMS px | refused")
    notes = []
    for share in shares:
        found: dict[int, Draw] = {}
        for draw in track(draws, description=f"{share:.0%}"):
            try:
                found[draw] = judged(share, draw)
            except ValueError as error:
                notes.append(f"{share:.0%} draw {draw}: {error}")
        beyond = [f"{share:.0%} draw {i}: {d.worst:.1f} sigma" for i, d in found.items() if d.worst > 5]
        worst, squares, rms = (np.array(column) for column in zip(*found.values()))
        square = f"{squares.mean():.2f}, {squares.max():.2f}"
        cells = f"{worst.max():.1f}", len(beyond), square, f"{rms.max():.3f}"
        yield markdown_row([f"{share:.0%}", len(draws), *cells, len(draws) - len(found)])
        notes += beyond
        notes += [f"{share:.0%} draw {i}: RMS {d.rms:.2f} px" for i, d in found.items() if d.rms > 3 * NOISE]
    yield "\n".join(["", *notes])


def main(
    draws: int = 20, first: int = 0, shares: tuple[float, ...] = (0.0, 0.05, 0.2), out: Path | None = None
) -> None:
    """Print the table of so many draws, from the number `first` on."""
    reproducible()
    title = "Board calibration with wrong corners"
    print_tables(title, [rows(range(first, first + draws), shares)], out)


if __name__ == "__main__":
    script(main)
