"""Detection of a board's points in images to a fraction of a pixel, with likely reasons where it fails.

Works with OpenCV 4.10 and newer, and 5. Images that are dim, flat or inverted (near infrared, narrow bands)
are stretched, equalised and inverted in turn until the board is found.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from arraygeom.pixels import HW

from .board import (
    AprilGrid,
    Board,
    Charuco,
    Chessboard,
    Circles,
    KnownPoints,
    MarkedBoard,
    apart,
    marker_dictionary,
    on_a_line,
)
from .corners import monomials, refine_corners
from .photos import FrameKey, Grey, Photo, Photos, find_photos

FEWEST = 8
"""Least points of a detection: a pose needs 4, a check of it more."""
FEWEST_KNOWN = 6
"""Least points of a detection of known positions."""
ENOUGH = 0.6
"""Share of corners that must fit the corner model; otherwise all are refined by gradients."""
APRIL_SHIFT = 0.5
"""Position (x and y) of the first pixel's centre in corners of OpenCV's AprilTag method."""
LARGEST_MISFIT = 0.35
"""Largest median distance (in spacings) of points from a smoothly distorted grid; above, the detection is
false."""
LOCAL_MISFIT = 0.1
"""Largest distance of two markers' corners from their homography, in sides; above, it is another board."""
SMALL = 640
"""Width to which images are reduced to identify the board in them."""
OTHER_DICTIONARIES = ("4x4_1000", "5x5_1000", "6x6_1000", "7x7_1000", "aruco_original", "apriltag_36h11")
EXPLAINED_IMAGES = 4
"""Number of images without a board that are analysed for the reason."""
NAMED = 6
"""Number of images named in a message."""

Progress = Callable[[Iterable[Any], int], Iterable[Any]]


class Detection(NamedTuple):
    """Board points detected in one image.

    Attributes:
        ids: index of each point among the board's `points`.
        x: pixel (x, y) of each.
    """

    ids: Int[np.ndarray, " n"]
    x: Float[np.ndarray, "n 2"]

    def where(self, mask: Bool[np.ndarray, " n"]) -> Detection:
        """Return the points in a mask."""
        return Detection(self.ids[mask], self.x[mask])


@dataclass(frozen=True)
class BoardViews:
    """Detections of a board in the images of one camera.

    Attributes:
        hw: height and width of the images, pixels.
        seen: detected points by moment (of further boards see `detected`); images without one are missing.
    """

    hw: HW
    seen: Mapping[FrameKey, Detection]

    @property
    def count(self) -> int:
        """Number of points in all images."""
        return sum(len(d.ids) for d in self.seen.values())

    def only(self, keys: Collection[FrameKey]) -> BoardViews:
        """Return the views at some moments; others are ignored."""
        return BoardViews(self.hw, {key: d for key, d in self.seen.items() if key in keys})


def detect(grey: Grey, board: Board) -> Detection | None:
    """Detect a single board's points in a grey image (uint8); one in colour is not refused.

    Returns:
        The points, corners refined where that is plausible: all of the board's, or of one with markers
        `FEWEST` or more (of known points `FEWEST_KNOWN`); None if the board is not found.

    Raises:
        KeyError: for several boards (`Boards`), and a kind of one's own.
        cv2.error: for an image of another type.
    """
    for candidate in _versions(grey):
        detection = _FINDERS[type(board)](candidate, board)
        if detection is not None and _plausible(detection, board):
            refined = _refined(grey, detection, board)
            return refined if _plausible(refined, board) else detection
    return None


def explain(images: Iterable[Grey], board: Board, *, confirmed: bool = False) -> str:
    """Guess the likeliest reason why a board was not found in images.

    Args:
        images: grey images, uint8.
        board: a single board.
        confirmed: True if other images show it: its name and size are right, though these may show another.

    Returns:
        A sentence: the commonest reason, or that there are no images.
    """
    reasons = Counter(_reason(grey, board, confirmed=confirmed) for grey in images)
    return reasons.most_common(1)[0][0] if reasons else "there are no images"


