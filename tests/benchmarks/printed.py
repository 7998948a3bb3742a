"""Timing of work for benchmarks, and tables that are printed while they grow."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from datetime import date
from pathlib import Path
from statistics import median

import cv2
import torch

from arraygeom.runtime.atomic import write_text
from pat.lab.evaluation.tables import markdown_header

DATA = Path("../shared/data")
REPORTS = Path(__file__).parents[2] / "docs" / "reports"


def head(line: str, *, align: str = "lr") -> str:
    """The head of a table whose columns are between the bars of a line."""
    return markdown_header([cell.strip() for cell in line.split("|")], align=align)


def timed(
    *ways: Callable[[], object], repeats: int = 5, clock: Callable[[], float] = time.process_time
) -> list[list[float]]:
    """Seconds of the repeats of each way, in turn, after one of each that is not counted."""
    found: list[list[float]] = [[] for _ in ways]
    for i in range(repeats + 1):
        for way, seconds in zip(ways, found):
            began = clock()
            way()
            if i > 0:
                seconds.append(clock() - began)
    return found


def spread(seconds: list[float], digits: int = 2) -> str:
    """The median, and least to most."""
    middle, least, most = (f"{f(seconds):.{digits}f}" for f in (median, min, max))
    return f"{middle} ({least} to {most})"


def reproducible() -> None:
    """Let this process compute on one thread, and OpenCV draw the same random numbers each time."""
    torch.set_num_threads(1)
    cv2.setRNGSeed(0)


def print_tables(title: str, tables: Iterable[Iterable[str]], out: Path | None) -> None:
    """Print each table's rows as they come, a blank line between tables; write them to `out` if given."""
    lines: list[str] = []
    for table in tables:
        for row in table:
            print(row, flush=True)
            lines.append(row)
        lines.append("")
    if out:
        write_text(out, f"# {title}\n\n*Printed on {date.today()}.*\n\n" + "\n".join(lines).rstrip() + "\n")
