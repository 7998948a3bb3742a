"""What all boards have in common, and the markers that identify the points of some."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import cv2
import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Board(ABC):
    """A flat grid of points, `columns` x `rows` of them, `spacing` metres apart."""

    columns: int
    rows: int
    spacing: float
    identified: ClassVar[bool] = False
    """Whether points are identified one by one, by markers."""

    @property
    def flat(self) -> bool:
        """Whether the points lie in a plane."""
        return True

    @property
    def members(self) -> tuple[Board, ...]:
        """The boards, if there are several."""
        return (self,)

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Positions of the points on the board, metres, row by row."""
        return unit_grid(self.columns, self.rows) * self.spacing

    @cached_property
    def symmetries(self) -> tuple[Int[np.ndarray, " n"], ...]:
        """The renumberings of the points under rotations of the board, the identity first; it alone with markers.

        A detector may number the points in any of these ways: colours do not disambiguate them, as they are inverted
        in some images (near infrared).
        """
        if self.identified:
            return (np.arange(len(self.points)),)
        points = self.points[:, :2] - (self.points[:, :2].max(0) + self.points[:, :2].min(0)) / 2
        found = []
        for quarter_turns in range(4):
            rotated = points @ np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), quarter_turns)
            distance = np.linalg.norm(rotated[:, None] - points[None], axis=-1)
            if distance.min(1).max() < 0.01 * self.spacing:
                found.append(distance.argmin(1))
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

    @property
    def offset(self) -> float:
        """Distance of the first point from the upper and the left edge of the print without its margin, metres."""
        return self.spacing

    @abstractmethod
    def _draw(self, axes: Any) -> None:
        """Draw the board with its corner at (0, 0), in millimetres, y down."""


@dataclass(frozen=True)
class MarkedBoard(Board):
    """A board whose points are identified individually: a part of it is enough, its orientation is unambiguous.

    first: the number of its first marker.
    """

    dictionary: str
    first: int
    identified: ClassVar[bool] = True

    @property
    @abstractmethod
    def markers(self) -> Sequence[int]:
        """The numbers of its markers."""


def unit_grid(columns: int, rows: int) -> Float[np.ndarray, "n 3"]:
    """The points (x, y, 0) of a grid of spacing 1, row by row."""
    grid = np.zeros((rows, columns, 3))
    grid[..., 0], grid[..., 1] = np.arange(columns), np.arange(rows)[:, None]
    return grid.reshape(-1, 3)


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a name such as "4x4_50"."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))


def smallest_dictionary(text: str, name: str, markers: int) -> str:
    """The smallest dictionary of a kind that has enough markers; larger ones begin with the same markers.

    `text` names the target in the ValueError where there is none.
    """
    names = [name.upper()] if "_" in name else [f"{name.upper()}_{n}" for n in (50, 100, 250, 1000)]
    for full in names:
        if hasattr(cv2.aruco, f"DICT_{full}") and len(marker_dictionary(full).bytesList) >= markers:
            return full.lower()
    raise ValueError(f"board '{text}': no dictionary '{name}' of OpenCV has the {markers} markers it needs; try 4x4")
