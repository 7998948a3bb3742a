"""Adequacy of a camera's images: what boards cover, and which further views would help most."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int

from arraygeom import Camera, Pose, rotation_from_vector
from arraygeom.pixels import HW

from .board import Board
from .bundle import camera_jacobian
from .detect import BoardViews
from .photos import FrameKey
from .rig import Calibration
from .uncertainty import Intrinsics, intrinsics_of, moved_pixels

CELLS = 6, 8
"""Rows and columns of the coverage grid."""
WIDE_ENOUGH = 0.6
DEEP_ENOUGH = 1.5
TILTED_ENOUGH = 20.0
POSITIONS = (
    ("top left", "top", "top right"),
    ("left", "middle", "right"),
    ("bottom left", "bottom", "bottom right"),
)
TILT = 30.0
"""Degrees by which a proposed board is tilted."""
FILLS = 0.35, 0.7
"""Widths of proposed boards, as shares of the image's width."""
TILTS = {(0, 1): "right", (0, -1): "left", (1, 0): "upper", (-1, 0): "lower"}
"""Edge that comes nearer by a rotation about x and y."""


class Coverage(NamedTuple):
    """Coverage of one camera's image and depths by the boards that it saw.

    Attributes:
        cells: number of points in each of the `CELLS` (rows, columns) of the image.
        depths: depth of the nearest and the farthest point, metres.
        tilts: least and largest angle between a board's normal and the optical axis, 0 to 90 degrees.
        missing: advice on what is missing, one sentence each, without the camera's name; empty if nothing is.
    """

    cells: Int[np.ndarray, "r c"]
    depths: tuple[float, float]
    tilts: tuple[float, float]
    missing: tuple[str, ...]

    @property
    def share(self) -> float:
        """Share of cells with a point, 0..1."""
        return float((self.cells > 0).mean())


def coverage(views: BoardViews, cam_from_board: Mapping[FrameKey, Pose], board: Board) -> Coverage:
    """Compute a camera's coverage from its detections and the boards' poses in its frame.

    Args:
        views: detections of `board`; ValueError for none.
        cam_from_board: pose of the board at the moment of each detection; KeyError for a missing one.
    """
    cells = point_counts([d.x for d in views.seen.values()], views.hw)
    poses = {key: cam_from_board[key] for key in views.seen}
    depths = [
        board.points[d.ids] @ poses[k].R[2].numpy() + float(poses[k].t[2]) for k, d in views.seen.items()
    ]
    tilts = np.degrees([np.arccos(min(1.0, abs(float(pose.R[2, 2])))) for pose in poses.values()])
    (near, far), (least, most) = ((float(v.min()), float(v.max())) for v in (np.concatenate(depths), tilts))
    covered = Coverage(cells, (near, far), (least, most), ())
    return covered._replace(missing=tuple(_missing(covered, board)))


def point_counts(parts: Iterable[Float[np.ndarray, "_ 2"]], hw: HW) -> Int[np.ndarray, "r c"]:
    """Count points (x, y) in each of the `CELLS` of an image of size `hw`.

    Returns:
        Counts (rows, columns), int64; points outside the image are not counted.
    """
    x = np.concatenate([np.zeros((0, 2)), *parts])
    counts, _, _ = np.histogram2d(
        x[:, 1], x[:, 0], bins=CELLS, range=((-0.5, hw[0] - 0.5), (-0.5, hw[1] - 0.5))
    )
    return counts.astype(np.int64)


