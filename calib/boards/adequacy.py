"""Whether a camera's images are enough: what boards cover, and which views would help most."""

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
"""Widths of proposed boards, as shares of the image's."""
TILTS = {(0, 1): "right", (0, -1): "left", (1, 0): "upper", (-1, 0): "lower"}
"""The edge that comes nearer by a rotation about x and y."""


class Coverage(NamedTuple):
    """Coverage of one camera by its boards.

    cells: points in each cell of the image. depths: (nearest, furthest) point, metres. tilts: (least, most)
    angle between the board's normal and the optical axis, degrees. missing: advice, one sentence each.
    """

    cells: Int[np.ndarray, "r c"]
    depths: tuple[float, float]
    tilts: tuple[float, float]
    missing: tuple[str, ...]

    @property
    def share(self) -> float:
        """The share of cells with a point."""
        return float((self.cells > 0).mean())


def coverage(views: BoardViews, cam_from_board: Mapping[FrameKey, Pose], board: Board) -> Coverage:
    """Coverage of a camera by its boards, from their poses in it."""
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
    """The number of points in each of the `CELLS` of an image."""
    x = np.concatenate([np.zeros((0, 2)), *parts])
    counts, _, _ = np.histogram2d(
        x[:, 1], x[:, 0], bins=CELLS, range=((-0.5, hw[0] - 0.5), (-0.5, hw[1] - 0.5))
    )
    return counts.astype(np.int64)


def _missing(coverage: Coverage, board: Board) -> Iterator[str]:
    """What is missing, and what to photograph: parts of the image, depths, tilts."""
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
    """A board's view that would help, in words; the median uncertainty (pixels) with and without it."""

    text: str
    before: float
    after: float


def next_views(intrinsics: Intrinsics, board: Board, depth: float, *, count: int = 2) -> list[NextView]:
    """The views that lower a camera's uncertainty of projection most, one after the other.

    None where the image shows hardly any of the board in each, as a strip does, and of points in space.
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
    """Views of a board in words, and its points in the camera's frame."""
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
    """A view's information on the free intrinsics, its pose unknown; None if hardly any of it is visible."""
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
    """Coverage of every camera."""
    boards, by_camera = calibration.fit.problem.board_poses, {}
    for name, views in calibration.views.items():
        camera = calibration.fit.problem.cameras[name]
        poses = {key: camera.cam_from_world @ boards[key] for key in views.seen}
        by_camera[name] = coverage(views, poses, calibration.board)
    return by_camera


def coverage_advice(calibration: Calibration) -> Iterator[str]:
    """What each camera's images lack, and, where that is something, which views would help most."""
    for name, covered in coverages(calibration).items():
        yield from (f"{name}: {text}" for text in covered.missing)
        intrinsics = intrinsics_of(calibration.fit, name)
        depth, lacking = float(np.mean(covered.depths)), covered.missing and len(intrinsics.covariance)
        if lacking and (views := next_views(intrinsics, calibration.board, depth)):
            listed = "; then ".join(view.text for view in views)
            gain = f"uncertainty from {views[0].before:.2g} to {views[-1].after:.2g} px"
            yield f"{name}: two more views would help most: {listed} ({gain})"
