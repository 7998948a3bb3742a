"""Tables in Markdown and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from arraygeom.runtime.atomic import write_text

from ...support.metrics import bootstrap_interval

T = TypeVar("T")


def grouped(rows: Iterable[T], *names: str) -> dict[Any, list[T]]:
    """Group rows by one attribute, or by a tuple of several, in order of first appearance.

    Args:
        rows: named tuples or other objects.
        names: names of attributes, at least one; AttributeError for one that a row lacks.

    Returns:
        Lists of rows by the value of the one attribute, or by the tuple of several.
    """
    groups: dict[Any, list[T]] = {}
    for row in rows:
        groups.setdefault(attrgetter(*names)(row), []).append(row)
    return groups


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[object]], *, align: str = "lr") -> str:
    """Format a Markdown table: header, rule and rows, each with a newline.

    Args:
        align: one letter, l or r, for each column; the last one repeats.
    """
    return "".join(f"{line}\n" for line in (markdown_header(columns, align=align), *map(markdown_row, rows)))


def markdown_header(columns: Sequence[str], *, align: str = "lr") -> str:
    """Format header and rule of a Markdown table, for tables printed row by row; see `markdown_table`.

    Returns:
        Two lines, without a newline at the end.
    """
    letters = align.ljust(len(columns), align[-1])
    rule = markdown_row("---:" if letters[i] == "r" else "---" for i in range(len(columns)))
    return markdown_row(columns).replace("|  |", "| |") + "\n" + rule


def markdown_row(cells: Iterable[object]) -> str:
    """Format one row of a Markdown table, without a newline. Cells with "|" are not escaped."""
    return f"| {' | '.join(map(str, cells))} |"


def interval_cell(values: Sequence[float]) -> str:
    """Format the 95% bootstrap interval of a mean, to stand behind it, as " (31.20 to 31.85)".

    Returns:
        The text, to two decimals; empty for fewer than two values.
    """
    return " ({:.2f} to {:.2f})".format(*bootstrap_interval(values)) if len(values) > 1 else ""


def write_csv(path: str | Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file, atomically, with all digits of numbers.

    Args:
        path: file, replaced if there is one; missing folders are made.
        columns: cells of the header.
        rows: cells of each line; None is written as an empty cell, NaN as "nan".

    Raises:
        OSError: if it cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_text(path, text.getvalue())
