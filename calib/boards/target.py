"""Calibration boards from text, and their printing.

A board is specified by a short text:

- ``chessboard:9x6:25mm``: inner corners across x down (as OpenCV counts them), side of a square;
- ``charuco:8x6:30mm``: squares across x down, side of a square; then, if wanted, the markers' side and their
  dictionary, ``charuco:8x6:30mm:22mm:5x5``, and ``legacy`` for boards drawn by OpenCV before 4.6;
- ``circles:7x5:20mm``: circles across x down, distance between centres;
- ``acircles:4x11:20mm``: circles in every row x rows, distance between rows (OpenCV's asymmetric grid);
- ``aprilgrid:6x6:88mm:0.3``: tags across x down, side of a tag, space between tags as a share of it (Kalibr's
  layout, tag family 36h11; ``border1`` for tags with one black bit around them instead of two); or Kalibr's
  own target file;
- ``targets.csv:4x4``: markers at known positions, on a wall, in a frame, in a room (columns id, x, y, z or
  id, corner, x, y, z, in metres).

``from24`` at the end of a board with markers: its first marker has this number, so that several boards
differ.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from matplotlib import rc_context
from matplotlib.figure import Figure

from arraygeom.runtime.atomic import write_atomically
from arraygeom.runtime.safe_yaml import load_yaml

from .board import (
    AprilGrid,
    Board,
    Boards,
    Charuco,
    Chessboard,
    Circles,
    KnownPoints,
    MarkedBoard,
    apart,
    marker_dictionary,
    on_a_line,
)
from .detect import FEWEST

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
FORMS = (
    "chessboard:9x6:25mm (inner corners), charuco:8x6:30mm:22mm:4x4_50 (squares, markers, dictionary), "
    "circles:7x5:20mm, acircles:4x11:20mm or aprilgrid:6x6:88mm:0.3 (tags, space between them)"
)
LARGEST = 100
APRIL_TAGS = "apriltag_36h11"
FIRST = r"from\d{1,4}"
OPTIONS = {
    "chessboard": {},
    "circles": {},
    "acircles": {},
    "charuco": {
        "length": r"[\d.]+ *[a-z]+",
        "dictionary": r"\d+x\d+(_\d+)?|(aruco|april).*",
        "legacy": "legacy",
        "first": FIRST,
    },
    "aprilgrid": {"ratio": r"\d*\.?\d+", "border": "border[12]", "first": FIRST},
}
"""Patterns of options that may follow the counts and the length of each kind of board."""
COLUMNS = ("id", "x", "y", "z"), ("id", "corner", "x", "y", "z")
"""Columns of a file of points."""
FEWEST_POINTS = 6
"""Least number of points in a target of known points."""
PAPERS = {
    "A4": (210, 297),
    "letter": (216, 279),
    "A3": (297, 420),
    "A2": (420, 594),
    "A1": (594, 841),
    "A0": (841, 1189),
}
"""Paper sizes, millimetres."""
MARGIN = 0.012
"""White margin around a board, metres."""
BELOW = 14.0
"""Millimetres below a board, for its ruler and name."""


def parse_board(text: str) -> Board:
    """Parse the text of a board, such as ``charuco:8x6:30mm``, or read a target file.

    Forms (options: see the module), with counts of 3 (tags: 2) to 100 and lengths in mm, cm, m or in:
    chessboard:9x6:25mm counts inner corners, charuco:8x6:30mm squares (8 inner corners at least),
    circles:7x5:20mm, acircles:4x11:20mm, aprilgrid:6x6:88mm:0.3 tags; Kalibr's target file (.yaml); points in
    a file (.csv, then :DICTIONARY).

    Returns:
        `Chessboard`, `Charuco`, `Circles`, `AprilGrid`, or `KnownPoints` of a .csv file.

    Raises:
        ValueError: for text or a file that is no board, or numbers out of range.
        OSError: for a file that is missing (FileNotFoundError) or cannot be read.
    """
    if text.lower().endswith((".yaml", ".yml")):
        text = _kalibr_target(Path(text))
    if ".csv" in text:
        return _known_points(text)
    kind, *parts = text.strip().lower().split(":")
    if kind not in OPTIONS or len(parts) < 2:
        raise ValueError(f"board '{text}' is not recognised: write it like {FORMS}")
    columns, rows = _counts(text, parts[0], fewest=2 if kind == "aprilgrid" else 3)
    length = _length(text, parts[1])
    options = _options(text, parts[2:], OPTIONS[kind])
    if kind == "aprilgrid":
        return _april_grid(text, columns, rows, length, options)
    if kind == "charuco":
        return _charuco(text, columns, rows, length, options)
    if kind == "chessboard":
        return Chessboard(columns, rows, length)
    return Circles(columns, rows, length, asymmetric=kind == "acircles")


def _options(text: str, options_text: Sequence[str], patterns: Mapping[str, str]) -> dict[str, str]:
    """Options by the name of the pattern that each matches. ValueError for others, and two of one kind."""
    options: dict[str, str] = {}
    for option in options_text:
        name = next((n for n, p in patterns.items() if re.fullmatch(p, option)), None)
        if name is None:
            raise ValueError(f"board '{text}': '{option}' is not recognised; write it like {FORMS}")
        if name in options:
            raise ValueError(f"board '{text}': '{options[name]}' and '{option}' say the same: give one")
        options[name] = option
    return options


def parse_boards(texts: Sequence[str]) -> Board:
    """Parse the texts of one board, or of several that are in view at once and need distinct markers.

    Returns:
        The board, or `Boards`.

    Raises:
        ValueError: for no text or one that is no board, and several boards without markers or with the same.
        OSError: as `parse_board`.
    """
    boards = [parse_board(text) for text in texts]
    if not boards:
        raise ValueError(f"no board is given, and one is needed: write it like {FORMS}")
    if len(boards) == 1:
        return boards[0]
    used: dict[str, set[int]] = {}
    for board in boards:
        if not isinstance(board, MarkedBoard):
            raise ValueError(f"board '{board}': several boards need markers: use charuco or aprilgrid")
        # larger dictionaries of a kind begin with the smaller one's markers
        taken = used.setdefault(re.sub(r"_\d+$", "", board.dictionary), set())
        if taken & set(board.markers):
            raise ValueError(
                f"board '{board}': its markers are on another board too: print it with "
                f"':from{max(taken) + 1}' at the "
                "end of its name, or with another dictionary"
            )
        taken |= set(board.markers)
    first = boards[0]
    return Boards(first.columns, first.rows, first.spacing, tuple(boards))


def _charuco(text: str, columns: int, rows: int, spacing: float, options: Mapping[str, str]) -> Charuco:
    if (corners := (columns - 1) * (rows - 1)) < FEWEST:
        raise ValueError(f"board '{text}': has {corners} inner corners and {FEWEST} is the least")
    marker = _length(text, options["length"]) if "length" in options else 0.75 * spacing
    first = int(options.get("first", "from0")[4:])
    markers = range(first, first + columns * rows // 2)
    name = _smallest_dictionary(text, options.get("dictionary", "4x4"), first + (columns * rows + 1) // 2)
    return Charuco(columns - 1, rows - 1, spacing, name, markers, marker=marker, legacy="legacy" in options)


def _april_grid(text: str, columns: int, rows: int, tag: float, options: Mapping[str, str]) -> AprilGrid:
    ratio, first = float(options.get("ratio", 0.3)), int(options.get("first", "from0")[4:])
    if not 0.05 <= ratio <= 1:
        raise ValueError(f"board '{text}': '{ratio:g}' is not from 0.05 to 1 of a tag")
    markers = range(first, first + columns * rows)
    if markers.stop > len(marker_dictionary(APRIL_TAGS).bytesList):
        raise ValueError(f"board '{text}': the tag family 36h11 has no {markers.stop} tags")
    border = int(options.get("border", "border2")[-1])
    return AprilGrid(2 * columns, 2 * rows, 2 * tag * ratio, APRIL_TAGS, markers, tag=tag, border=border)


def _kalibr_target(path: Path) -> str:
    """Convert Kalibr's target file to a board's text. Raises ValueError, FileNotFoundError."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of a target: check the path")
    try:
        target = load_yaml(path.read_text(encoding="utf-8"))
        if target["target_type"] == "aprilgrid":
            size, ratio = 1e3 * float(target["tagSize"]), float(target["tagSpacing"])
            return f"aprilgrid:{target['tagCols']}x{target['tagRows']}:{size:.6f}mm:{ratio:.6f}"
        if (
            target["target_type"] == "checkerboard"
            and target["rowSpacingMeters"] == target["colSpacingMeters"]
        ):
            size = 1e3 * float(target["rowSpacingMeters"])
            return f"chessboard:{target['targetCols']}x{target['targetRows']}:{size:.6f}mm"
    except (KeyError, TypeError, ValueError, RecursionError, yaml.YAMLError):
        pass
    raise ValueError(f"{path}: not an aprilgrid of Kalibr's, nor a checkerboard of squares")


