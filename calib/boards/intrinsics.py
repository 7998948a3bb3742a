"""Initial calibration of one camera from its images of a board: Zhang's method, by OpenCV."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Camera, Distortion, Pose, intrinsics
from arraygeom.pixels import HW

from .board import Board
from .detect import Detection
from .photos import FrameKey

Lens = Literal["brown-conrady", "rational", "thin-prism", "tilted", "kannala-brandt", "none"]
COEFFICIENTS: dict[Lens, int] = {"brown-conrady": 5, "rational": 8, "thin-prism": 12, "tilted": 14}
"""Coefficients of the lens models of Brown and Conrady, each with all terms of the former."""
FEWEST_IMAGES = 3
FEWEST_POINTS = 6
"""Points of an image below which none is left out."""
OUTLIER = 6.0
"""Points beyond this many standard deviations (of a coordinate) are left out."""
LEAST_SIGMA = 0.02
"""Lower bound of that deviation, pixels: no real corners are better."""
MEDIAN_TO_DEVIATION = 1 / 1.17741
"""The standard deviation of a coordinate is this share of the median distance."""
FEWEST_TILT = 8.0
"""Boards whose normals differ by less than this many degrees count as parallel."""


@dataclass(frozen=True)
class BoardViews:
    """One camera's image size and, by moment, the board points detected."""

    hw: HW
    seen: Mapping[FrameKey, Detection]


Points = Float[np.ndarray, "n 3"]
Solved = tuple[np.ndarray, np.ndarray, list[np.ndarray], list[np.ndarray]]


class InitialCamera(NamedTuple):
    """A camera at the origin, the board's pose in it by moment, and each image's reprojection error in pixels."""

    camera: Camera
    cam_from_board: dict[FrameKey, Pose]
    rms: dict[FrameKey, float]


def calibrate_camera(name: str, views: BoardViews, board: Board, *, lens: Lens = "brown-conrady") -> InitialCamera:
    """A camera's intrinsics, lens and board poses from its own images.

    Raises ValueError if there are fewer than three images with a board (one, with points that are not in a plane), or
    if the board was never tilted.
    """
    fewest = FEWEST_IMAGES if board.flat else 1
    if len(views.seen) < fewest:
        raise ValueError(
            f"{name}: the board is found in {len(views.seen)} of its images and {fewest} is the least: "
            "take ten or more, at several distances and tilts"
        )
    plausible = BoardViews(views.hw, {key: near_homography(d, board) for key, d in views.seen.items()})
    camera, poses = _solved(name, plausible, board, lens)
    for _ in range(2):
        plausible = without_outliers(views, camera, poses, board.points)
        camera, poses = _solved(name, plausible, board, lens)
    check_tilts(name, poses, board)
    distances = {key: _distances(camera, pose, plausible.seen[key], board.points) for key, pose in poses.items()}
    return InitialCamera(camera, poses, {key: float(np.sqrt((d**2).mean())) for key, d in distances.items()})


def near_homography(found: Detection, board: Board) -> Detection:
    """The points that a homography of the board fits (least median of squares), apart from the lens's distortion."""
    if len(found.ids) < FEWEST_POINTS or not board.flat:
        return found
    plane = board.points[found.ids, :2]
    H, _ = cv2.findHomography(plane, found.x, cv2.LMEDS)
    if H is None:
        return found
    off = np.linalg.norm(cv2.perspectiveTransform(plane[:, None], H)[:, 0] - found.x, axis=-1)
    return _only(found, off < max(1.0, 4 * MEDIAN_TO_DEVIATION * float(np.median(off))))


def without_outliers(
    views: BoardViews, camera: Camera, poses: Mapping[FrameKey, Pose], points: Points, *, sigma: float | None = None
) -> BoardViews:
    """The views without points farther from a camera's projections than `OUTLIER` standard deviations.

    `points` are the board's, metres. `sigma` is along x or y, pixels; by default estimated from the median of all
    distances. Images without a pose, or with fewer than `FEWEST_POINTS` points or one row of them left, keep all.
    """
    off = {key: _distances(camera, poses[key], d, points) for key, d in views.seen.items() if key in poses}
    sigma = max(sigma or MEDIAN_TO_DEVIATION * float(np.median(np.concatenate(list(off.values())))), LEAST_SIGMA)
    kept = {key: _only(views.seen[key], r < OUTLIER * sigma) for key, r in off.items()}
    return BoardViews(
        views.hw,
        {key: kept[key] if key in kept and _spans(points[kept[key].ids]) else d for key, d in views.seen.items()},
    )


def _spans(points: Points) -> bool:
    """Whether there are enough points, and not all on a line."""
    if len(points) < FEWEST_POINTS:
        return False
    _, second, _ = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(second > 1e-6)


def _only(found: Detection, mask: np.ndarray) -> Detection:
    return Detection(found.ids[mask], found.x[mask])


def _solved(name: str, views: BoardViews, board: Board, lens: Lens) -> tuple[Camera, dict[FrameKey, Pose]]:
    pinhole = lens in COEFFICIENTS or lens == "none"
    try:
        K, coefficients, rotations, translations = _pinhole(views, board, lens) if pinhole else _fisheye(views, board)
    except cv2.error as error:
        raise ValueError(
            f"{name}: OpenCV finds no camera that fits these boards ({error.err}): do all show the same board?"
        ) from None
    model = "brown-conrady" if lens in COEFFICIENTS else "kannala-brandt"
    distortion = None if lens == "none" else Distortion(model, torch.tensor(coefficients))
    camera = Camera(K=torch.tensor(K), cam_from_world=Pose.identity(), hw=views.hw, distortion=distortion)
    return camera, {key: _pose(r, t) for key, r, t in zip(views.seen, rotations, translations)}


