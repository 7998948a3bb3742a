"""Calibration boards: points, identifying markers, and drawing.

Points are (x, y, 0) in metres: x along the rows, y down the columns, z into the board, the first point at the
origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Float, Int
from matplotlib.patches import Circle, Rectangle

FLAT = 0.03
"""Relief as a share of extent below which known points count as coplanar."""
ON_A_LINE = 0.01
"""Extent across a line as a share of that along it below which known points count as collinear."""


@dataclass(frozen=True)
class Board:
    """Base class of calibration boards: a flat grid of points in the plane z = 0, x across, y down.

    Subclasses say where they differ. Constructors check next to nothing: `parse_board` does.

    Attributes:
        columns: points in a row.
        rows: number of rows.
        spacing: distance of neighbouring points, metres.
    """

    columns: int
    rows: int
    spacing: float
    identified: ClassVar[bool] = False
    """True if markers identify each point."""

    @property
    def flat(self) -> bool:
        """True if the points lie in a plane."""
        return True

    @property
    def members(self) -> tuple[Board, ...]:
        """Single boards that make up this one; itself unless there are several."""
        return (self,)

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the points on the board, metres, row by row."""
        return unit_grid(self.columns, self.rows) * self.spacing

    @cached_property
    def symmetries(self) -> tuple[Int[np.ndarray, " n"], ...]:
        """Renumberings of the points under quarter turns that map the board onto itself, the identity first.

        A detector may number the points in any of these ways, as colours, inverted in some images (near
        infrared), do not count. Each is an array (n) of integers, the new number of every point. Boards with
        markers have the identity only.
        """
        if self.identified:
            return (np.arange(len(self.points)),)
        points = (self.points - self.middle)[:, :2]
        symmetries = []
        for quarter_turns in range(4):
            rotated = points @ np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), quarter_turns)
            distance = np.linalg.norm(rotated[:, None] - points[None], axis=-1)
            if distance.min(1).max() < 0.01 * self.spacing:
                symmetries.append(distance.argmin(1))
        return tuple(symmetries)

    @cached_property
    def part(self) -> Int[np.ndarray, " n"]:
        """Index of the single board that each point is on: 0 unless there are several."""
        return np.repeat(np.arange(len(self.members)), [len(b.points) for b in self.members])

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """Midpoint between the outermost points, metres."""
        return np.asarray((self.points.max(0) + self.points.min(0)) / 2)

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height of the print without its margin, metres."""
        width, height, _ = (np.ptp(self.points, axis=0) + 2 * self.offset).tolist()
        return width, height

    @property
    def offset(self) -> float:
        """Distance of the first point from the upper and left edge of the print without margin, metres."""
        return self.spacing

    def _draw(self, axes: Any) -> None:
        """Draw the board with its corner at (0, 0), in millimetres, y down."""
        raise ValueError(f"{self} cannot be printed: print boards one by one; points in space have no print")


@dataclass(frozen=True)
class MarkedBoard(Board):
    """Board whose points are identified by markers: a part of it is enough, its orientation is unambiguous.

    The fields of `Board` come first.

    Attributes:
        dictionary: name of OpenCV's dictionary of markers, such as "4x4_50".
        markers: number in the dictionary of each marker of the board; a tuple or range, ascending.
    """

    dictionary: str
    markers: Sequence[int]
    identified: ClassVar[bool] = True

    @property
    def _from(self) -> str:
        return f":from{self.markers[0]}" if self.markers[0] else ""

    def _draw_marker(
        self, axes: Any, number: int, left: float, top: float, side: float, *, border: int = 1, turns: int = 0
    ) -> None:
        """Draw a marker with runs of black bits as one rectangle each, without hairlines between bits."""
        dictionary = marker_dictionary(self.dictionary)
        bits = dictionary.markerSize + 2 * border
        black = np.rot90(
            cv2.aruco.generateImageMarker(dictionary, number, bits, borderBits=border) == 0, turns
        )
        step = side / bits
        for row, line in enumerate(black):
            edges: np.ndarray = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
            for begin, end in edges.reshape(-1, 2).tolist():
                axes.add_patch(_black(left + begin * step, top + row * step, (end - begin) * step, step))


@dataclass(frozen=True)
class Chessboard(Board):
    """Chessboard of `columns` x `rows` inner corners, squares `spacing` metres wide."""

    def __str__(self) -> str:
        return f"chessboard:{self.columns}x{self.rows}:{millimetres(self.spacing)}"

    def _draw(self, axes: Any) -> None:
        side = 1e3 * self.spacing
        for row in range(self.rows + 1):
            for column in range(row % 2, self.columns + 1, 2):
                axes.add_patch(_black(column * side, row * side, side, side))


@dataclass(frozen=True)
class Charuco(MarkedBoard):
    """Chessboard with markers in its white squares; `columns` x `rows` counts inner corners, its points.

    The fields of `Board` (`spacing` is a square's side) and `MarkedBoard` come first.

    Attributes:
        marker: side of a marker, metres, less than `spacing`.
        legacy: True for the layout of OpenCV before 4.6.

    Raises:
        ValueError: for a marker that does not fit.
    """

    marker: float
    legacy: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.marker < self.spacing:
            raise ValueError(f"board '{self}': its markers do not fit into its squares")

    @cached_property
    def opencv(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board, lengths in metres."""
        size = self.columns + 1, self.rows + 1
        dictionary = marker_dictionary(self.dictionary)
        board = cv2.aruco.CharucoBoard(size, self.spacing, self.marker, dictionary, np.array(self.markers))
        board.setLegacyPattern(self.legacy)
        return board

    def __str__(self) -> str:
        squares = f"{self.columns + 1}x{self.rows + 1}"
        tail = (":legacy" if self.legacy else "") + self._from
        lengths = f"{millimetres(self.spacing)}:{millimetres(self.marker)}"
        return f"charuco:{squares}:{lengths}:{self.dictionary.lower()}{tail}"

    def _draw(self, axes: Any) -> None:
        side, marker = 1e3 * self.spacing, 1e3 * self.marker
        white, places = set(), np.array(self.opencv.getObjPoints())
        for corners, number in zip(places, np.array(self.opencv.getIds()).reshape(-1)):
            left, top = (1e3 * float(v) for v in corners[:, :2].min(0))
            white.add((int(left // side), int(top // side)))
            self._draw_marker(axes, int(number), left, top, marker)
        for column, row in np.ndindex(self.columns + 1, self.rows + 1):
            if (column, row) not in white:
                axes.add_patch(_black(column * side, row * side, side, side))


@dataclass(frozen=True)
class AprilGrid(MarkedBoard):
    """Kalibr's grid of AprilTags. Its points are the corners of all tags, four each.

    The fields of `Board` and `MarkedBoard` come first. Tags are numbered row by row from below, without gaps,
    points from above. `columns` and `rows` count points, two for each tag; `spacing` is twice the gap between
    two tags, metres.

    Attributes:
        tag: side of a tag, metres.
        border: black bits around a tag's code.
    """

    tag: float
    border: int = 2

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the tags' corners on the board, metres, row by row."""
        grid = unit_grid(self.columns, self.rows)
        return (grid // 2) * (self.tag + self.gap) + (grid % 2) * self.tag

    @cached_property
    def corners(self) -> Int[np.ndarray, "m 4"]:
        """Points at the upper left, upper right, lower right and lower left corner of each tag."""
        index = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        a, b = index[::2][::-1], index[1::2][::-1]
        return np.stack([a[:, ::2], a[:, 1::2], b[:, 1::2], b[:, ::2]], -1).reshape(-1, 4)

    @property
    def gap(self) -> float:
        """Space between two tags, metres."""
        return self.spacing / 2

    @property
    def offset(self) -> float:
        """Gap in metres: small squares fill it at the tags' corners."""
        return self.gap

    def __str__(self) -> str:
        tail = (":border1" if self.border == 1 else "") + self._from
        tags = f"{self.columns // 2}x{self.rows // 2}"
        return f"aprilgrid:{tags}:{millimetres(self.tag)}:{self.gap / self.tag:.6g}{tail}"

    def _draw(self, axes: Any) -> None:
        tag, gap = 1e3 * self.tag, 1e3 * self.gap
        for number, corners in zip(self.markers, self.corners):
            left, top = 1e3 * self.points[corners[0], :2] + gap
            self._draw_marker(axes, number, left, top, tag, border=self.border, turns=2)
        for column, row in np.ndindex(self.columns // 2 + 1, self.rows // 2 + 1):
            axes.add_patch(_black(column * (tag + gap), row * (tag + gap), gap, gap))


@dataclass(frozen=True)
class Boards(Board):
    """Several boards in view at once, each with its own pose; their points form one list, each in its own
    board's frame.

    `columns`, `rows` and `spacing` are the first board's.

    Attributes:
        boards: the single boards, at least one, whose markers all differ (which is not checked).
    """

    boards: tuple[Board, ...] = ()
    identified: ClassVar[bool] = True

    @property
    def members(self) -> tuple[Board, ...]:
        """The single boards."""
        return self.boards

    @property
    def flat(self) -> bool:
        """True if the points of each board lie in a plane."""
        return all(board.flat for board in self.boards)

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Points of all boards, each in its own board's frame, metres."""
        return np.concatenate([b.points for b in self.boards])

    def __str__(self) -> str:
        return " and ".join(map(str, self.boards))


@dataclass(frozen=True)
class Circles(Board):
    """Grid of black circles on white, `columns` x `rows`.

    The points are their centres. In an asymmetric grid circles of a row are 2 `spacing` apart, rows are
    `spacing` apart, and every second row is shifted by one `spacing`.

    Attributes:
        asymmetric: True for OpenCV's asymmetric grid.
    """

    asymmetric: bool = False

    def __str__(self) -> str:
        name = "acircles" if self.asymmetric else "circles"
        return f"{name}:{self.columns}x{self.rows}:{millimetres(self.spacing)}"

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
        """Radius of a circle, metres."""
        return self.radius

    def _draw(self, axes: Any) -> None:
        radius = 1e3 * self.radius
        for x, y in (1e3 * self.points[:, :2] + radius).tolist():
            axes.add_patch(Circle((x, y), radius, facecolor="black", edgecolor="none"))


@dataclass(frozen=True)
class KnownPoints(MarkedBoard):
    """Points at surveyed positions: centres or corners of markers.

    The fields of `Board` and `MarkedBoard` come first: `columns` is the number of points, `rows` 1, `spacing`
    their median distance from the nearest other.

    Attributes:
        file: file that they were read from.
        ids: (marker, corner) of each point; corners clockwise from the marker's upper left, -1 for its
            centre.
        positions: (x, y, z) of each point, metres, in any frame; `points` are about their mean, and,
            if coplanar, in the axes of their plane.
    """

    file: str
    ids: tuple[tuple[int, int], ...]
    positions: tuple[tuple[float, float, float], ...]

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Positions about their mean, metres; in the axes of their own plane if they are coplanar."""
        points = np.array(self.positions, dtype=np.float64)
        points -= points.mean(0)
        if not self.flat:
            return points
        axes = np.linalg.svd(points)[2]
        return np.asarray(points @ (axes * np.array([1, 1, np.linalg.det(axes)])[:, None]).T)

    @cached_property
    def flat(self) -> bool:
        """True if the points are so nearly coplanar that cameras need several views of them."""
        points = np.array(self.positions, dtype=np.float64)
        first, *_, third = np.linalg.svd(points - points.mean(0), compute_uv=False)
        return bool(third / first < FLAT)

    @property
    def offset(self) -> float:
        """Always 0: nothing is printed around the points."""
        return 0.0

    def __str__(self) -> str:
        return f"{self.file}:{self.dictionary}"


def unit_grid(columns: int, rows: int) -> Float[np.ndarray, "n 3"]:
    """Return the points (x, y, 0) of a grid of spacing 1, row by row."""
    grid = np.zeros((rows, columns, 3))
    grid[..., 0], grid[..., 1] = np.arange(columns), np.arange(rows)[:, None]
    return grid.reshape(-1, 3)


def on_a_line(points: Float[np.ndarray, "n 3"]) -> bool:
    """Return True if points are collinear, which leaves a camera's pose undetermined."""
    along, across, _ = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(across <= ON_A_LINE * along)


def apart(points: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
    """Compute the distance of each point from its nearest neighbour."""
    return np.asarray(np.sort(np.linalg.norm(points[:, None] - points, axis=-1), axis=1)[:, 1])


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's marker dictionary of a name such as "4x4_50"; AttributeError for another name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))


def millimetres(length: float) -> str:
    """Format a length in metres as millimetres, such as "30mm"."""
    return f"{1e3 * length:.6g}mm"


def _black(x: float, y: float, width: float, height: float) -> Rectangle:
    return Rectangle((x, y), width, height, facecolor="black", edgecolor="none", snap=False)