def _counts(text: str, word: str, *, fewest: int) -> tuple[int, int]:
    if not (match := re.fullmatch(r"(\d+)x(\d+)", word)):
        raise ValueError(f"board '{text}': '{word}' is not a count like 8x6; write it like {FORMS}")
    columns, rows = int(match[1]), int(match[2])
    if not (fewest <= columns <= LARGEST and fewest <= rows <= LARGEST):
        raise ValueError(f"board '{text}': {columns}x{rows} is out of range; both are {fewest} to {LARGEST}")
    return columns, rows


def _length(text: str, word: str) -> float:
    match = re.fullmatch(r"(\d*\.?\d+) *(mm|cm|m|in)", word)
    if not match or float(match[1]) == 0:
        raise ValueError(f"board '{text}': '{word}' is not a length like 30mm (units: {', '.join(UNITS)})")
    return float(match[1]) * UNITS[match[2]]


def _smallest_dictionary(text: str, name: str, markers: int) -> str:
    """Smallest dictionary of a kind with enough markers (all begin alike); ValueError without one."""
    names = [name.upper()] if "_" in name else [f"{name.upper()}_{n}" for n in (50, 100, 250, 1000)]
    for full in names:
        if hasattr(cv2.aruco, f"DICT_{full}") and len(marker_dictionary(full).bytesList) >= markers:
            return full.lower()
    raise ValueError(f"board '{text}': no dictionary '{name}' of OpenCV has {markers} markers; try 4x4")


