"""Calibration of one camera from its images: initial values by Zhang's method (OpenCV), outliers, board
poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from arraygeom import Camera, Distortion, Pose, intrinsics
from arraygeom.lenses.central import MODELS
from arraygeom.pixels import HW

from . import Lens
from .board import Board, on_a_line
from .detect import BoardViews, Detection, homography_errors
from .photos import FrameKey

LENSES: dict[Lens, tuple[str, int]] = {
    "brown-conrady": ("brown-conrady", 5),
    "rational": ("brown-conrady", 8),
    "thin-prism": ("brown-conrady", 12),
    "tilted": ("brown-conrady", 14),
    "kannala-brandt": ("kannala-brandt", 4),
    "omni": ("unified", 5),
    "double-sphere": ("double-sphere", 2),
    "extended-unified": ("extended-unified", 2),
    "scaramuzza": ("scaramuzza", 3),
    "thin-prism-fisheye": ("thin-prism-fisheye", 8),
    "none": ("none", 0),
}
"""Model and number of coefficients of each lens choice."""
FEWEST_IMAGES = 3
FEWEST_POINTS = 6
"""Points of an image below which none is left out."""
OUTLIER = 6.0
"""Standard deviations (of a coordinate) above which a point is left out."""
LEAST_SIGMA = 0.02
"""Lower bound of that standard deviation, pixels: no real corners are better."""
RAYLEIGH_MEDIAN = 1.17741
"""Median length of a vector of two independent standard normal variables."""
OBLONG = 0.1
"""Largest relative difference between the sides of a real camera's pixels."""
FISHEYE_FITS = 0.005
"""Median reprojection error, as a share of the width, up to which a fisheye fits."""
FISHEYE_FOCALS = (0.15, 0.2, 0.25, 0.32, 0.4, 0.5, 0.7, 1.0, 1.5)
"""Focal lengths from which a fisheye's fit may start, as shares of the width: 1 / pi shows half a sphere."""
OpenCVSolution = tuple[np.ndarray, np.ndarray, list[np.ndarray], list[np.ndarray]]
"""K, distortion coefficients, rotations, translations."""


@dataclass(frozen=True)
class CalibratedViews:
    """One calibrated camera with its detections of a board.

    Attributes:
        name: name of the camera.
        camera: the camera, at the origin or, of a start rig, where that has it.
        views: detections by moment.
        poses: poses `cam_from_board` by moment, metres.
    """

    name: str
    camera: Camera
    views: BoardViews
    poses: Mapping[FrameKey, Pose]