def other_size(images: Iterable[Grey], board: Board, *, larger: bool = False) -> str | None:
    """Find the size of a chessboard in the images that is not `board`'s.

    Args:
        larger: True for images in which `board` was found, whose patches pass for smaller boards.

    Returns:
        The size that images show most often, as "9x6", the longer side first; None if they show none, if it
        is `board`'s or (`larger`) has no more points, if only one of several shows it, and for other kinds.
    """
    if not isinstance(board, Chessboard):
        return None
    size_of_each = [_grid_size(grey) for grey in images]
    sizes = Counter(size for size in size_of_each if size is not None)
    if not sizes:
        return None
    size, votes = sizes.most_common(1)[0]
    same = set(size) == {board.columns, board.rows} or (larger and size[0] * size[1] <= len(board.points))
    return None if same or (votes < 2 and len(size_of_each) > 1) else f"{size[0]}x{size[1]}"


def _versions(grey: Grey) -> Iterator[Grey]:
    yield grey
    equalised = cv2.createCLAHE(3.0, (8, 8)).apply(grey)
    yield from (equalised, 255 - grey, 255 - equalised)


def _chessboard(grey: Grey, board: Chessboard) -> Detection | None:
    size = board.columns, board.rows
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    succeeded, corners = cv2.findChessboardCorners(grey, size, flags=flags)
    if not succeeded:
        succeeded, corners = cv2.findChessboardCornersSB(grey, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not succeeded or len(corners) != len(board.points):
        return None
    return _numbered(_right_handed(corners.reshape(board.rows, board.columns, 2)))


def _right_handed(grid: np.ndarray) -> np.ndarray:
    """Mirror a grid whose x, y and direction into the board are no right-handed frame."""
    (ax, ay), (bx, by) = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    return grid[:, ::-1] if ax * by < ay * bx else grid


def _numbered(grid: np.ndarray) -> Detection:
    """Detection of all points of a board, row by row."""
    x = grid.reshape(-1, 2).astype(np.float64)
    return Detection(np.arange(len(x)), x)


def _charuco(grey: Grey, board: Charuco) -> Detection | None:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.CharucoDetector(board.opencv, cv2.aruco.CharucoParameters(), parameters)
    corners, ids, quads, markers = detector.detectBoard(grey)
    numbers = [] if markers is None else markers.reshape(-1).tolist()
    local = _between_markers({n: x.reshape(4, 2) for n, x in zip(numbers, quads)}, board)
    count = 0 if ids is None else len(ids)
    if max(count, len(local.ids)) < FEWEST:
        return None
    if len(local.ids) > count:  # in steep or wide views OpenCV drops all of them
        return local
    return Detection(ids.reshape(-1).astype(np.int64), corners.reshape(-1, 2).astype(np.float64))


def _between_markers(seen: Mapping[int, np.ndarray], board: Charuco) -> Detection:
    """Return the corners between two markers, by the homography of these two alone, if it fits them."""
    layout = board.opencv
    points = np.asarray(layout.getObjPoints())[..., :2]
    squares = dict(zip(np.asarray(layout.getIds()).reshape(-1).tolist(), points))
    known = [n for n in squares if n in seen]
    middles = np.array([squares[n].mean(0) for n in known]).reshape(-1, 2)
    ids, x = [], []
    for i, corner in enumerate(np.asarray(layout.getChessboardCorners())[:, :2]):
        beside = np.flatnonzero(np.linalg.norm(middles - corner, axis=-1) < board.spacing)
        if len(beside) != 2:
            continue
        p, there = (
            np.concatenate([of[known[j]] for j in beside]).astype(np.float64) for of in (squares, seen)
        )
        H, _ = cv2.findHomography(p, there)
        if H is None:
            continue
        q = cv2.perspectiveTransform(np.vstack([p, corner])[:, None].astype(np.float64), H)[:, 0]
        side = np.linalg.norm(there - np.roll(there, 1, 0), axis=-1)[1:4].max()
        if np.linalg.norm(q[:-1] - there, axis=-1).max() < LOCAL_MISFIT * side:
            ids.append(i)
            x.append(q[-1])
    return Detection(np.array(ids, dtype=np.int64), np.array(x).reshape(-1, 2))


def _april_grid(grey: Grey, board: AprilGrid) -> Detection | None:
    markers = _tags(grey, board.dictionary, board.border)
    tags = np.array([i for i in markers if i in board.markers], dtype=int)
    if 4 * len(tags) < FEWEST:
        return None
    x = np.array([markers[i] for i in tags.tolist()])
    tags -= board.markers[0]
    points = board.corners[tags].reshape(-1)
    # tags stand on their heads in Kalibr's files, and otherwise in others'
    rotated = [np.roll(x, k, 1).reshape(-1, 2).astype(np.float64) for k in range(4)]
    p = board.points[points, :2]
    return Detection(points, min(rotated, key=lambda x: float(np.median(homography_errors(p, x)))))


def _known_points(grey: Grey, board: KnownPoints) -> Detection | None:
    """Detect corners, and centres by the diagonals, which lenses hardly move."""
    markers = _tags(grey, board.dictionary, 1)
    ids = [i for i, (marker, _) in enumerate(board.ids) if marker in markers]
    if len(ids) < FEWEST_KNOWN:
        return None
    x = [
        _crossing(markers[m]) if corner < 0 else markers[m][corner]
        for m, corner in (board.ids[i] for i in ids)
    ]
    return Detection(np.array(ids), np.array(x, dtype=np.float64))


def _crossing(corners: np.ndarray) -> np.ndarray:
    """Intersection of a quadrilateral's diagonals: the projection of a square's centre."""
    a, b, c, d = corners.astype(np.float64)
    along = np.linalg.solve(np.stack([c - a, b - d], -1), b - a)
    return np.asarray(a + along[0] * (c - a))


def _tags(grey: Grey, dictionary: str, border: int) -> dict[int, np.ndarray]:
    """Corners (4) of each visible marker, by number; of AprilTags by two methods that miss others."""
    tags: dict[int, np.ndarray] = {}
    april = [cv2.aruco.CORNER_REFINE_APRILTAG] if dictionary.startswith("april") else []
    for method in (cv2.aruco.CORNER_REFINE_SUBPIX, *april):
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits, parameters.cornerRefinementMethod = border, method
        detector = cv2.aruco.ArucoDetector(marker_dictionary(dictionary), parameters)
        corners, ids, _ = detector.detectMarkers(grey)
        numbers = [] if ids is None else ids.reshape(-1).tolist()
        shift = APRIL_SHIFT if method == cv2.aruco.CORNER_REFINE_APRILTAG else 0.0
        tags |= {number: x.reshape(4, 2) - shift for number, x in zip(numbers, corners)}
    return tags


def homography_errors(p: Float[np.ndarray, "n 2"], x: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Compute the distances of pixels from a homography of board points (least median of squares).

    Returns:
        Distances in pixels; infinite if there is no homography.

    Raises:
        cv2.error: for fewer than four points.
    """
    H, _ = cv2.findHomography(p, x, cv2.LMEDS)
    if H is None:
        return np.full(len(p), np.inf)
    return np.linalg.norm(cv2.perspectiveTransform(p[:, None], H)[:, 0] - x, axis=-1)


def _circles(grey: Grey, board: Circles) -> Detection | None:
    """Detect the centres of a grid of circles in the board's order; None unless all are found."""
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        succeeded, centres = cv2.findCirclesGrid(grey, (board.columns, board.rows), flags=flags)
        if not succeeded or len(centres) != len(board.points):
            continue
        grid = centres.reshape(board.rows, board.columns, 2)
        if not board.asymmetric:
            return _numbered(_right_handed(grid))
        numbered = _numbered(grid)
        if board.rows % 2 == 0 and not _plausible(numbered, board):  # OpenCV may swap the rows of each pair
            return _numbered(grid.reshape(-1, 2, board.columns, 2)[:, ::-1])
        return numbered
    return None


_FINDERS: dict[type[Board], Callable[[Grey, Any], Detection | None]] = {
    Chessboard: _chessboard,
    Charuco: _charuco,
    AprilGrid: _april_grid,
    Circles: _circles,
    KnownPoints: _known_points,
}


def _refined(grey: Grey, detection: Detection, board: Board) -> Detection:
    """Refine corners: by the corner model, with markers without occluded ones, or all by gradients."""
    if isinstance(board, Circles | KnownPoints):
        return detection
    clear = _clear(board)
    x, good = refine_corners(grey, detection.x, board.points[detection.ids, :2] / board.spacing, clear=clear)
    if good.mean() < ENOUGH:
        return Detection(detection.ids, _by_gradients(grey, detection.x, 0.9 * clear))
    if isinstance(board, MarkedBoard):
        return Detection(detection.ids[good], x[good])
    return Detection(detection.ids, np.where(good[:, None], x, _by_gradients(grey, x, 0.3)))


def _clear(board: Board) -> float:
    """Distance from a corner's edges, in `spacing`, within which there is nothing but its own squares."""
    if isinstance(board, Charuco):
        return (1 - board.marker / board.spacing) / 2
    if isinstance(board, AprilGrid):
        black = board.border * board.tag / (marker_dictionary(board.dictionary).markerSize + 2 * board.border)
        return min(black, board.gap) / board.spacing
    return 0.5


def _by_gradients(grey: Grey, x: np.ndarray, share: float) -> np.ndarray:
    """Refine corners by OpenCV's gradients, in windows of `share` of the distance to the next corner."""
    half = int(np.clip(share * np.quantile(apart(x), 0.1), 2, 11))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    refined = cv2.cornerSubPix(grey, x.astype(np.float32).reshape(-1, 1, 2), (half, half), (-1, -1), criteria)
    return refined.reshape(-1, 2).astype(np.float64)


def _plausible(detection: Detection, board: Board) -> bool:
    """True for enough points, not collinear, that a homography plus a cubic polynomial maps to the pixels."""
    if isinstance(board, KnownPoints):
        return not on_a_line(board.points[detection.ids])
    p = board.points[detection.ids, :2]
    if len(p) < FEWEST or np.linalg.svd(p - p.mean(0), compute_uv=False)[1] <= 0.5 * board.spacing:
        return False
    H, _ = cv2.findHomography(p, detection.x)
    if H is None:
        return False
    flat = cv2.perspectiveTransform(p[:, None], H)[:, 0]
    basis = monomials((p - p.mean(0)) / np.abs(p - p.mean(0)).max(0), 3 if len(p) >= 30 else 1)
    distort = np.linalg.pinv(basis) @ (detection.x - flat)
    left = np.linalg.norm(detection.x - flat - basis @ distort, axis=-1)
    return bool(np.median(left) < LARGEST_MISFIT * np.median(apart(flat)) and np.isfinite(left).all())


def _reason(grey: Grey, board: Board, *, confirmed: bool) -> str:
    """Guess why a board is not found, and what to do."""
    low, high = np.percentile(grey, (2, 98))
    if high - low < 40:
        return "the images have hardly any contrast: expose them longer, or light the board"
    if confirmed and isinstance(board, MarkedBoard):
        seen = len(_tags(grey, board.dictionary, board.border if isinstance(board, AprilGrid) else 1))
        if seen < 4 and (other := _other_dictionary(grey, board)):
            return f"{other}: another board"
        return (
            f"{seen} of its markers are readable there, too few side by side: leave the image out, or take "
            "it nearer, less steeply, or sharper"
        )
    if isinstance(board, MarkedBoard) and (reason := _marker_reason(grey, board)):
        return reason
    if not confirmed and (other := other_size([grey], board)):
        return (
            f"a chessboard with {other} inner corners is visible: is the board's size right, "
            "and is all of it in the image?"
        )
    if detect(np.ascontiguousarray(grey[:, ::-1]), board) is not None:
        return "it is found once the image is mirrored: save the images as captured, not mirrored"
    if cv2.Laplacian(grey, cv2.CV_64F).std() < 4:
        return "the images are blurred: focus, and hold the board still"
    margin = "" if isinstance(board, MarkedBoard) else " completely and with its white margin"
    right = "" if confirmed else "is its name right, and "
    return f"no such board is visible{margin}: {right}is it in the image, large, lit and sharp?"


def _marker_reason(grey: Grey, board: MarkedBoard) -> str | None:
    """Guess the reason from visible markers; None if they give no hint."""
    border = board.border if isinstance(board, AprilGrid) else 1
    ids, last = _tags(grey, board.dictionary, border), board.markers[-1]
    if isinstance(board, AprilGrid) and len(_tags(grey, board.dictionary, 3 - border)) >= max(4, len(ids)):
        return (
            f"its tags have {3 - border} black bits around their codes: "
            f"add ':border{3 - border}' to the board's name"
        )
    if isinstance(board, KnownPoints):
        return (
            f"{len(ids)} of its markers are visible, too few, all on a line, "
            f"or not of {board.dictionary}: name their dictionary"
        )
    if len(ids) >= 4 and max(ids) > last:
        return (
            f"markers up to number {max(ids)} are visible and the board has "
            f"{board.markers[0]} to {last}: is its size right?"
        )
    _, every, _ = cv2.aruco.ArucoDetector(marker_dictionary(board.dictionary)).detectMarkers(grey)
    if every is not None and len(every) >= len(ids) + 4:
        return "its markers are visible twice: show one such board, and no reflection of it"
    if len(ids) >= 4:
        legacy = " A board drawn by OpenCV before 4.6 needs ':legacy' at the end of its name"
        return (
            f"{len(ids)} of its markers are visible, but not at their positions: "
            f"is the size right (across x down)?{legacy if isinstance(board, Charuco) else ''}"
        )
    other = _other_dictionary(grey, board)
    return other and f"{other}: name that one"


def _other_dictionary(grey: Grey, board: MarkedBoard) -> str | None:
    """Name a dictionary of which an image shows markers; None without one."""
    for name in OTHER_DICTIONARIES:
        if len(markers := _tags(grey, name, 1)) >= 6:
            return f"{len(markers)} markers of the dictionary {name} are visible, not of {board.dictionary}"
    return None


def _grid_size(grey: Grey) -> tuple[int, int] | None:
    """Inner corners along the sides of the largest chessboard in an image, the longer first."""
    scale = min(1.0, SMALL / grey.shape[1])
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE
    succeeded, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
    return (max(meta.shape), min(meta.shape)) if succeeded else None


# All images -------------------------------------------------------------------------------------------------


DetectedImage = tuple[HW, dict[FrameKey, Detection]]
"""Size of an image, and the points of each board in it by moment."""


class CollectedViews(NamedTuple):
    """Detections of a board in a folder of images.

    Attributes:
        views: detections by camera, each with one image of the board or more.
        photos: all images by camera and moment.
        notes: sentences "camera: note" on images without the board.
    """

    views: dict[str, BoardViews]
    photos: Photos
    notes: tuple[str, ...]


def collect_folder(
    folder: str | Path,
    board: Board,
    *,
    patterns: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> CollectedViews:
    """Detect the board in all images of all cameras in a folder (see `find_photos`).

    Args:
        patterns: file name patterns by camera; None derives cameras from folders or names.
        progress: function of an iterable and its length that yields its items and shows progress, or None.

    Raises:
        ValueError: as `find_photos`, for an image that cannot be read, a camera whose images differ in size
            or of which none shows the board, and images that show a larger chessboard.
        OSError: for a folder that is missing (FileNotFoundError), or what cannot be read.
    """
    photos = find_photos(Path(folder), patterns=patterns)
    jobs = [job for moments in photos.values() for job in moments.items()]
    with ThreadPoolExecutor(2) as pool:
        results = pool.map(lambda job: detected(job[1], job[0], board), jobs)
        detections = iter(list(progress(results, len(jobs)) if progress else results))
    views, notes, shown = {}, list[str](), list[Iterable[Grey]]()
    for name, moments in photos.items():
        images = {key: next(detections) for key in moments}
        views[name] = board_views(name, moments, images)
        with_board = {key: boards for key, (_, boards) in images.items() if boards}
        notes += _missing(name, moments, with_board, board)
        shown.append(_greys([moments[key] for key in with_board]))
    if other := other_size(chain.from_iterable(shown), board, larger=True):
        raise ValueError(
            f"the images show a chessboard with {other} inner corners and the board given is {board}: "
            "count the corners between squares, not the squares"
        )
    return CollectedViews(views, photos, tuple(notes))


def detected(photo: Photo, key: FrameKey, board: Board) -> DetectedImage:
    """Detect each board in an image; points are numbered as in the list of all boards.

    Args:
        photo: the image.
        key: moment of the image, which the first board keeps; the second gets "KEY board 2" and so on, as
            each has a pose of its own.
        board: a board, or several.

    Returns:
        Size (h, w) of the image, and detections by key; a board that is not found has none.

    Raises:
        ValueError, OSError: if the image cannot be read.
    """
    grey, detections, before = photo.read(), dict[FrameKey, Detection](), 0
    for index, member in enumerate(board.members):
        if (detection := detect(grey, member)) is not None:
            detections[f"{key} board {index + 1}" if index else key] = Detection(
                detection.ids + before, detection.x
            )
        before += len(member.points)
    return (grey.shape[0], grey.shape[1]), detections


def board_views(
    name: str, moments: Mapping[FrameKey, Photo], images: Mapping[FrameKey, DetectedImage]
) -> BoardViews:
    """Combine the detections in a camera's images.

    Args:
        name: name of the camera, for messages.
        moments: its images by moment.
        images: size and detections of some of them, at least one, as `detected` returns them.

    Returns:
        The detections by moment.

    Raises:
        ValueError: if the images differ in size.
    """
    by_size: dict[HW, list[str]] = {}
    for key, (hw, _) in images.items():
        by_size.setdefault(hw, []).append(moments[key].label)
    if len(by_size) > 1:
        shown = [f"{w}x{h} ({named(labels, 2)})" for (h, w), labels in by_size.items()]
        raise ValueError(
            f"{name}: its images differ in size: {'; '.join(shown)}; keep those of one camera at one setting"
        )
    return BoardViews(next(iter(by_size)), {k: d for _, boards in images.values() for k, d in boards.items()})


def _missing(
    name: str, moments: Mapping[FrameKey, Photo], with_board: Collection[FrameKey], board: Board
) -> Iterator[str]:
    """Note on a camera's images without the board. Raises ValueError if it is in none."""
    why, missing = "", [photo for key, photo in moments.items() if key not in with_board]
    if missing:
        labels = named([photo.label for photo in missing], NAMED)
        why = f"images ({labels}): {explain(_greys(missing), board.members[0], confirmed=bool(with_board))}"
    if not with_board:
        raise ValueError(f"{name}: the board {board} is in none of {len(moments)} {why}")
    if missing:
        yield f"{name}: no board in {len(missing)} of {len(moments)} {why}"


def _greys(photos: list[Photo]) -> Iterable[Grey]:
    step = max(1, len(photos) // EXPLAINED_IMAGES)
    return (photo.read() for photo in photos[::step][:EXPLAINED_IMAGES])


def named(labels: Sequence[str], most: int) -> str:
    """List the first `most` labels, and how many more there are, as text."""
    return ", ".join(labels[:most]) + (f" and {len(labels) - most} more" if len(labels) > most else "")
