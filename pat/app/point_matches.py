"""Matched points of pairs of images, from a CSV file or a COLMAP database.

CSV: x0 y0 x1 y1 a line, in the order of two images given, first pixel's centre at 0; a header may name the
columns. COLMAP: verified matches where there are any; the first pixel's centre is at 0.5 (shift -0.5); images
by file name, and by folder where several have one name.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from arraygeom.io.source import decoded
from arraygeom.pixels import HW, within

MAX_IMAGES = 2**31 - 1
"""Factor in COLMAP's number of a pair of images a < b: a * MAX_IMAGES + b (its documentation of the
database)."""
COLUMNS = ("x0", "y0", "x1", "y1")
SQLITE = b"SQLite format 3\0"

PointPairs = dict[tuple[str, str], tuple[Tensor, Tensor]]
"""Points (n, 2) of two cameras, by their names, float64."""


def read_matches(path: str | Path, files: Mapping[str, str | Path], sizes: Mapping[str, HW]) -> PointPairs:
    """Read the matches between the images of cameras from a file.

    Args:
        path: CSV file, whose lines are x0 y0 x1 y1, or COLMAP's database.
        files: image file of each camera, for a CSV file in the order of its columns; only names are used, the
            images are not opened.
        sizes: height and width of each camera's image, pixels.

    Returns:
        By pair of camera names, in the order of `files` or the database, points (n, 2) of either, float64,
        pixel centres at whole numbers: of a pair in a database verified matches if it has any, else all;
        pairs without any are left out.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: for files of another kind, other than two images with a CSV file, a database without one
            of these images or matches between them, or where two cameras have one image, and points outside
            the images or not finite.
        KeyError: for a camera with matches that has no size.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file of matches: check the path")
    with path.open("rb") as file:
        database = file.read(len(SQLITE)) == SQLITE
    named = {name: Path(file) for name, file in files.items()}
    matches = _database(path, named) if database else _csv(path, named)
    for names, points in matches.items():
        for name, x in zip(names, points):
            h, w = sizes[name]
            outside = ~within(x, (h, w))
            if outside.any():
                raise ValueError(
                    f"{path}: {int(outside.sum())} of {len(x)} points are outside the image of '{name}', "
                    f"{w}x{h}: are they of this image, at this size?"
                )
    return matches


def _csv(path: Path, files: Mapping[str, Path]) -> PointPairs:
    """Read the points of two images, x0,y0,x1,y1 a line; ValueError for another line, by its text."""
    if len(files) != 2:
        raise ValueError(
            f"{path}: x0 y0 x1 y1 relate two images, and {len(files)} are given: give two, or a database"
        )
    try:
        lines = [line for line in decoded(path.read_bytes(), "strict").splitlines() if line.strip()]
    except UnicodeDecodeError:
        raise ValueError(f"{path}: neither CSV nor a COLMAP database: give x0,y0,x1,y1 a line") from None
    named = _named_columns(lines[0]) if lines else None
    lines = lines if named is None else lines[1:]
    parsed = [_numbers(line, named or range(4)) for line in lines]
    wrong = next((line for line, row in zip(lines, parsed) if row is None), None)
    if wrong is not None or not parsed:
        problem = "has no line of" if wrong is None else f"line '{wrong}' is not"
        raise ValueError(f"{path}: {problem} four numbers: give x0,y0,x1,y1 a line")
    points = torch.tensor([row for row in parsed if row], dtype=torch.float64)
    if not points.isfinite().all():
        raise ValueError(f"{path}: has points that are not finite: leave those lines out")
    a, b = files
    return {(a, b): (points[:, :2], points[:, 2:])}


def _words(line: str) -> list[str]:
    return re.split(r"[,;\s]+", line.strip().lstrip("#").strip())


def _named_columns(line: str) -> Sequence[int] | None:
    """Return the columns of x0, y0, x1, y1 by a header, else the first four; None for a line of numbers."""
    words = [word.strip("\"'").lower() for word in _words(line)]
    if any(map(_is_number, words)):
        return None
    return [words.index(name) for name in COLUMNS] if set(COLUMNS) <= set(words) else range(4)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _numbers(line: str, columns: Iterable[int]) -> list[float] | None:
    """Return the numbers in four columns of a line; None unless each has one."""
    try:
        words = _words(line)
        return [float(words[i]) for i in columns]
    except (ValueError, IndexError):
        return None


def _database(path: Path, files: Mapping[str, Path]) -> PointPairs:
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
            return _colmap(database, path, files)
    except (sqlite3.Error, IndexError, TypeError) as error:
        raise ValueError(
            f"{path}: not a COLMAP database ({error}): give COLMAP's database.db, or CSV"
        ) from None


def _colmap(database: sqlite3.Connection, path: Path, files: Mapping[str, Path]) -> PointPairs:
    images = [(Path(name), number) for name, number in database.execute("SELECT name, image_id FROM images")]
    names: dict[int, str] = {}
    for name, file in files.items():
        if (other := names.setdefault(_image(path, file, images), name)) != name:
            raise ValueError(
                f"{path}: '{other}' and '{name}' are one image, {file}: give each camera its own"
            )
    matches: PointPairs = {}
    for table in ("two_view_geometries", "matches"):
        for (a, b), pairs in _matches(database, table, names):
            points = (_keypoints(database, number)[pairs[:, side]] for side, number in enumerate((a, b)))
            matches.setdefault((names[a], names[b]), tuple(points))  # type: ignore[arg-type]
    if not matches:
        raise ValueError(f"{path}: has no matches between {', '.join(files)}: match these images first")
    return matches


def _image(path: Path, file: Path, images: Sequence[tuple[Path, int]]) -> int:
    """Return the number of the image named like a file, of several by its folder; ValueError unless one."""
    alike = [(name, number) for name, number in images if name.name == file.name]
    end = file.absolute().parts
    below = [(len(name.parts), number) for name, number in alike if end[-len(name.parts) :] == name.parts]
    if len(alike) != 1 and not below:
        listed = ", ".join(str(name) for name, _ in alike or images[:5])
        raise ValueError(
            f"{path}: has no image {file} (it has {listed}, ...): give the images it was made of"
        )
    return max(below)[1] if below else alike[0][1]


def _matches(
    database: sqlite3.Connection, table: str, names: Mapping[int, str]
) -> Iterator[tuple[tuple[int, int], NDArray[np.int64]]]:
    """Yield pairs of image numbers with the indices of their matched keypoints (n, 2)."""
    for pair, rows, data in database.execute(f"SELECT pair_id, rows, data FROM {table} WHERE rows > 0"):
        a, b = pair // MAX_IMAGES, pair % MAX_IMAGES
        if a in names and b in names:
            yield (a, b), _rows(data, np.uint32, rows, -1).astype(np.int64)


def _keypoints(database: sqlite3.Connection, image: int) -> Tensor:
    """Return the keypoints of an image (n, 2)."""
    query = "SELECT rows, cols, data FROM keypoints WHERE image_id = ?"
    rows, columns, data = database.execute(query, (image,)).fetchone() or (0, 2, b"")
    return torch.from_numpy(_rows(data, np.float32, rows, columns).astype(np.float64)) - 0.5


def _rows(data: bytes, kind: Any, rows: int, columns: int) -> NDArray[Any]:
    """First two columns of a table of numbers. Raises sqlite3.DataError for bytes of another one."""
    try:
        return np.frombuffer(data, kind).reshape(rows, columns)[:, :2]
    except ValueError as error:
        raise sqlite3.DataError(f"{error}") from None