def initial_camera(name: str, views: BoardViews, board: Board, lens: Lens) -> CalibratedViews:
    """Estimate a camera's intrinsics, lens and board poses from its own images, as initial values.

    A pinhole and Brown and Conrady's models by OpenCV, with two radial terms at most; others by their rays.

    Args:
        name: name of the camera, for messages.
        lens: lens model; KeyError for one that is not in `LENSES`.

    Returns:
        The camera at the origin, with board poses and the detections without outlying points.

    Raises:
        ValueError: for fewer than three images with a board (one, for points that are not coplanar), and if
            no camera is found.
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
        before, plausible = plausible, without_outliers(views, camera, poses, board.points)
        if all(np.array_equal(before.seen[key].ids, d.ids) for key, d in plausible.seen.items()):
            break
        camera, poses = _solved(name, plausible, board, lens)
    return CalibratedViews(name, camera, plausible, poses)


def without_bad_images(views: BoardViews, initial: CalibratedViews, board: Board) -> BoardViews:
    """Drop the images whose reprojection error is far above the others'.

    Args:
        views: all detections.
        initial: result of `initial_camera` for them; KeyError for an image that has no pose in it.

    Returns:
        All detections in images whose error (RMS of inliers) is below 2 pixels, or ten times its median.
    """
    rms = {}
    for key, pose in initial.poses.items():
        errors = _projection_errors(initial.camera, pose, initial.views.seen[key], board.points)
        rms[key] = float(np.sqrt((errors**2).mean()))
    limit = max(2.0, 10 * float(np.median(list(rms.values()))))
    return views.only([key for key in views.seen if rms[key] < limit])


def without_outliers(
    views: BoardViews,
    camera: Camera,
    poses: Mapping[FrameKey, Pose],
    points: Float[np.ndarray, "n 3"],
    *,
    sigma: float | None = None,
) -> BoardViews:
    """Drop points farther than `OUTLIER` standard deviations from a camera's projections.

    Args:
        camera: the camera; its own pose does not count.
        poses: `cam_from_board` by moment.
        points: the board's points, metres.
        sigma: standard deviation along x or y, pixels, smaller ones counting as `LEAST_SIGMA`; None or 0
            estimates it from the median of all distances.

    Returns:
        The views; images without a pose, or that would keep fewer than `FEWEST_POINTS` points or collinear
        ones, keep all.

    Raises:
        ValueError: if no image has a pose, and there is no `sigma`.
    """
    off = {
        key: _projection_errors(camera, poses[key], d, points)
        for key, d in views.seen.items()
        if key in poses
    }
    sigma = max(sigma or float(np.median(np.concatenate(list(off.values())))) / RAYLEIGH_MEDIAN, LEAST_SIGMA)
    kept = {key: views.seen[key].where(r < OUTLIER * sigma) for key, r in off.items()}
    enough = {key: d for key, d in kept.items() if _spans(points[d.ids])}
    return BoardViews(views.hw, {**views.seen, **enough})


def _spans(points: Float[np.ndarray, "n 3"]) -> bool:
    """True for enough points that are not collinear."""
    return len(points) >= FEWEST_POINTS and bool(np.linalg.matrix_rank(points - points.mean(0), 1e-6) > 1)


def _projection_errors(
    camera: Camera, pose: Pose, detection: Detection, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " m"]:
    """Distances of an image's points from a camera's projections of the board, pixels."""
    projected = camera.project_local(pose.apply(torch.from_numpy(points[detection.ids]))).x.numpy()
    return np.linalg.norm(projected - detection.x, axis=-1)


def near_homography(detection: Detection, board: Board) -> Detection:
    """Drop points far from the board's homography (least median of squares); distortion is tolerated.

    Returns:
        The remaining points; all for a board that is not flat, fewer than `FEWEST_POINTS` points, or without
        a homography.
    """
    if len(detection.ids) < FEWEST_POINTS or not board.flat:
        return detection
    off = homography_errors(board.points[detection.ids, :2], detection.x)
    return detection.where(off <= max(1.0, 4 * float(np.median(off)) / RAYLEIGH_MEDIAN))


def _solved(name: str, views: BoardViews, board: Board, lens: Lens) -> tuple[Camera, dict[FrameKey, Pose]]:
    """OpenCV's camera, and `cam_from_board` by moment. Raises ValueError if it finds none."""
    model, count = LENSES[lens]
    if model not in ("brown-conrady", "none"):
        camera, poses = _fisheye(name, views, board)
        return camera if model == "kannala-brandt" else _with_model(camera, model), poses
    try:
        K, coefficients, rotations, translations = _pinhole(views, board, count)
        distortion = Distortion(model, torch.tensor(coefficients)) if count else None
        camera = Camera(K=torch.tensor(K), cam_from_world=Pose.identity(), hw=views.hw, distortion=distortion)
        return camera, {key: _pose(r, t) for key, r, t in zip(views.seen, rotations, translations)}
    except (cv2.error, ValueError):  # none is found, or one with NaN
        raise ValueError(_advice(name, views, board)) from None


def _advice(name: str, views: BoardViews, board: Board) -> str:
    """Sentence on boards that no pinhole camera fits: whether a fisheye does."""
    camera, poses = _fisheye(name, views, board)
    errors = [_projection_errors(camera, poses[key], d, board.points) for key, d in views.seen.items()]
    off = float(np.median(np.concatenate(errors)))
    wrong = f"{name}: no pinhole camera fits these boards"
    if off < FISHEYE_FITS * views.hw[1]:
        return f"{wrong}, and a fisheye does to {off:.2g} px: give --lens kannala-brandt"
    return f"{wrong}, nor does a fisheye (to {off:.0f} px): do all images show the same board?"


