"""60 inputs of `pat fuse`: `python -m tests.benchmarks.bench_inputs [--data ../shared/data] [--only WORD]`.

Of each its exit status, whether there is depth, the mean confidence and the memory by which the process grew
at most. Lines are printed as they are measured, and put into the table of tests/benchmarks/RESULTS_inputs.md.
Exit status 1 if one is not as is expected.
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
import warnings
from pathlib import Path
from typing import NamedTuple

import cv2

from experiments.peaks import with_peak
from pat.app.cli.main import main as pat
from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_row

from .input_kinds import Kind, kinds
from .printed import DATA, head

RESULTS = Path(__file__).with_name("RESULTS_inputs.md")
HEAD = head("input | status | depth | confidence | peak, MiB")


class Came(NamedTuple):
    """Result of a kind of input, with the last line printed."""

    status: int
    depth: bool
    confidence: float
    peak: float
    said: str

    def as_wanted(self, kind: Kind) -> bool:
        """Return True if the outcome is the expected one; a refusal is one line."""
        refused = self.status != 2 or self.said.startswith("pat: ")
        return (self.status, self.depth) == (kind.status, kind.depth) and refused

    def row(self, kind: Kind) -> list[str]:
        """Return the row of the table."""
        confidence = "" if self.status == 2 else f"{self.confidence:.2f}"
        depth = "depth" if kind.depth else "no depth"
        wanted = "" if self.as_wanted(kind) else f" (expected: {kind.status}, {depth})"
        shown = "yes" if self.depth else "no"
        return [kind.name + wanted, str(self.status), shown, confidence, f"{self.peak:.0f}"]


def what_came(kind: Kind, folder: Path) -> Came:
    """Fuse an input of this kind in a folder."""
    words = [*map(str, kind.make(folder)), "--out", str(folder / "out")]
    said = io.StringIO()

    def fused() -> int:
        try:
            pat(["fuse", *words])
        except SystemExit as ended:
            return int(ended.code or 0)
        return 0

    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said), warnings.catch_warnings():
        status, peak = with_peak(fused)
    files = sorted((folder / "out").glob("*confidence.png"))
    confidence = cv2.imread(str(files[0]), cv2.IMREAD_UNCHANGED).mean() / 255 if files else 0.0
    depth = any((folder / "out").glob("*depth.tif"))
    lines = said.getvalue().strip().splitlines() or [""]
    return Came(status, depth, float(confidence), (peak or 0) / 2**20, lines[-1])


def main(data: Path = DATA, only: str = "") -> None:
    """Print the table of all kinds, or of those with a word in their name; exit with 1 if one is wrong."""
    known = {}
    if RESULTS.exists():
        known = {line.split(" | ")[0]: line for line in RESULTS.read_text().splitlines()[2:]}
    wrong = 0
    for kind in (kind for kind in kinds(data.resolve()) if only in kind.name):
        with tempfile.TemporaryDirectory() as folder:
            came = what_came(kind, Path(folder))
        wrong += not came.as_wanted(kind)
        line = markdown_row(came.row(kind))
        print(line if came.as_wanted(kind) else f"{line}\n{came.said}", flush=True)
        known = {k: text for k, text in known.items() if not k.startswith(f"| {kind.name} (expected")}
        known[f"| {kind.name}"] = line
        RESULTS.write_text("\n".join([HEAD, *known.values()]) + "\n")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    script(main)
