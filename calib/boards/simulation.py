"""Simulated calibration: images of a board by the cameras of a planned rig, before a board is printed.

`simulate_photos` writes a folder that `pat calibrate` reads. It shows which board, how many images and which
depths a planned array needs, and how accurately it would be calibrated.
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from torch import Tensor

from arraygeom import Camera, Pose, Rig, pixel_grid, rotation_from_vector, stack
from arraygeom.runtime.atomic import write_atomically
from arraygeom.viz import calibrated

from .board import Board
from .target import MARGIN, draw_board

FILLS = (0.35, 0.9)
"""Least and largest width of the board as a share of the narrowest view."""
TILT = 35.0
"""Largest rotation of the board about x and about y, degrees."""
TRIES = 2000
WALL = 90
"""Grey value of the background."""


@torch.no_grad()
def simulate_photos(
    rig: Rig, board: Board, folder: Path, *, count: int = 12, noise: float = 1.5, seed: int = 0
) -> Pose:
    """Render photographs of a board in `count` random poses, into `folder`/CAMERA/000.png and so on.

    Grey images of 8 bits; folders are made, and files of these names replaced.

    Args:
        rig: rig; cameras that are not calibrated get no images.
        count: number of poses, and of images of each camera.
        noise: standard deviation of the noise, in grey values of 255.
        seed: seed of poses and noise.

    Returns:
        The true `world_from_board`, a batch (count).

    Raises:
        ValueError: for a rig without calibrated cameras, too few poses whose middles all cameras see, a board
            that cannot be printed, a `count` below 1, and a `noise` that is negative or not finite.
        OSError: if files cannot be written.
    """
    if not 0 <= noise < math.inf:
        raise ValueError(f"noise is a standard deviation in grey values, 0 or more; got {noise:g}")
    boards = board_poses(rig, board, count, seed=seed)
    random = np.random.default_rng(seed)
    for name, camera in calibrated(rig).items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        rays = fine_rays(camera)
        for i in range(count):
            pose = camera.cam_from_world @ boards[i]
            image = photograph(camera, pose, board, rays=rays) + random.normal(0, noise, camera.hw)
            png = cv2.imencode(".png", np.clip(image.round(), 0, 255).astype(np.uint8))[1]
            with write_atomically(folder / name / f"{i:03d}.png") as temporary:
                temporary.write_bytes(png.tobytes())
    return boards


@torch.no_grad()
def board_poses(rig: Rig, board: Board, count: int, *, seed: int = 0) -> Pose:
    """Draw random board poses whose middles all calibrated cameras see, at several depths and tilts.

    Args:
        rig: rig; cameras that are not calibrated are ignored.
        board: the board.
        count: number of poses, 1 or more.
        seed: random seed.

    Returns:
        `world_from_board`, a batch (count), float64.

    Raises:
        ValueError: if too few such poses are found, for a rig without calibrated cameras, and for a `count`
            below 1.
    """
    if count < 1:
        raise ValueError(f"count is a number of images, 1 or more; got {count}")
    cameras, random = list(calibrated(rig).values()), np.random.default_rng(seed)
    narrow = max(float(c.K[0, :2].norm()) / c.hw[1] for c in cameras)
    middle = torch.from_numpy(board.middle)
    poses: list[Pose] = []
    for _ in range(TRIES):
        camera = cameras[random.integers(len(cameras))]
        depth = max(board.extent) * narrow / random.uniform(*FILLS)
        x = torch.from_numpy(random.uniform(0.15, 0.85, 2) * (np.array(camera.hw[::-1]) - 1))
        centre = camera.unproject(x, torch.tensor(depth))
        if all(bool(p.valid) and bool(c.contains(p.x)) for c in cameras for p in [c.project(centre)]):
            rotation = np.radians([*random.uniform(-TILT, TILT, 2), random.uniform(-20, 20)])
            R = camera.R.T.double() @ rotation_from_vector(torch.from_numpy(rotation))
            poses.append(Pose(R, centre - R @ middle))
        if len(poses) == count:
            return stack(poses)
    raise ValueError(f"the cameras hardly see the board {board} together: take a larger or a smaller one")


Rays = tuple[Float[Tensor, "n 3"], Bool[Tensor, " n"]]


@torch.no_grad()
def photograph(
    camera: Camera, cam_from_board: Pose, board: Board, *, rays: Rays | None = None
) -> UInt8[np.ndarray, "h w"]:
    """Render the image of a printed board by a camera, through its lens, as the mean of four samples a pixel.

    Args:
        camera: the camera, which counts as central; its own pose does not count.
        cam_from_board: pose of the board, float64.
        board: a single board; ValueError for one that cannot be printed (`draw_board`).
        rays: result of `fine_rays(camera)`; None to compute it.

    Returns:
        Grey image (h, w), uint8, without noise; `WALL` around the print, and where the lens has no ray.
    """
    directions, valid = rays or fine_rays(camera)
    R, t = cam_from_board.R, cam_from_board.t
    distance = (R[:, 2] @ t) / (directions @ R[:, 2])
    on_board = (directions * distance[:, None] - t) @ R
    print_, per_metre, origin = printed(board, _resolution(camera, cam_from_board, board))
    hw = 2 * camera.hw[0], 2 * camera.hw[1]
    on_print = (on_board[:, :2].numpy() * per_metre + origin).astype(np.float32).reshape(*hw, 2)
    on_print[~(valid & (distance > 0)).reshape(hw).numpy()] = -1
    u, v = cv2.split(on_print)
    image = cv2.remap(print_, u, v, cv2.INTER_LINEAR, borderValue=(WALL,))
    return np.asarray(cv2.resize(image, camera.hw[::-1], interpolation=cv2.INTER_AREA), np.uint8)


def fine_rays(camera: Camera) -> Rays:
    """Compute rays (4 h w, 3) of twice a camera's pixels, in its frame, and True where the lens has one."""
    fine = camera.to(torch.float64).resize((2 * camera.hw[0], 2 * camera.hw[1]))
    return fine.rays(pixel_grid(fine.hw, dtype=torch.float64).reshape(-1, 2))


def _resolution(camera: Camera, cam_from_board: Pose, board: Board) -> float:
    """Dots per inch at which a dot is half a pixel at the board's centre, in steps of a tenth."""
    middle = torch.from_numpy(board.middle)
    depth = max(float(cam_from_board.apply(middle[None])[0, 2]), 1e-3)
    exact = 2 * float(camera.K[0, :2].norm()) / depth * 0.0254
    return float(min(max(1.1 ** round(math.log(exact, 1.1)), 20.0), 300.0))


@lru_cache(maxsize=32)
def printed(board: Board, dpi: float) -> tuple[UInt8[np.ndarray, "h w"], float, Float[np.ndarray, "2"]]:
    """Draw the printed board, with its margin and ruler, as an image.

    Args:
        board: a single board; ValueError for one that cannot be printed (`draw_board`).
        dpi: pixels for each inch.

    Returns:
        Grey values (h, w), uint8, which are cached and must not be changed; pixels for each metre; and the
        pixel (x, y) of the board's first point.
    """
    figure = draw_board(board)
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    canvas.draw()
    grey = np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., 0])
    per_metre = dpi / 0.0254
    origin = np.full(2, (MARGIN + board.offset) * per_metre - 0.5)
    origin[1] += len(grey) - figure.get_size_inches()[1] * dpi  # the canvas is cut to whole pixels at its top
    return grey, per_metre, origin