def _with_model(camera: Camera, model: str) -> Camera:
    """Fit another lens model to a fisheye's rays: focal length and two terms."""
    plain = np.array(MODELS[model].harmless)
    h, w = camera.hw
    grid = np.stack(np.meshgrid(np.linspace(0, w - 1, 16), np.linspace(0, h - 1, 12)), -1).reshape(-1, 2)
    rays, valid = camera.rays(torch.from_numpy(grid))
    rays, x = rays[valid], torch.from_numpy(grid)[valid]

    def changed(values: np.ndarray) -> Camera:
        K = camera.K.clone()
        K[:2, :2] *= float(np.exp(values[0]))
        coefficients = torch.from_numpy(np.concatenate([values[1:], plain[2:]]))
        return camera.replace(K=K, distortion=Distortion(model, coefficients))

    first = np.array([0.0, *plain[:2]])
    solution = least_squares(
        lambda v: (changed(v).project_local(rays).x - x).numpy().ravel(), first, loss="soft_l1"
    )
    return changed(solution.x)


def board_pose(camera: Camera, detection: Detection, board: Board) -> Pose:
    """Estimate `cam_from_board` of one image for a camera of known intrinsics; its own pose does not count.

    Returns:
        The pose, metres.

    Raises:
        ValueError: if fewer than four points, or only points on a line, have rays less than 87 degrees from
            the mean ray (as by a wrong lens).
        cv2.error: if OpenCV fails on the points.
    """
    rays, valid = _unit_rays(camera, detection)
    try:
        return _pose_of_rays(board, detection.ids[valid], rays[valid])
    except ValueError as error:
        raise ValueError(f"{error} of {camera}: check its image, lens and focal length") from None


