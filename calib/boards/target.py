"""Calibration boards: their specification as text, their points, and how to print them.

A board is specified by a short text:

- ``chessboard:9x6:25mm``: inner corners across x down (as OpenCV counts them), side of a square;
- ``charuco:8x6:30mm``: squares across x down, side of a square; then, if wanted, the markers' side and their
  dictionary, ``charuco:8x6:30mm:22mm:5x5``, and ``legacy`` for boards drawn by OpenCV before 4.6;
- ``circles:7x5:20mm``: circles across x down, distance between centres;
- ``acircles:4x11:20mm``: circles in every row x rows, distance between rows (OpenCV's asymmetric grid).

Points are (x, y, 0) in metres: x along the rows, y down the columns, z into the board, the first point at the origin.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
FORMS = "chessboard:9x6:25mm (inner corners), charuco:8x6:30mm (squares), circles:7x5:20mm or acircles:4x11:20mm"
LARGEST = 100


@dataclass(frozen=True)
class Board(ABC):
    """A flat grid of points, `columns` x `rows` of them, `spacing` metres apart."""

    columns: int
    rows: int
    spacing: float

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the points on the board, metres, row by row."""
        return _grid(self.columns, self.rows) * self.spacing

    @cached_property
    def symmetries(self) -> tuple[Int[np.ndarray, " n"], ...]:
        """The renumberings of the points under rotations of the board, the identity first.

        A detector may number the points in any of these ways: colours do not disambiguate them, as they are inverted
        in some images (near infrared).
        """
        points = self.points[:, :2] - (self.points[:, :2].max(0) + self.points[:, :2].min(0)) / 2
        found = []
        for quarter_turns in range(4):
            rotated = points @ np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), quarter_turns)
            distance = np.linalg.norm(rotated[:, None] - points[None], axis=-1)
            image = distance.argmin(1)
            if distance.min(1).max() < 0.01 * self.spacing:
                found.append(image)
        return tuple(found)

    @property
    def part(self) -> Int[np.ndarray, " n"]:
        """The board that each point is on: 0, unless several boards are used at once."""
        return np.zeros(len(self.points), dtype=int)

    @property
    def extents(self) -> list[tuple[float, float]]:
        """`extent` of each board."""
        return [self.extent]

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height of the print without its margin, metres: the squares around the corners."""
        return (self.columns + 1) * self.spacing, (self.rows + 1) * self.spacing

    @abstractmethod
    def _draw(self, axes: Any) -> None:
        """Draw the board with its corner at (0, 0), in millimetres, y down."""


@dataclass(frozen=True)
class Chessboard(Board):
    """`columns` x `rows` inner corners."""

    def __str__(self) -> str:
        return f"chessboard:{self.columns}x{self.rows}:{_millimetres(self.spacing)}"

    def _draw(self, axes: Any) -> None:
        side = 1e3 * self.spacing
        for row in range(self.rows + 1):
            for column in range(row % 2, self.columns + 1, 2):
                axes.add_patch(_black(column * side, row * side, side, side))


@dataclass(frozen=True)
class Charuco(Board):
    """A chessboard with markers in its white squares; `columns` x `rows` counts its inner corners.

    Corners are identified individually: a part of the board is enough, and its orientation is unambiguous.
    """

    marker: float
    dictionary: str
    legacy: bool = False

    @cached_property
    def opencv(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board, lengths in metres."""
        size = self.columns + 1, self.rows + 1
        board = cv2.aruco.CharucoBoard(size, self.spacing, self.marker, marker_dictionary(self.dictionary))
        board.setLegacyPattern(self.legacy)
        return board

    @property
    def symmetries(self) -> tuple[Int[np.ndarray, " n"], ...]:  # type: ignore[override]
        """The identity alone."""
        return (np.arange(len(self.points)),)

    def __str__(self) -> str:
        squares = f"{self.columns + 1}x{self.rows + 1}"
        tail = ":legacy" if self.legacy else ""
        lengths = f"{_millimetres(self.spacing)}:{_millimetres(self.marker)}"
        return f"charuco:{squares}:{lengths}:{self.dictionary.lower()}{tail}"

    def _draw(self, axes: Any) -> None:
        side, marker = 1e3 * self.spacing, 1e3 * self.marker
        white = set()
        for corners, number in zip(np.array(self.opencv.getObjPoints()), np.array(self.opencv.getIds()).reshape(-1)):
            left, top = (1e3 * float(v) for v in corners[:, :2].min(0))
            white.add((int(left // side), int(top // side)))
            self._draw_marker(axes, int(number), left, top, marker)
        for column, row in np.ndindex(self.columns + 1, self.rows + 1):
            if (column, row) not in white:
                axes.add_patch(_black(column * side, row * side, side, side))

    def _draw_marker(self, axes: Any, number: int, left: float, top: float, side: float) -> None:
        """Runs of black bits as one rectangle each: no hairlines between bits."""
        dictionary = marker_dictionary(self.dictionary)
        bits = dictionary.markerSize + 2
        black = np.asarray(cv2.aruco.generateImageMarker(dictionary, number, bits) == 0)
        step = side / bits
        for row, line in enumerate(black):
            edges: np.ndarray = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
            for begin, end in edges.reshape(-1, 2).tolist():
                axes.add_patch(_black(left + begin * step, top + row * step, (end - begin) * step, step))


@dataclass(frozen=True)
class Circles(Board):
    """Black circles on white, in rows; in an asymmetric grid every other row is shifted by half their distance."""

    asymmetric: bool = False

    def __str__(self) -> str:
        name = "acircles" if self.asymmetric else "circles"
        return f"{name}:{self.columns}x{self.rows}:{_millimetres(self.spacing)}"

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the centres on the board, metres, row by row."""
        grid = _grid(self.columns, self.rows)
        if self.asymmetric:
            grid[:, 0] = 2 * grid[:, 0] + grid[:, 1] % 2
        return grid * self.spacing

    @property
    def radius(self) -> float:
        """Radius of the printed circles, metres."""
        return 0.3 * self.spacing * (2**0.5 if self.asymmetric else 1)

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height of the print without its margin, metres."""
        width, height = (float(v) + 2 * self.radius for v in self.points[:, :2].max(0))
        return width, height

    def _draw(self, axes: Any) -> None:
        radius = 1e3 * self.radius
        for x, y in (1e3 * self.points[:, :2] + radius).tolist():
            axes.add_patch(Circle((x, y), radius, facecolor="black", edgecolor="none"))


def parse_board(text: str) -> Board:
    """The board that a text specifies, such as ``charuco:8x6:30mm``; see the module. Raises ValueError."""
    kind, _, rest = text.strip().lower().partition(":")
    parts = rest.split(":")
    if kind not in ("chessboard", "charuco", "circles", "acircles") or len(parts) < 2:
        raise ValueError(f"board '{text}' is not recognised: write it like {FORMS}")
    columns, rows = _counts(text, parts[0])
    spacing = _length(text, parts[1])
    if kind == "charuco":
        return _charuco(text, columns, rows, spacing, parts[2:])
    if len(parts) > 2:
        raise ValueError(f"board '{text}': '{parts[2]}' is unexpected; write it like {FORMS}")
    if kind == "chessboard":
        return Chessboard(columns, rows, spacing)
    return Circles(columns, rows, spacing, asymmetric=kind == "acircles")


def draw_board(board: Board, *, margin: float = 0.012) -> Figure:
    """The board as a figure whose size in inches is its true size, with a white margin (metres) and a ruler below.

    Saved as PDF or SVG it prints at true size; the ruler serves to check it.
    """
    width, height = (1e3 * v for v in board.extent)
    edge, below = 1e3 * margin, 14.0
    total = width + 2 * edge, height + 2 * edge + below
    figure = Figure(figsize=(total[0] / 25.4, total[1] / 25.4), facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-edge, width + edge), ylim=(height + edge + below, -edge))
    axes.set_axis_off()
    board._draw(axes)
    _draw_ruler(axes, str(board), width, height + edge + 2)
    return figure


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a name such as "4x4_50"."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))


def _draw_ruler(axes: Any, text: str, width: float, y: float) -> None:
    """A line of a whole number of centimetres with a tick at each, and the board's name."""
    length = max(10.0, 10 * (min(width, 100.0) // 10))
    axes.plot([0, length], [y, y], color="0.4", lw=0.6)
    for x in np.arange(0, length + 1, 10):
        axes.plot([x, x], [y, y + 2], color="0.4", lw=0.6)
    note = f"{length:g} mm; print at 100 %, glue it flat, then measure this line.  {text}"
    axes.text(0, y + 4, note, fontsize=min(7.0, 0.045 * width), color="0.4", va="top", family="sans-serif")


def _black(x: float, y: float, width: float, height: float) -> Rectangle:
    return Rectangle((x, y), width, height, facecolor="black", edgecolor="none", snap=False)


def _grid(columns: int, rows: int) -> np.ndarray:
    grid = np.zeros((rows, columns, 3))
    grid[..., 0], grid[..., 1] = np.arange(columns), np.arange(rows)[:, None]
    return grid.reshape(-1, 3)


def _charuco(text: str, columns: int, rows: int, spacing: float, options: list[str]) -> Charuco:
    lengths = [o for o in options if re.fullmatch(r"[\d.]+ *[a-z]+", o)]
    names = [o for o in options if re.fullmatch(r"\d+x\d+(_\d+)?", o) or o.startswith("aruco") or o.startswith("april")]
    recognised = {*lengths[:1], *names[:1], "legacy"}
    if rest := [o for o in options if o not in recognised]:
        raise ValueError(f"board '{text}': '{rest[0]}' is not recognised; write it like charuco:8x6:30mm:22mm:4x4_50")
    marker = _length(text, lengths[0]) if lengths else 0.75 * spacing
    if not marker < spacing:
        raise ValueError(
            f"board '{text}': markers of {_millimetres(marker)} do not fit into squares that are no larger"
        )
    name = _dictionary_name(text, names[0] if names else "4x4", (columns * rows + 1) // 2)
    return Charuco(columns - 1, rows - 1, spacing, marker=marker, dictionary=name, legacy="legacy" in options)


def _dictionary_name(text: str, name: str, markers: int) -> str:
    """The smallest dictionary of a kind that has enough markers; larger ones begin with the same markers."""
    names = [name.upper()] if "_" in name else [f"{name.upper()}_{n}" for n in (50, 100, 250, 1000)]
    for full in names:
        if hasattr(cv2.aruco, f"DICT_{full}") and len(marker_dictionary(full).bytesList) >= markers:
            return full.lower()
    raise ValueError(f"board '{text}': no dictionary '{name}' of OpenCV has the {markers} markers it needs; try 4x4")


def _counts(text: str, part: str) -> tuple[int, int]:
    if not (match := re.fullmatch(r"(\d+)x(\d+)", part)):
        raise ValueError(f"board '{text}': '{part}' is not a count like 8x6; write it like {FORMS}")
    columns, rows = int(match[1]), int(match[2])
    if not (3 <= columns <= LARGEST and 3 <= rows <= LARGEST):
        raise ValueError(f"board '{text}': {columns}x{rows} is out of range; both are 3 to {LARGEST}")
    return columns, rows


def _length(text: str, part: str) -> float:
    match = re.fullmatch(r"(\d*\.?\d+) *(mm|cm|m|in)", part)
    if not match or float(match[1]) == 0:
        raise ValueError(f"board '{text}': '{part}' is not a length like 30mm (units: {', '.join(UNITS)})")
    return float(match[1]) * UNITS[match[2]]


def _millimetres(length: float) -> str:
    return f"{1e3 * length:.6g}mm"
