"""Board detection in all images, with likely reasons where it failed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arraygeom.pixels import HW

from .board import Board
from .detect import Detection, Grey, detect, explain, other_size
from .intrinsics import BoardViews
from .photos import FrameKey, Photo, Photos, find_photos

EXPLAINED_IMAGES = 4
"""Images without a board that are analysed for the reason."""
NAMED = 6
"""Images named in a message."""

Progress = Callable[[Iterable[Any], int], Iterable[Any]]


@dataclass(frozen=True)
class CollectedViews:
    """Detections of each camera, its images, and notes on failed ones."""

    views: dict[str, BoardViews]
    photos: Photos
    notes: tuple[str, ...]


def collect(photos: Photos, board: Board, *, progress: Progress | None = None) -> CollectedViews:
    """Detect the board in all images of all cameras.

    Raises ValueError, naming images and cause, if a camera's images differ in size, if the board is found in
    none of them, or if they show a board of another size.
    """
    jobs = [(name, key, photo) for name, moments in photos.items() for key, photo in moments.items()]
    with ThreadPoolExecutor(2) as pool:
        results = pool.map(lambda job: detected(job[2], job[1], board), jobs)
        found = list(progress(results, len(jobs)) if progress else results)
    by_camera = {name: [(k, r) for (n, k, _), r in zip(jobs, found) if n == name] for name in photos}
    views, notes = {}, []
    for name, moments in photos.items():
        sizes = {key: hw for key, (hw, _) in by_camera[name]}
        _check_sizes(name, moments, sizes)
        seen = {key: boards for key, (_, boards) in by_camera[name] if boards}
        _check_board(name, moments, seen, board)
        by_board = {key: d for boards in seen.values() for key, d in boards.items()}
        views[name] = BoardViews(next(iter(sizes.values())), by_board)
        notes += _missing(name, moments, seen, board)
    return CollectedViews(views, photos, tuple(notes))


def collect_folder(
    folder: str | Path, board: Board, *, patterns: Mapping[str, str] | None = None, progress: Progress | None = None
) -> CollectedViews:
    """`collect` for the images of a folder (see `find_photos`)."""
    return collect(find_photos(Path(folder), patterns=patterns), board, progress=progress)


def detected(photo: Photo, key: FrameKey, board: Board) -> tuple[HW, dict[FrameKey, Detection]]:
    """An image's size and the points of each board in it, numbered as those of all boards.

    Each board has poses of its own, hence a key of its own; that of the first one is the image's. Raises ValueError if
    the image cannot be read.
    """
    grey, found, before = photo.read(), dict[FrameKey, Detection](), 0
    for index, member in enumerate(board.members):
        if (seen := detect(grey, member)) is not None:
            found[f"{key} board {index + 1}" if index else key] = Detection(seen.ids + before, seen.x)
        before += len(member.points)
    return (grey.shape[0], grey.shape[1]), found


def _check_sizes(name: str, moments: Mapping[FrameKey, Photo], sizes: Mapping[FrameKey, tuple[int, int]]) -> None:
    counts = Counter(sizes.values())
    if len(counts) == 1:
        return
    shown = [f"{w}x{h} ({_named([moments[k].label for k in sizes if sizes[k] == (h, w)], 2)})" for h, w in counts]
    raise ValueError(f"{name}: its images differ in size: {'; '.join(shown)}; keep those of one camera at one setting")


def _check_board(name: str, moments: Mapping[FrameKey, Photo], seen: Collection[FrameKey], board: Board) -> None:
    """Raises ValueError if no image shows the board, or if most of some show a larger one."""
    if not seen:
        why = explain(_greys(list(moments.values())), board.members[0])
        labels = _named([p.label for p in moments.values()], NAMED)
        raise ValueError(f"{name}: the board {board} is found in none of {len(moments)} images ({labels}): {why}")
    if other := other_size(_greys([moments[key] for key in seen]), board, larger=True):
        raise ValueError(
            f"{name}: the images show a chessboard with {other} inner corners and the board given is {board}: "
            "count the corners between squares, not the squares"
        )


def _missing(name: str, moments: Mapping[FrameKey, Photo], seen: Collection[FrameKey], board: Board) -> list[str]:
    missing = [photo for key, photo in moments.items() if key not in seen]
    if not missing:
        return []
    labels, why = _named([p.label for p in missing], NAMED), explain(_greys(missing), board.members[0])
    return [f"{name}: no board in {len(missing)} of {len(moments)} images ({labels}): {why}"]


def _greys(photos: list[Photo]) -> Iterable[Grey]:
    step = max(1, len(photos) // EXPLAINED_IMAGES)
    return (photo.read() for photo in photos[::step][:EXPLAINED_IMAGES])


def _named(labels: list[str], most: int) -> str:
    return ", ".join(labels[:most]) + (f" and {len(labels) - most} more" if len(labels) > most else "")
