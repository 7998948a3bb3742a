"""Arrays of cameras with known truth, and what they see of a board: corners by projection, pictures by warping."""

import cv2
import numpy as np
import torch

from arraygeom import Camera, Distortion, Pose, Rig, intrinsics, pixel_grid, rotation_from_vector
from calib.boards import Board, Circles, draw_board, parse_board
from calib.bundle import BoardPoses, Observations, Scene
from calib.detect import Detection
from calib.intrinsics import Views

BOARD = parse_board("charuco:9x7:60mm")


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def camera(focal, hw, centre=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), lens=(), model="brown-conrady", offset=(3.0, -2.0)):
    """A camera at `centre` in the world, turned by a rotation vector in degrees."""
    middle = (hw[1] - 1) / 2 + offset[0], (hw[0] - 1) / 2 + offset[1]
    pose = Pose.from_centre(rotation_from_vector(torch.deg2rad(tensor(*turn))), tensor(*centre))
    distortion = Distortion(model, tensor(*lens)) if lens else None
    return Camera(K=intrinsics(focal, hw, middle), cam_from_world=pose, hw=hw, distortion=distortion)


def four_cameras() -> Rig:
    """Unlike cameras of a small array, looking at about 2 m."""
    return Rig(
        {
            "mono": camera(1150.0, (720, 960), lens=(-0.12, 0.03, 0.0005, -0.0003, 0.0)),
            "colour": camera(
                (760.0, 764.0), (480, 640), (0.18, 0.02, 0.0), (0.5, -4.0, 0.8), (-0.25, 0.08, -0.0006, 0.0004, 0.0)
            ),
            "nir": camera(600.0, (480, 640), (-0.15, 0.0, 0.03), (-1.0, 3.0, -0.4), (-0.3, 0.12, 0.0, 0.0, 0.0)),
            "wide": camera(420.0, (480, 640), (0.03, -0.2, 0.01), (-4.0, 0.0, 2.0), (-0.2, 0.05, 0.0, 0.0, 0.0)),
        }
    )


def board_poses(count, *, seed=0, depth=(0.9, 2.4), tilt=35.0, spread=0.4) -> Pose:
    """`world_from_board` in front of a camera at the origin: random places, depths and tilts."""
    random = np.random.default_rng(seed)
    middle = BOARD.points.mean(0)
    rotations, translations = [], []
    for _ in range(count):
        vector = np.deg2rad(np.append(random.uniform(-tilt, tilt, 2), random.uniform(-20, 20)))
        R = rotation_from_vector(tensor(*vector))
        z = random.uniform(*depth)
        target = tensor(*(z * random.uniform(-spread, spread, 2)), z)
        rotations.append(R)
        translations.append(target - R @ tensor(*middle))
    return Pose(torch.stack(rotations), torch.stack(translations))


def see(rig, boards, board: Board = BOARD, *, noise=0.0, seed=1) -> dict[str, Views]:
    """What every camera of a rig sees of the boards, with noise in pixels along x and y."""
    random = np.random.default_rng(seed)
    views = {}
    for name, camera in rig.cameras.items():
        seen = {}
        for frame in range(len(boards.t)):
            X = Pose(boards.R[frame], boards.t[frame]).apply(torch.from_numpy(board.points))
            x, _, valid = camera.project(X)
            inside = (valid & camera.contains(x)).numpy()
            if inside.sum() >= 12:
                measured = x.numpy()[inside] + random.normal(0, noise, (inside.sum(), 2))
                seen[frame] = Detection(np.flatnonzero(inside), measured)
        views[name] = Views(camera.hw, seen)
    return views


def scene_of(rig, boards, views, board: Board = BOARD) -> Scene:
    """The truth as a scene to adjust."""
    seen = {}
    for name, v in views.items():
        parts = [(np.full(len(d.ids), frame), board.points[d.ids], d.x) for frame, d in v.seen.items()]
        seen[name] = Observations(*(np.concatenate(part) for part in zip(*parts)))
    return Scene(dict(rig.cameras), BoardPoses(boards), seen)


def photograph(camera, cam_from_board: Pose, board: Board = BOARD, *, dpi=160, background=90) -> np.ndarray:
    """The picture (h, w) uint8 that a camera takes of a printed board, through its lens, twice oversampled."""
    print_, per_metre, origin = printed(board, dpi)
    fine = camera.resize((2 * camera.hw[0], 2 * camera.hw[1]))
    rays, valid = fine.rays(pixel_grid(fine.hw, dtype=torch.float64).reshape(-1, 2))
    R, t = cam_from_board.R, cam_from_board.t
    distance = (R[:, 2] @ t) / (rays @ R[:, 2])
    on_board = (rays * distance[:, None] - t) @ R
    on_print = (on_board[:, :2].numpy() * per_metre + origin).astype(np.float32).reshape(*fine.hw, 2)
    on_print[~valid.reshape(fine.hw).numpy()] = -1
    picture = cv2.remap(print_, on_print, None, cv2.INTER_LINEAR, borderValue=background)
    return cv2.resize(picture, camera.hw[::-1], interpolation=cv2.INTER_AREA)


def printed(board: Board, dpi: int) -> tuple[np.ndarray, float, np.ndarray]:
    """The board as it comes out of a printer: pixels, pixels a metre, the pixel of its first point."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = draw_board(board, margin=0.012)
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(dpi)
    canvas.draw()
    grey = np.asarray(canvas.buffer_rgba())[..., 0]
    per_metre = dpi / 0.0254
    first = board.radius if isinstance(board, Circles) else board.spacing
    origin = np.full(2, (0.012 + first) * per_metre - 0.5)
    origin[1] += len(grey) - figure.get_size_inches()[1] * dpi  # the canvas is cut to whole pixels at its top
    return np.ascontiguousarray(grey), per_metre, origin
