"""Tables in Markdown and CSV: the one writer of both."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from arraygeom.runtime.atomic import write_text

T = TypeVar("T")


def grouped(rows: Iterable[T], *names: str) -> dict[Any, list[T]]:
    """Rows by what they have in these attributes (a tuple if several), in order of first appearance."""
    groups: dict[Any, list[T]] = {}
    for row in rows:
        groups.setdefault(attrgetter(*names)(row), []).append(row)
    return groups


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[object]], *, align: str = "lr") -> str:
    """Header, rule and rows, a newline after each.

    `align` has one letter, l or r, for each column; the last stands for all that follow.
    """
    return "".join(f"{line}\n" for line in (markdown_header(columns, align=align), *map(markdown_row, rows)))


def markdown_header(columns: Sequence[str], *, align: str = "lr") -> str:
    """Header and rule, for tables that are printed row by row; see `markdown_table`."""
    letters = align.ljust(len(columns), align[-1])
    rule = markdown_row("---:" if letters[i] == "r" else "---" for i in range(len(columns)))
    return markdown_row(columns).replace("|  |", "| |") + "\n" + rule


def markdown_row(cells: Iterable[object]) -> str:
    """One row, without a newline."""
    return f"| {' | '.join(map(str, cells))} |"


def write_csv(path: str | Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A header and one line for each row, all digits; the file is written atomically."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_text(path, text.getvalue())