def _unit_rays(
    camera: Camera, detection: Detection
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Rays of length 1 through a camera's points, and a mask of those that its lens model has."""
    rays, valid = camera.rays(torch.from_numpy(detection.x))
    return (rays / rays.norm(dim=-1, keepdim=True)).numpy(), valid.numpy()


def _pose_of_rays(board: Board, ids: Int[np.ndarray, " n"], rays: Float[np.ndarray, "n 3"]) -> Pose:
    """`cam_from_board` by the rays of its points, relative to their mean: a fisheye sees boards beside it."""
    ahead = np.eye(3)
    if len(rays):
        ahead = Rotation.align_vectors([0.0, 0.0, 1.0], rays.mean(0))[0].as_matrix()
        rays = rays @ ahead.T
    usable = rays[:, 2] > 0.05
    points = board.points[ids[usable]]
    if len(points) < 4 or on_a_line(points):
        raise ValueError(
            f"{len(points)} points of a board have rays through the lens (a pose needs four, not on a line)"
        )
    flat = rays[usable, :2] / rays[usable, 2:]
    method = cv2.SOLVEPNP_IPPE if board.flat else cv2.SOLVEPNP_SQPNP
    first = points * (1, 1, 0) if board.flat else points
    _, r, t = cv2.solvePnP(first, flat, np.eye(3), np.zeros(4), flags=method)
    _, r, t = cv2.solvePnP(points, flat, np.eye(3), np.zeros(4), r, t, True, cv2.SOLVEPNP_ITERATIVE)
    turned, back = _pose(r, t), torch.from_numpy(ahead.T)
    return Pose(back @ turned.R, back @ turned.t)


def _pinhole(views: BoardViews, board: Board, count: int) -> OpenCVSolution:
    """Fit K and two radial terms, with rotations and translations, as initial values.

    Where few boards make pixels oblong, a camera with square ones, a central principal point and one radial
    term is fitted instead: the rest is left to the adjustment and its prior.
    """
    initial = board.points * (1, 1, 0) if board.flat else board.points
    points = [initial[d.ids].astype(np.float32) for d in views.seen.values()]
    pixels = [d.x.astype(np.float32)[:, None] for d in views.seen.values()]
    h, w = views.hw
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    if not count:
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    start: np.ndarray = np.eye(3)
    if not board.flat:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        start = _linear_intrinsics(max(zip(points, pixels), key=lambda view: len(view[0])), views.hw)
    K: np.ndarray
    for further in (0, cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_K2):
        _, K, c, rotations, translations = cv2.calibrateCamera(
            points, pixels, (w, h), start.copy(), np.zeros(5), flags=flags | further
        )
        if abs(np.log(K[0, 0] / K[1, 1])) < OBLONG:
            break
    coefficients = np.zeros(max(count, 2))
    coefficients[:2] = c.reshape(-1)[:2]
    return K, coefficients, list(rotations), list(translations)


def _linear_intrinsics(view: tuple[np.ndarray, np.ndarray], hw: HW) -> np.ndarray:
    """K with square pixels and central principal point by one view (Hartley & Zisserman 7.1)."""
    X, x = view[0].astype(np.float64), view[1][:, 0].astype(np.float64)
    if len(X) < FEWEST_POINTS:
        return intrinsics(float(max(hw)), hw).numpy()
    scale, middle = hw[1] / 2, np.array([(hw[1] - 1) / 2, (hw[0] - 1) / 2])
    u, v = ((x - middle) / scale).T
    Xh, zero = np.column_stack([X / np.abs(X).max(), np.ones(len(X))]), np.zeros((len(X), 4))
    A = np.concatenate([np.hstack([Xh, zero, -u[:, None] * Xh]), np.hstack([zero, Xh, -v[:, None] * Xh])])
    P = np.linalg.svd(A)[2][-1].reshape(3, 4)
    K = cv2.decomposeProjectionMatrix(P)[0]
    focal = scale * float(np.sqrt(abs(K[0, 0] * K[1, 1]))) / abs(K[2, 2])
    return intrinsics(float(np.clip(focal, 0.3 * max(hw), 30 * max(hw))), hw).numpy()


def _fisheye(name: str, views: BoardViews, board: Board) -> tuple[Camera, dict[FrameKey, Pose]]:
    """Fit focal length (from the best of `FISHEYE_FOCALS`) and two terms of a fisheye, and boards' poses."""

    def changed(values: np.ndarray) -> Camera:
        lens = Distortion("kannala-brandt", torch.tensor([*values[1:], 0, 0], dtype=torch.float64))
        K = intrinsics(float(np.exp(values[0])), views.hw)
        return Camera(K=K, cam_from_world=Pose.identity(), hw=views.hw, distortion=lens)

    detections = list(views.seen.values())
    ends = np.cumsum([len(d.ids) for d in detections])[:-1]
    every = Detection(np.concatenate([d.ids for d in detections]), np.concatenate([d.x for d in detections]))

    def placed(camera: Camera) -> list[Pose]:
        rays, valid = _unit_rays(camera, every)
        parts = zip(np.split(every.ids, ends), np.split(rays, ends), np.split(valid, ends))
        return [_pose_of_rays(board, ids[seen], directions[seen]) for ids, directions, seen in parts]

    def off(values: np.ndarray) -> np.ndarray:
        camera, points = changed(values), torch.from_numpy(board.points)
        try:
            X = torch.cat([pose.apply(points[d.ids]) for pose, d in zip(placed(camera), detections)])
        except (ValueError, cv2.error):
            return np.full(len(every.ids), float(max(views.hw)))
        errors = np.linalg.norm(camera.project_local(X).x.numpy() - every.x, axis=-1)
        return np.nan_to_num(errors, nan=np.inf).clip(max=max(views.hw))

    tried = [np.array([np.log(share * views.hw[1]), 0, 0]) for share in FISHEYE_FOCALS]
    first = min(tried, key=lambda values: float(np.median(off(values))))
    found = least_squares(off, first, loss="soft_l1", diff_step=1e-4, x_scale=(0.01, 0.01, 0.01), max_nfev=6)
    camera = changed(found.x)
    try:
        return camera, dict(zip(views.seen, placed(camera)))
    except (cv2.error, ValueError) as error:
        raise ValueError(f"{name}: no camera fits these boards: {error}") from None


def _pose(r: np.ndarray, t: np.ndarray) -> Pose:
    return Pose(torch.from_numpy(cv2.Rodrigues(r)[0]), torch.from_numpy(t.reshape(3).astype(np.float64)))