def check_tilts(name: str, poses: Mapping[FrameKey, Pose], board: Board) -> None:
    """Raises ValueError if all (flat) boards are parallel: focal length and distance are ambiguous then."""
    if not board.flat:
        return
    normals = np.stack([pose.R[:, 2].numpy() for pose in poses.values()])
    widest = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1)).max()))
    if widest < FEWEST_TILT:
        raise ValueError(
            f"{name}: all boards are parallel (to {widest:.1f} degrees), so that focal length and distance are "
            "ambiguous: tilt the board by 20 to 40 degrees, to different sides, in most of the images"
        )


def board_pose(camera: Camera, found: Detection, board: Board) -> Pose:
    """`cam_from_board` of one image, for a camera whose intrinsics are known.

    Raises ValueError for fewer than four points in front of the camera, as a lens far from the true one may see them.
    """
    directions, valid = camera.rays(torch.from_numpy(found.x))
    rays = directions.numpy()
    usable = valid.numpy() & (rays[:, 2] > 0.05 * np.linalg.norm(rays, axis=1))
    if usable.sum() < 4:
        raise ValueError(
            f"only {usable.sum()} of {len(usable)} points of a board are in front of {camera}: a pose needs four; "
            "check its lens and focal length"
        )
    flat = rays[usable, :2] / rays[usable, 2:]
    points = board.points[found.ids[usable]]
    method = cv2.SOLVEPNP_IPPE if board.flat else cv2.SOLVEPNP_SQPNP
    first = points * (1, 1, 0) if board.flat else points
    _, r, t = cv2.solvePnP(first, flat, np.eye(3), np.zeros(4), flags=method)
    _, r, t = cv2.solvePnP(points, flat, np.eye(3), np.zeros(4), r, t, True, cv2.SOLVEPNP_ITERATIVE)
    return _pose(r, t)


def _pinhole(views: BoardViews, board: Board, lens: Lens) -> Solved:
    """Two radial terms suffice initially: (K, coefficients, rotations, translations)."""
    initial = board.points * (1, 1, 0) if board.flat else board.points
    points = [initial[d.ids].astype(np.float32) for d in views.seen.values()]
    pixels = [d.x.astype(np.float32)[:, None] for d in views.seen.values()]
    h, w = views.hw
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    if lens == "none":
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    K: np.ndarray = np.eye(3)
    if not board.flat:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        K = _linear_intrinsics(max(zip(points, pixels), key=lambda view: len(view[0])), views.hw)
    _, K, c, rotations, translations = cv2.calibrateCamera(points, pixels, (w, h), K, np.zeros(5), flags=flags)
    coefficients = np.zeros(COEFFICIENTS.get(lens, 5))
    coefficients[:2] = c.reshape(-1)[:2]
    return K, coefficients, list(rotations), list(translations)


def _linear_intrinsics(view: tuple[np.ndarray, np.ndarray], hw: HW) -> np.ndarray:
    """K with square pixels and a central principal point by a linear camera of one view (Hartley & Zisserman 7.1)."""
    X, x = view[0].astype(np.float64), view[1][:, 0].astype(np.float64)
    if len(X) < FEWEST_POINTS:
        return np.array(intrinsics(float(max(hw)), hw))
    scale, middle = hw[1] / 2, np.array([(hw[1] - 1) / 2, (hw[0] - 1) / 2])
    u, v = ((x - middle) / scale).T
    Xh, zero = np.column_stack([X / np.abs(X).max(), np.ones(len(X))]), np.zeros((len(X), 4))
    A = np.concatenate([np.hstack([Xh, zero, -u[:, None] * Xh]), np.hstack([zero, Xh, -v[:, None] * Xh])])
    P = np.linalg.svd(A)[2][-1].reshape(3, 4)
    K = cv2.decomposeProjectionMatrix(P)[0]
    focal = scale * float(np.sqrt(abs(K[0, 0] * K[1, 1]))) / abs(K[2, 2])
    return np.array(intrinsics(float(np.clip(focal, 0.3 * max(hw), 30 * max(hw))), hw))


def _fisheye(views: BoardViews, board: Board) -> Solved:
    if not board.flat:
        raise ValueError("fisheyes need a flat board to start from: points of known position give pinhole cameras")
    points = [board.points[d.ids][:, None] for d in views.seen.values()]
    pixels = [d.x[:, None] for d in views.seen.values()]
    h, w = views.hw
    K = np.array([[w / np.pi, 0, (w - 1) / 2], [0, w / np.pi, (h - 1) / 2], [0, 0, 1]])
    flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW | cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
    _, K, c, rotations, translations = cv2.fisheye.calibrate(points, pixels, (w, h), K, np.zeros((4, 1)), flags=flags)
    return K, c.reshape(-1), list(rotations), list(translations)


def _distances(camera: Camera, pose: Pose, found: Detection, points: Points) -> np.ndarray:
    projected = camera.project_local(pose.apply(torch.from_numpy(points[found.ids]))).x.numpy()
    return np.linalg.norm(projected - found.x, axis=-1)


def _pose(r: np.ndarray, t: np.ndarray) -> Pose:
    return Pose(torch.from_numpy(cv2.Rodrigues(r)[0]), torch.from_numpy(t.reshape(3).astype(np.float64)))