def _known_points(text: str) -> KnownPoints:
    """Read points of a CSV file `targets.csv`, or `targets.csv:5x5_100` with their dictionary (else 4x4)."""
    file, _, dictionary = text.partition(".csv")
    path = Path(f"{file}.csv")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of points: check the path")
    try:
        with path.open(encoding="utf-8-sig", newline="") as lines:
            table = csv.DictReader(lines, skipinitialspace=True)
            names, points = table.fieldnames or (), list(table)
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a CSV file ({error}): save the table as CSV, UTF-8") from None
    head = tuple(name.strip().lower() for name in names)
    if head not in COLUMNS:
        raise ValueError(f"{path}: begins '{','.join(head)[:60]}': write id,x,y,z or id,corner,x,y,z")
    rows = [_point(path, number, row, head) for number, row in enumerate(points, 2)]
    if len(rows) < FEWEST_POINTS:
        raise ValueError(f"{path}: has {len(rows)} points and {FEWEST_POINTS} is the least")
    ids, positions = zip(*rows)
    if twice := [marker for marker in ids if ids.count(marker) > 1]:
        raise ValueError(f"{path}: marker {twice[0][0]} is there twice")
    name = _smallest_dictionary(text, dictionary.removeprefix(":").lower() or "4x4", max(ids)[0] + 1)
    if on_a_line(np.array(positions)):
        raise ValueError(
            f"{path}: all points lie on a line, about which a camera's pose is not determined: add others"
        )
    spacing = float(np.median(apart(np.array(positions))))
    markers = tuple(sorted({marker for marker, _ in ids}))
    return KnownPoints(len(ids), 1, spacing, name, markers, file=str(path), ids=ids, positions=positions)


