"""Time and memory of `pat align` beside `pat fuse`: `python -m tests.benchmarks.bench_align`.

The sample array enlarged: alpha of 1280x800 with four betas, and of 12 megapixels with one beta within 4 GiB.
Each command in a process of its own; seconds are of the processor, memory is the largest resident.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import tyro

from .bench_job import PAT, Case, fuse_arguments, run, scenes, shown, table

CASES = Case("1280x800, 4 betas", (1280, 800), 4), Case("4032x3024, 1 beta", (4032, 3024), cap="4GiB")
COLUMNS = ("alpha", "command", "limit", "s, processor", "s", "GiB")


def main(only: str = "") -> None:
    """Print the table, of all cases or of those whose names begin so."""
    rows = []
    with tempfile.TemporaryDirectory() as work:
        for case, folder in scenes([case for case in CASES if case.name.startswith(only)], Path(work)):
            for command in ("fuse", "align"):
                found = run([*PAT, command, *fuse_arguments(case, folder, Path(work) / command)])
                figures = f"{found.cores:.0f}", f"{found.wall:.0f}", f"{found.peak / 2**30:.2f}"
                rows.append(shown(COLUMNS, [case.name, f"pat {command}", case.cap or "none", *figures]))
    print(table(COLUMNS, rows), end="")


if __name__ == "__main__":
    tyro.cli(main)
