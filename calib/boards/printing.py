"""Boards drawn at their true size, and the sheets they fit on."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from .board import Board

PAPERS = {
    "A4": (210, 297),
    "letter": (216, 279),
    "A3": (297, 420),
    "A2": (420, 594),
    "A1": (594, 841),
    "A0": (841, 1189),
}
"""Sheets of printers, millimetres."""
BELOW = 14.0
"""Millimetres below a board, for its ruler and name."""


def page_of(board: Board, *, margin: float = 0.012) -> tuple[float, float]:
    """Width and height of the page that a board is drawn on, with margins and ruler, millimetres."""
    width, height = (1e3 * (v + 2 * margin) for v in board.extent)
    return width, height + BELOW


def smallest_paper(page: tuple[float, float]) -> str | None:
    """The smallest sheet that a page (millimetres) fits on, upright or across; None if none is large enough."""
    fitting = [name for name, paper in PAPERS.items() if all(a <= b for a, b in zip(sorted(page), paper))]
    return fitting[0] if fitting else None


def page_note(board: Board) -> str:
    """What to print a board on."""
    page = page_of(board)
    size = f"the page is {page[0]:.0f} x {page[1]:.0f} mm"
    if (paper := smallest_paper(page)) is None:
        return f"{size}, larger than A0: have it plotted, or use smaller squares"
    return f"{size}: print it on {paper} or larger at 100 %, not fitted to the page, then measure its ruler"


def draw_board(board: Board, *, margin: float = 0.012, paper: str | None = None) -> Figure:
    """The board as a figure whose size in inches is its true size, with a white margin (metres) and a ruler below.

    Saved as PDF or SVG it prints at true size; the ruler serves to check it. On a sheet of `paper` ("A4") it is in the
    middle. Raises ValueError if it does not fit there.
    """
    width, height = (1e3 * v for v in board.extent)
    page = page_of(board, margin=margin)
    total = page if paper is None else _sheet(paper, page)
    left, top = ((whole - part) / 2 + 1e3 * margin for whole, part in zip(total, page))
    figure = Figure(figsize=(total[0] / 25.4, total[1] / 25.4), facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-left, total[0] - left), ylim=(total[1] - top, -top))
    axes.set_axis_off()
    board._draw(axes)
    _draw_ruler(axes, str(board), width, height + 1e3 * margin + 2)
    return figure


def _sheet(paper: str, page: tuple[float, float]) -> tuple[float, float]:
    """Width and height of a sheet that a page fits on, upright or across, millimetres."""
    sizes = {name.lower(): size for name, size in PAPERS.items()}
    if paper.lower() not in sizes:
        raise ValueError(f"paper '{paper}' is not known: use one of {', '.join(PAPERS)}")
    short, long = sizes[paper.lower()]
    for sheet in ((short, long), (long, short)):
        if page[0] <= sheet[0] and page[1] <= sheet[1]:
            return sheet
    larger = smallest_paper(page)
    raise ValueError(
        f"the board needs {page[0]:.0f} x {page[1]:.0f} mm with its margin and {paper} has {short} x {long}: use "
        f"{f'{larger}, ' if larger else ''}smaller squares or fewer of them"
    )


def _draw_ruler(axes: Any, text: str, width: float, y: float) -> None:
    """A line of a whole number of centimetres with a tick at each, and the board's name."""
    length = max(10.0, 10 * (min(width, 100.0) // 10))
    axes.plot([0, length], [y, y], color="0.4", lw=0.6)
    for x in np.arange(0, length + 1, 10):
        axes.plot([x, x], [y, y + 2], color="0.4", lw=0.6)
    note = f"{length:g} mm; print at 100 %, glue it flat, then measure this line.  {text}"
    axes.text(0, y + 4, note, fontsize=min(7.0, 0.045 * width), color="0.4", va="top", family="sans-serif")