def _missing(coverage: Coverage, board: Board) -> Iterator[str]:
    """Sentences on missing parts of the image, depths and tilts, and what to photograph."""
    thirds = coverage.cells.reshape(3, CELLS[0] // 3, CELLS[1])
    empty = [
        POSITIONS[i][j]
        for i, band in enumerate(thirds)
        for j, cells in enumerate(np.array_split(band, 3, axis=1))
        if not cells.any()
    ]
    if empty:
        yield f"no points at the {', '.join(empty)} of the image: the lens model is extrapolated there"
    elif coverage.share < WIDE_ENOUGH:
        yield f"points in only {coverage.share:.0%} of the image: fill it, corners too"
    near, far = coverage.depths
    if far < DEEP_ENOUGH * near:
        yield f"boards at one depth only ({near:.3g} to {far:.3g} m): take some closer, some further"
    if board.flat and coverage.tilts[1] < TILTED_ENOUGH:
        yield f"boards tilted by {coverage.tilts[1]:.0f} degrees at most: tilt it by 20 to 40"


class NextView(NamedTuple):
    """Proposed view of a board, which lowers a camera's uncertainty of projection.

    Uncertainty is the root of the variances of a projection's x and y together, in the median over the image.

    Attributes:
        text: the view in words: position, distance and tilt of the board.
        before: uncertainty with the proposals before this one, pixels.
        after: uncertainty with this one too, pixels.
    """

    text: str
    before: float
    after: float


def next_views(intrinsics: Intrinsics, board: Board, depth: float, *, count: int = 2) -> list[NextView]:
    """Choose among `proposed_views` those that lower a camera's uncertainty most, one after the other.

    Args:
        intrinsics: camera with the covariance of its free intrinsics, at least one.
        board: the board; of several the first is proposed.
        depth: depth in metres at which uncertainty is evaluated.
        count: number of views; a view may be proposed again.

    Returns:
        `count` views; none for points in space, or if no candidate shows 60 % of the board's points (a
        strip).

    Raises:
        numpy.linalg.LinAlgError: for a singular covariance.
    """
    _, change = moved_pixels(intrinsics, depth)

    def median(information: np.ndarray) -> float:
        covariance = np.linalg.inv(information)
        return float(np.median(np.sqrt(np.einsum("nif,fg,nig->n", change, covariance, change))))

    gains = {
        text: _gain(intrinsics, X) for text, X in proposed_views(intrinsics.camera, board.members[0]).items()
    }
    candidates = {text: gain for text, gain in gains.items() if gain is not None and board.flat}
    information, proposals = np.linalg.inv(intrinsics.covariance), list[NextView]()
    for _ in range(count if candidates else 0):
        after = {text: median(information + gain) for text, gain in candidates.items()}
        best = min(after, key=lambda text: after[text])
        proposals.append(NextView(best, median(information), after[best]))
        information = information + candidates[best]
    return proposals


def proposed_views(camera: Camera, board: Board) -> Mapping[str, Float[np.ndarray, "n 3"]]:
    """List candidate views of a board: 9 positions, 2 distances, 4 tilts.

    Args:
        camera: camera at the origin.
        board: a single board.

    Returns:
        The board's points (n, 3) in the camera's frame, metres, by description; some may lie outside the
        image. NaN where the board's middle has no ray through the lens, or one at 90 degrees or more.
    """
    proposals, (h, w) = {}, camera.hw
    middle = torch.from_numpy(board.middle)
    for fill in FILLS:
        depth = float(camera.K[0, :2].norm()) * max(board.extent) / (fill * w)
        for row, column in np.ndindex(3, 3):
            share = 0.5 + np.array([column - 1, row - 1]) * (0.5 - 0.4 * fill)
            pixel = torch.from_numpy(share * (w - 1, h - 1))
            centre = camera.unproject(pixel, torch.tensor(depth, dtype=torch.float64))
            where = f"the board at the {POSITIONS[row][column]}, {depth:.2g} m away"
            for (a, b), edge in TILTS.items():
                R = rotation_from_vector(torch.deg2rad(TILT * torch.tensor([a, b, 0.0], dtype=torch.float64)))
                X = Pose(R, centre - R @ middle).apply(torch.from_numpy(board.points)).numpy()
                proposals[f"{where}, tilted, {edge} edge nearer"] = X
    return proposals


def _gain(intrinsics: Intrinsics, X: np.ndarray) -> np.ndarray | None:
    """Information of a view, its pose unknown, on the free intrinsics; None if it hardly shows the board."""
    projected = intrinsics.camera.project_local(torch.from_numpy(X))
    inside = (projected.valid & intrinsics.camera.contains(projected.x)).numpy()
    if inside.sum() < 0.6 * len(X) or not inside.any():
        return None
    J = camera_jacobian(intrinsics.camera, X[inside]) / intrinsics.sigma
    by_pose = J[..., :6].reshape(-1, 6)
    by_intrinsics = J[..., intrinsics.free].reshape(2 * int(inside.sum()), -1)
    left = by_intrinsics - by_pose @ np.linalg.lstsq(by_pose, by_intrinsics, rcond=None)[0]
    return np.asarray(left.T @ left)


def coverages(calibration: Calibration) -> dict[str, Coverage]:
    """Compute the coverage of every camera of a calibration, by name."""
    boards, by_camera = calibration.fit.problem.board_poses, {}
    for name, views in calibration.views.items():
        camera = calibration.fit.problem.cameras[name]
        poses = {key: camera.cam_from_world @ boards[key] for key in views.seen}
        by_camera[name] = coverage(views, poses, calibration.board)
    return by_camera


def coverage_advice(calibration: Calibration, *, always: bool = False) -> Iterator[str]:
    """Yield advice on each camera's coverage and, where something is missing, the views that would help most.

    No views are proposed without a covariance or free intrinsics, and where `next_views` has none.

    Args:
        always: True to propose views where nothing is missing too.

    Yields:
        Sentences "camera: advice".
    """
    for name, covered in coverages(calibration).items():
        yield from (f"{name}: {text}" for text in covered.missing)
        intrinsics = intrinsics_of(calibration.fit, name)
        depth, lacking = float(np.mean(covered.depths)), always or covered.missing
        if (
            lacking
            and len(intrinsics.covariance)
            and (views := next_views(intrinsics, calibration.board, depth))
        ):
            listed = "; then ".join(view.text for view in views)
            gain = f"uncertainty from {views[0].before:.2g} to {views[-1].after:.2g} px"
            yield f"{name}: two more views would help most: {listed} ({gain})"