def _point(
    path: Path, number: int, row: dict[str, str], head: tuple[str, ...]
) -> tuple[tuple[int, int], tuple[float, float, float]]:
    try:
        values = dict(zip(head, row.values()))
        x, y, z = (float(values[axis]) for axis in "xyz")
        marker, corner = int(values["id"]), int(values.get("corner", -1))
    except (TypeError, ValueError):
        marker, corner, x, y, z = -1, 0, 0.0, 0.0, 0.0
    if marker < 0 or not -1 <= corner <= 3 or not np.isfinite([x, y, z]).all():
        raise ValueError(f"{path}, line {number}: wanted {','.join(head)}, numbers in metres, corners 0 to 3")
    return (marker, corner), (x, y, z)


# Printing ---------------------------------------------------------------------------------------------------


def page_of(board: Board) -> tuple[float, float]:
    """Return width and height of the page that a board is drawn on, with margins and ruler, millimetres."""
    width, height = (1e3 * (v + 2 * MARGIN) for v in board.extent)
    return width, height + BELOW


def smallest_paper(page: tuple[float, float]) -> str | None:
    """Return the smallest sheet that a page (millimetres) fits on, such as "A4"; None if none is."""
    fitting = [name for name, paper in PAPERS.items() if all(a <= b for a, b in zip(sorted(page), paper))]
    return fitting[0] if fitting else None


def page_note(board: Board) -> str:
    """Say which paper to print a board on, in a sentence."""
    page = page_of(board)
    size = f"the page is {page[0]:.0f} x {page[1]:.0f} mm"
    if (paper := smallest_paper(page)) is None:
        return f"{size}, larger than A0: have it plotted, or use smaller squares"
    return f"{size}: print it on {paper} or larger at 100 %, not fitted to the page, then measure its ruler"


def draw_board(board: Board, *, paper: str | None = None) -> Figure:
    """Draw a board at true size, with a white margin and a ruler below to check the print.

    Args:
        board: a single board, no `KnownPoints`.
        paper: sheet of `PAPERS` such as "A4", upright or across, in whose middle the board is drawn; None for
            a page of the board's size.

    Returns:
        The figure; saved as PDF or SVG it prints at true size.

    Raises:
        ValueError: for an unknown sheet, a board that does not fit on it, and boards that cannot be printed.
    """
    width, height = (1e3 * v for v in board.extent)
    page = page_of(board)
    total = page if paper is None else _sheet(paper, page)
    left, top = ((whole - side) / 2 + 1e3 * MARGIN for whole, side in zip(total, page))
    figure = Figure(figsize=(total[0] / 25.4, total[1] / 25.4), facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-left, total[0] - left), ylim=(total[1] - top, -top))
    axes.set_axis_off()
    board._draw(axes)
    _draw_ruler(axes, str(board), width, height + 1e3 * MARGIN + 2)
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
        f"the board needs {page[0]:.0f} x {page[1]:.0f} mm with its margin and {paper} has {short} x {long}: "
        f"use {f'{larger}, ' if larger else ''}smaller squares or fewer of them"
    )


def _draw_ruler(axes: Any, text: str, width: float, y: float) -> None:
    """Draw a line of whole centimetres with ticks, and the board's name."""
    length = max(10.0, 10 * (min(width, 100.0) // 10))
    axes.plot([0, length], [y, y], color="0.4", lw=0.6)
    for x in np.arange(0, length + 1, 10):
        axes.plot([x, x], [y, y + 2], color="0.4", lw=0.6)
    note = f"{length:g} mm; print at 100 %, glue it flat, then measure this line.  {text}"
    axes.text(0, y + 4, note, fontsize=min(7.0, 0.045 * width), color="0.4", va="top", family="sans-serif")


def write_board(board: str, out: Path, *, paper: str | None = None) -> Path:
    """Write a board as PDF or SVG at true size, atomically.

    Args:
        board: text of the board, as `parse_board` reads it.
        out: file to write; missing folders are made.
        paper: sheet of `PAPERS` such as "A4"; None for a page of the board's size.

    Returns:
        The path `out`.

    Raises:
        ValueError: for another suffix, text that is no board, points of a .csv file, an unknown sheet, and a
            board that does not fit on it.
        OSError: as `parse_board`, and if the file cannot be written.
    """
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise ValueError(f"{out}: a board is written as .pdf or .svg, which keep its true size")
    figure = draw_board(parse_board(board), paper=paper)
    with write_atomically(out) as temporary, rc_context({"svg.fonttype": "path"}):
        figure.savefig(temporary)
    return out
