"""Memory of the command: `python -m tests.benchmarks.bench_memory [--megapixels 12 24] [--only NAME]`.

`pat fuse` as a process, report page included: what its plan says, the resident memory that it has at most,
and the limit that it is to keep. The images are the sample array's, enlarged, through lenses or not, with a
rig or without. Each line is printed as it is measured, and put into the table of
tests/benchmarks/RESULTS_memory.md. On two cores some five minutes for 4 megapixels, an hour in all.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from pat.app.cli.parser import script

from .bench_job import PARTS, PAT, run, shown, table

RESULTS = Path(__file__).with_name("RESULTS_memory.md")
SIDES = {4: (2304, 1728), 12: (4000, 3000), 24: (6000, 4000), 50: (8192, 6144)}
"""Width and height by megapixels."""
COLUMNS = ("megapixels", "what", "limit, GiB", "plan, GiB", "peak, GiB", "plan / peak", "core seconds")


@dataclass(frozen=True)
class Case:
    """A fusion to measure: alpha and so many betas."""

    megapixels: int
    limit: str | None
    betas: int = 1
    rig: bool = True
    lens: bool = False
    noise: bool = False

    @property
    def name(self) -> str:
        """In words."""
        words = [f"{self.betas} beta{'s' * (self.betas > 1)}", "rig" if self.rig else "no rig"]
        return ", ".join(words + ["lenses"] * self.lens + ["noise"] * self.noise)

    def images(self, folder: Path) -> Path:
        """The folder of its images, which are made unless they are there."""
        scene = folder / f"{self.megapixels}{'lens' if self.lens else ''}"
        if not scene.exists():
            sides = map(str, SIDES[self.megapixels])
            run([*PARTS, "scene", str(scene), *sides, "4", *["-0.05"] * self.lens])
        return scene

    def arguments(self, scene: Path, out: Path) -> list[str]:
        """`pat fuse`'s own."""
        files = {
            name: scene / f"{name}.png" for name in ("mono", *(f"colour{i + 1}" for i in range(self.betas)))
        }
        given = [str(file) for file in files.values()]
        if self.rig:
            given = [str(scene / "rig.yaml"), "--alpha", "mono"]
            given += [word for name, file in files.items() for word in ("--image", f"{name}={file}")]
        limit = [] if self.limit is None else ["--max-memory", self.limit]
        return [*given, "--out", str(out), *limit, *["--noise", "estimate"] * self.noise]


CASES = (
    Case(4, None),
    Case(4, "1600MiB", lens=True),
    Case(4, "1600MiB", rig=False),
    Case(4, "2GiB", betas=2),
    Case(4, "3GiB", betas=4),
    Case(4, "2GiB", noise=True),
    Case(12, None),
    Case(12, "3GiB", lens=True),
    Case(12, "3GiB", rig=False),
    Case(12, "4GiB", betas=3),
    Case(12, "3GiB", noise=True),
    Case(24, "6GiB", lens=True),
    Case(24, "6GiB", rig=False),
    Case(50, "12GiB"),
    Case(50, "12GiB", rig=False),
)


class Measured(NamedTuple):
    """Bytes: the last plan's, and the peak of resident memory; and seconds of a core."""

    plan: float
    peak: float
    seconds: float

    def row(self, case: Case) -> list[str]:
        """A line of the table."""
        sizes = (f"{value / 2**30:.2f}" for value in (self.plan, self.peak))
        limit = "" if case.limit is None else f"{size_of(case.limit) / 2**30:.2f}"
        ratio = f"{self.plan / self.peak:.2f}"
        return [str(case.megapixels), case.name, limit, *sizes, ratio, f"{self.seconds:.0f}"]


def size_of(limit: str) -> float:
    """Bytes of "4GiB" or "900MiB"."""
    return float(limit[:-3]) * {"GiB": 2**30, "MiB": 2**20}[limit[-3:]]


def measured(case: Case, folder: Path) -> Measured:
    """Run the command. Raises RuntimeError with what it printed if it fails, or says no plan."""
    found = run([*PAT, "fuse", *case.arguments(case.images(folder), folder / "out")])
    plans = re.findall(r"plan: .* ([0-9.]+) GiB in all", found.said)
    if not plans:
        raise RuntimeError(f"{case.name}: no plan was said:\n{found.said[-2000:]}")
    return Measured(float(plans[-1]) * 2**30, found.peak, found.cores)


def main(megapixels: tuple[int, ...] = tuple(SIDES), only: str | None = None) -> None:
    """Print the lines, and put them into the table, whose other lines stay.

    Args:
        megapixels: The sizes.
        only: The cases of this name, such as "1 beta, no rig".
    """
    rows = {key_of(line): line for line in RESULTS.read_text().splitlines()[2:]} if RESULTS.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        for case in CASES:
            if case.megapixels in megapixels and only in (None, case.name):
                cells = shown(COLUMNS, measured(case, Path(folder)).row(case))
                line = table(COLUMNS, [cells]).splitlines()[-1]
                rows[key_of(line)] = line
                RESULTS.write_text(table(COLUMNS, []) + "\n".join(sorted(rows.values(), key=order)) + "\n")


def key_of(line: str) -> tuple[str, ...]:
    """Return the cells that name the fusion, and its limit."""
    return tuple(line.split(" | ")[:3])


def order(line: str) -> int:
    """Megapixels: the order of lines."""
    return int(line.split()[1])


if __name__ == "__main__":
    script(main)
