"""Targets that are no board: markers at known positions, on a wall, in a frame, in a room."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from .board import MarkedBoard, smallest_dictionary

COLUMNS = ("id", "x", "y", "z"), ("id", "corner", "x", "y", "z")
FEWEST = 6
"""Points that a target needs."""


@dataclass(frozen=True)
class KnownPoints(MarkedBoard):
    """Points at known positions: the centres of markers, or corners of them.

    ids: (marker, corner) of each point, corners clockwise from the marker's upper left, -1 for its centre.
    positions: (x, y, z) of each, metres, in any frame.
    """

    file: str
    ids: tuple[tuple[int, int], ...]
    positions: tuple[tuple[float, float, float], ...]

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Their positions about their mean, metres; in their own plane, x and y, if they lie in one."""
        points = np.array(self.positions, dtype=np.float64)
        points -= points.mean(0)
        if self.relief >= FLAT:
            return points
        axes = np.linalg.svd(points)[2]
        return np.asarray(points @ (axes * np.array([1, 1, np.linalg.det(axes)])[:, None]).T)

    @cached_property
    def relief(self) -> float:
        """How far the points are from lying in a plane, as a share of their extent."""
        points = np.array(self.positions, dtype=np.float64)
        first, *_, third = np.linalg.svd(points - points.mean(0), compute_uv=False)
        return float(third / first)

    @property
    def flat(self) -> bool:
        """Whether they are so nearly in a plane that cameras need several views of them."""
        return self.relief < FLAT

    @property
    def markers(self) -> Sequence[int]:
        """The numbers of the markers."""
        return sorted({marker for marker, _ in self.ids})

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height, metres."""
        width, height, _ = np.ptp(self.points, axis=0).tolist()
        return width, height

    def __str__(self) -> str:
        return f"{self.file}:{self.dictionary}"

    def _draw(self, axes: Any) -> None:
        raise ValueError(f"{self.file}: points of known position are no board to print")


FLAT = 0.03
"""Relief below which points count as lying in a plane."""


def known_points(text: str) -> KnownPoints:
    """The points of a CSV file `targets.csv`, or `targets.csv:5x5_100` with its markers' dictionary (4x4 by default).

    Columns id, x, y, z (metres) for markers' centres, or id, corner (0 to 3), x, y, z. Raises ValueError.
    """
    file, _, dictionary = text.partition(".csv")
    path = Path(f"{file}.csv")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of points")
    with path.open(encoding="utf-8", newline="") as lines:
        table = csv.DictReader(lines, skipinitialspace=True)
        head = tuple(name.strip().lower() for name in table.fieldnames or ())
        if head not in COLUMNS:
            raise ValueError(f"{path}: its first line is '{','.join(head)[:60]}': write id,x,y,z or id,corner,x,y,z")
        rows = [_row(path, number, row, head) for number, row in enumerate(table, 2)]
    ids = tuple(marker for marker, _ in rows)
    _check(path, ids)
    positions = tuple(position for _, position in rows)
    name = smallest_dictionary(text, dictionary.removeprefix(":").lower() or "4x4", max(ids)[0] + 1)
    apart = np.linalg.norm(np.array(positions)[:, None] - np.array(positions), axis=-1)
    spacing = float(np.median(np.sort(apart, axis=1)[:, 1]))
    return KnownPoints(len(ids), 1, spacing, name, 0, file=str(path), ids=ids, positions=positions)


Row = tuple[tuple[int, int], tuple[float, float, float]]


def _row(path: Path, number: int, row: dict[str, str], head: tuple[str, ...]) -> Row:
    try:
        values = dict(zip(head, row.values()))
        x, y, z = (float(values[axis]) for axis in "xyz")
        marker, corner = int(values["id"]), int(values.get("corner", -1))
    except (TypeError, ValueError):
        marker, corner, x, y, z = -1, 0, 0.0, 0.0, 0.0
    if marker < 0 or not -1 <= corner <= 3 or not np.isfinite([x, y, z]).all():
        raise ValueError(f"{path}, line {number}: wanted {','.join(head)}, numbers in metres, corners 0 to 3")
    return (marker, corner), (x, y, z)


def _check(path: Path, ids: Sequence[tuple[int, int]]) -> None:
    if len(ids) < FEWEST:
        raise ValueError(f"{path}: has {len(ids)} points and {FEWEST} is the least")
    if twice := [marker for marker in ids if ids.count(marker) > 1]:
        raise ValueError(f"{path}: marker {twice[0][0]} is there twice")
