"""Calibration from a start: the nine-band array from one image of a board by each camera.

    python -m tests.benchmarks.bench_start --out tests/benchmarks/RESULTS_start.md

Its makers state the positions (a grid of 40 mm), focal length and size of the sensor, and the print says "30
mm". With positions stated to 0.5 mm the rig is what a user gets; stated to 5 mm it shows what the boards
alone say of them. *scene*: median distance of points matched in the images of a scene, which are not used,
from their lines, pixels, for the pairs with most points (median and worst pair).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from calib.boards.poses import StartDeviations
from calib.boards.rig import Calibration
from calib.boards.uncertainty import baseline_deviation, rig_covariance
from calib.images.matches import PointMatches, match_cameras
from calib.images.residuals import line_distances
from experiments.alignment import nine_band_calibration
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_row
from pat.media.images import read_image
from tests.benchmarks.printed import DATA, head, print_tables, reproducible

ROWS = ((0, 1, 2), (3, 4, 5), (6, 7, 8))
GRID = 0.04
ENOUGH = 150
"""Points of a pair whose distances are reported."""


def neighbours() -> Iterator[tuple[str, str]]:
    """Pairs of cameras that stand next to each other."""
    for line in (*ROWS, *zip(*ROWS)):
        yield from ((f"Cam-{a}", f"Cam-{b}") for a, b in pairwise(line))


def scene_matches(folder: Path) -> dict[tuple[str, str], PointMatches]:
    images = {f"Cam-{i}": read_image(folder / "scene" / f"Cam-{i}.png") for i in range(9)}
    return {names: m for names, m in match_cameras(images).items() if len(m.alpha) >= ENOUGH}


def rows(folder: Path) -> Iterator[str]:
    yield head(
        "positions stated | RMS px | baselines off by, mm | their sigma, mm | f | scene px | worst pair"
    )
    matches = scene_matches(folder)
    for position in (5e-4, 5e-3):
        found = nine_band_calibration(folder, StartDeviations(position=position))
        yield markdown_row([f"± {1e3 * position:g} mm", f"{found.rms:.3f}", *_cells(found, matches)])


def _cells(found: Calibration, matches: Mapping[tuple[str, str], PointMatches]) -> Iterator[str]:
    covariance, rig = rig_covariance(found.fit), found.rig
    assert covariance is not None
    off = [float((rig[b].centre - rig[a].centre).norm()) - GRID for a, b in neighbours()]
    deviations = [baseline_deviation(found.fit.problem.cameras, a, b, covariance) for a, b in neighbours()]
    focal = [float(c.K[0, 0]) for c in found.fit.problem.cameras.values()]
    scene = [float(line_distances(rig, {names: m}).abs().median()) for names, m in matches.items()]
    yield f"{1e3 * np.abs(off).max():.2f} at most"
    yield f"{1e3 * np.median(deviations):.2f}"
    yield f"{min(focal):.0f} to {max(focal):.0f} px"
    yield f"{np.median(scene):.2f}"
    yield f"{max(scene):.2f}"


def main(data: Path = DATA, out: Path | None = None) -> None:
    """Print the table."""
    reproducible()
    title = "An array from one image of a board by each camera"
    print_tables(title, [rows(data / "nine_band_array")], out)


if __name__ == "__main__":
    script(main)
