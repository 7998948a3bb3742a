"""Calibration boards: their specification as text, their points, and how to print them.

A board is specified by a short text:

- ``chessboard:9x6:25mm``: inner corners across x down (as OpenCV counts them), side of a square;
- ``charuco:8x6:30mm``: squares across x down, side of a square; then, if wanted, the markers' side and their
  dictionary, ``charuco:8x6:30mm:22mm:5x5``, and ``legacy`` for boards drawn by OpenCV before 4.6;
- ``circles:7x5:20mm``: circles across x down, distance between centres;
- ``acircles:4x11:20mm``: circles in every row x rows, distance between rows (OpenCV's asymmetric grid);
- ``aprilgrid:6x6:88mm:0.3``: tags across x down, side of a tag, space between tags as a share of it (Kalibr's layout,
  tag family 36h11; ``border1`` for tags with one black bit around them instead of two); or Kalibr's own target file.

- ``targets.csv:4x4``: markers at known positions (see `known_points`).

``from24`` at the end of a board with markers: its first marker has this number, so that several boards differ.

Points are (x, y, 0) in metres: x along the rows, y down the columns, z into the board, the first point at the origin.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import yaml
from jaxtyping import Float, Int
from matplotlib.patches import Circle, Rectangle

from arraygeom.safe_yaml import load_yaml

from .board import Board, MarkedBoard, marker_dictionary, smallest_dictionary, unit_grid
from .known_points import known_points

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
FORMS = (
    "chessboard:9x6:25mm (inner corners), charuco:8x6:30mm (squares), circles:7x5:20mm, acircles:4x11:20mm or "
    "aprilgrid:6x6:88mm:0.3 (tags)"
)
LARGEST = 100
APRIL_TAGS = "apriltag_36h11"


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
class Charuco(MarkedBoard):
    """A chessboard with markers in its white squares; `columns` x `rows` counts its inner corners."""

    marker: float
    legacy: bool = False

    @property
    def markers(self) -> range:
        """The numbers of its markers."""
        return range(self.first, self.first + (self.columns + 1) * (self.rows + 1) // 2)

    @cached_property
    def opencv(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board, lengths in metres."""
        size = self.columns + 1, self.rows + 1
        ids = np.array(self.markers)
        board = cv2.aruco.CharucoBoard(size, self.spacing, self.marker, marker_dictionary(self.dictionary), ids)
        board.setLegacyPattern(self.legacy)
        return board

    def __str__(self) -> str:
        squares = f"{self.columns + 1}x{self.rows + 1}"
        tail = (":legacy" if self.legacy else "") + (f":from{self.first}" if self.first else "")
        lengths = f"{_millimetres(self.spacing)}:{_millimetres(self.marker)}"
        return f"charuco:{squares}:{lengths}:{self.dictionary.lower()}{tail}"

    def _draw(self, axes: Any) -> None:
        side, marker = 1e3 * self.spacing, 1e3 * self.marker
        white = set()
        for corners, number in zip(np.array(self.opencv.getObjPoints()), np.array(self.opencv.getIds()).reshape(-1)):
            left, top = (1e3 * float(v) for v in corners[:, :2].min(0))
            white.add((int(left // side), int(top // side)))
            _draw_marker(axes, self.dictionary, int(number), left, top, marker)
        for column, row in np.ndindex(self.columns + 1, self.rows + 1):
            if (column, row) not in white:
                axes.add_patch(_black(column * side, row * side, side, side))


@dataclass(frozen=True)
class AprilGrid(MarkedBoard):
    """Kalibr's grid of AprilTags; `columns` x `rows` counts the corners of all tags, `spacing` is twice the gap.

    tag: side of a tag, metres; border: black bits around its code. Tags are numbered row by row from below.
    """

    tag: float
    border: int = 2

    @property
    def gap(self) -> float:
        """The space between two tags, metres."""
        return self.spacing / 2

    @property
    def markers(self) -> range:
        """The numbers of its tags."""
        return range(self.first, self.first + self.columns * self.rows // 4)

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the tags' corners on the board, metres, row by row."""
        grid = unit_grid(self.columns, self.rows)
        return (grid // 2) * (self.tag + self.gap) + (grid % 2) * self.tag

    @cached_property
    def corners(self) -> Int[np.ndarray, "m 4"]:
        """The points at the upper left, upper right, lower right and lower left corner of each tag."""
        index = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        a, b = index[::2][::-1], index[1::2][::-1]
        return np.stack([a[:, ::2], a[:, 1::2], b[:, 1::2], b[:, ::2]], -1).reshape(-1, 4)

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height of the print without its margin, metres: the small squares at the tags' corners."""
        width, height = (float(v) + 2 * self.gap for v in self.points[:, :2].max(0))
        return width, height

    @property
    def offset(self) -> float:
        """The gap, metres."""
        return self.gap

    def __str__(self) -> str:
        tail = (":border1" if self.border == 1 else "") + (f":from{self.first}" if self.first else "")
        return (
            f"aprilgrid:{self.columns // 2}x{self.rows // 2}:{_millimetres(self.tag)}:{self.gap / self.tag:.6g}{tail}"
        )

    def _draw(self, axes: Any) -> None:
        tag, gap = 1e3 * self.tag, 1e3 * self.gap
        for number, corners in zip(self.markers, self.corners):
            left, top = 1e3 * self.points[corners[0], :2] + gap
            _draw_marker(axes, self.dictionary, number, left, top, tag, border=self.border, quarter_turns=2)
        for column, row in np.ndindex(self.columns // 2 + 1, self.rows // 2 + 1):
            axes.add_patch(_black(column * (tag + gap), row * (tag + gap), gap, gap))


@dataclass(frozen=True)
class Boards(Board):
    """Several boards seen at once, each with poses of its own; their points in one list."""

    boards: tuple[Board, ...] = ()
    identified: ClassVar[bool] = True

    @property
    def members(self) -> tuple[Board, ...]:
        """The boards."""
        return self.boards

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """The points of all boards, each in its own frame, metres."""
        return np.concatenate([b.points for b in self.boards])

    @cached_property
    def part(self) -> Int[np.ndarray, " n"]:
        """The board that each point is on."""
        return np.repeat(np.arange(len(self.boards)), [len(b.points) for b in self.boards])

    @property
    def extents(self) -> list[tuple[float, float]]:
        """`extent` of each board."""
        return [b.extent for b in self.boards]

    def __str__(self) -> str:
        return " and ".join(map(str, self.boards))

    def _draw(self, axes: Any) -> None:
        raise ValueError("several boards are printed one by one")


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
        grid = unit_grid(self.columns, self.rows)
        if self.asymmetric:
            grid[:, 0] = 2 * grid[:, 0] + grid[:, 1] % 2
        return grid * self.spacing

    @property
    def radius(self) -> float:
        """Radius of the printed circles, metres."""
        return 0.3 * self.spacing * (2**0.5 if self.asymmetric else 1)

    @property
    def offset(self) -> float:
        """A circle's radius, metres."""
        return self.radius

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
    """The board that a text specifies, such as ``charuco:8x6:30mm``; see the module.

    Raises ValueError, or FileNotFoundError for a file that is not there.
    """
    if text.lower().endswith((".yaml", ".yml")):
        text = _kalibr_target(Path(text))
    if ".csv" in text:
        return known_points(text)
    kind, _, rest = text.strip().lower().partition(":")
    parts = rest.split(":")
    if kind not in ("chessboard", "charuco", "circles", "acircles", "aprilgrid") or len(parts) < 2:
        raise ValueError(f"board '{text}' is not recognised: write it like {FORMS}")
    if kind == "aprilgrid":
        return _april_grid(text, parts)
    columns, rows = _counts(text, parts[0])
    spacing = _length(text, parts[1])
    if kind == "charuco":
        return _charuco(text, columns, rows, spacing, parts[2:])
    if len(parts) > 2:
        raise ValueError(f"board '{text}': '{parts[2]}' is unexpected; write it like {FORMS}")
    if kind == "chessboard":
        return Chessboard(columns, rows, spacing)
    return Circles(columns, rows, spacing, asymmetric=kind == "acircles")


def parse_boards(texts: Sequence[str]) -> Board:
    """One board, or several at once, which need markers with numbers of their own. Raises ValueError."""
    boards = [parse_board(text) for text in texts]
    if len(boards) == 1:
        return boards[0]
    used: dict[str, set[int]] = {}
    for board in boards:
        if not isinstance(board, MarkedBoard):
            raise ValueError(f"board '{board}': several boards at once need markers: use charuco or aprilgrid")
        taken = used.setdefault(board.dictionary, set())
        if taken & set(board.markers):
            raise ValueError(
                f"board '{board}': its markers are on another board too: print it with ':from{max(taken) + 1}' at the "
                "end of its name, or with another dictionary"
            )
        taken |= set(board.markers)
    first = boards[0]
    return Boards(first.columns, first.rows, first.spacing, tuple(boards))


def _draw_marker(
    axes: Any,
    dictionary: str,
    number: int,
    left: float,
    top: float,
    side: float,
    *,
    border: int = 1,
    quarter_turns: int = 0,
) -> None:
    """Runs of black bits as one rectangle each: no hairlines between bits."""
    known = marker_dictionary(dictionary)
    bits = known.markerSize + 2 * border
    black = np.rot90(cv2.aruco.generateImageMarker(known, number, bits, borderBits=border) == 0, quarter_turns)
    step = side / bits
    for row, line in enumerate(black):
        edges: np.ndarray = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
        for begin, end in edges.reshape(-1, 2).tolist():
            axes.add_patch(_black(left + begin * step, top + row * step, (end - begin) * step, step))


def _black(x: float, y: float, width: float, height: float) -> Rectangle:
    return Rectangle((x, y), width, height, facecolor="black", edgecolor="none", snap=False)


def _charuco(text: str, columns: int, rows: int, spacing: float, options: list[str]) -> Charuco:
    lengths = [o for o in options if re.fullmatch(r"[\d.]+ *[a-z]+", o)]
    names = [o for o in options if re.fullmatch(r"\d+x\d+(_\d+)?", o) or o.startswith("aruco") or o.startswith("april")]
    first, options = _first_marker(options)
    recognised = {*lengths[:1], *names[:1], "legacy"}
    if rest := [o for o in options if o not in recognised]:
        raise ValueError(f"board '{text}': '{rest[0]}' is not recognised; write it like charuco:8x6:30mm:22mm:4x4_50")
    marker = _length(text, lengths[0]) if lengths else 0.75 * spacing
    if not marker < spacing:
        raise ValueError(
            f"board '{text}': markers of {_millimetres(marker)} do not fit into squares that are no larger"
        )
    name = smallest_dictionary(text, names[0] if names else "4x4", first + (columns * rows + 1) // 2)
    return Charuco(columns - 1, rows - 1, spacing, name, first, marker=marker, legacy="legacy" in options)


def _first_marker(options: list[str]) -> tuple[int, list[str]]:
    """The number in an option such as "from24", and the other options."""
    numbers = [int(o.removeprefix("from")) for o in options if re.fullmatch(r"from\d{1,4}", o)]
    return sum(numbers[:1]), [o for o in options if not re.fullmatch(r"from\d{1,4}", o)]


def _april_grid(text: str, parts: list[str]) -> AprilGrid:
    columns, rows = _counts(text, parts[0], fewest=2)
    first, options = _first_marker(parts[2:])
    ratios = [o for o in options if re.fullmatch(r"\d*\.?\d+", o) and 0.05 <= float(o) <= 1]
    if rest := [o for o in options if o not in {*ratios[:1], "border1", "border2"}]:
        raise ValueError(f"board '{text}': '{rest[0]}' is not recognised; write it like aprilgrid:6x6:88mm:0.3")
    if first + columns * rows > len(marker_dictionary(APRIL_TAGS).bytesList):
        raise ValueError(f"board '{text}': the tag family 36h11 has no {first + columns * rows} tags")
    tag = _length(text, parts[1])
    gap = tag * float(ratios[0] if ratios else 0.3)
    border = 1 if "border1" in options else 2
    return AprilGrid(2 * columns, 2 * rows, 2 * gap, APRIL_TAGS, first, tag=tag, border=border)


def _kalibr_target(path: Path) -> str:
    """The board of Kalibr's target file as text. Raises ValueError, FileNotFoundError."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of a target")
    try:
        target = load_yaml(path.read_text(encoding="utf-8"))
        if target["target_type"] == "aprilgrid":
            size, ratio = 1e3 * float(target["tagSize"]), float(target["tagSpacing"])
            return f"aprilgrid:{target['tagCols']}x{target['tagRows']}:{size:.6f}mm:{ratio:.6f}"
        if target["target_type"] == "checkerboard" and target["rowSpacingMeters"] == target["colSpacingMeters"]:
            size = 1e3 * float(target["rowSpacingMeters"])
            return f"chessboard:{target['targetCols']}x{target['targetRows']}:{size:.6f}mm"
    except (KeyError, TypeError, ValueError, RecursionError, yaml.YAMLError):
        pass
    raise ValueError(f"{path}: not a target of Kalibr's that is known here: an aprilgrid, or a checkerboard of squares")


def _counts(text: str, part: str, *, fewest: int = 3) -> tuple[int, int]:
    if not (match := re.fullmatch(r"(\d+)x(\d+)", part)):
        raise ValueError(f"board '{text}': '{part}' is not a count like 8x6; write it like {FORMS}")
    columns, rows = int(match[1]), int(match[2])
    if not (fewest <= columns <= LARGEST and fewest <= rows <= LARGEST):
        raise ValueError(f"board '{text}': {columns}x{rows} is out of range; both are {fewest} to {LARGEST}")
    return columns, rows


def _length(text: str, part: str) -> float:
    match = re.fullmatch(r"(\d*\.?\d+) *(mm|cm|m|in)", part)
    if not match or float(match[1]) == 0:
        raise ValueError(f"board '{text}': '{part}' is not a length like 30mm (units: {', '.join(UNITS)})")
    return float(match[1]) * UNITS[match[2]]


def _millimetres(length: float) -> str:
    return f"{1e3 * length:.6g}mm"
