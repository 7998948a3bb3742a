"""Arrays of cameras with known ground truth, and their views of a board: corners by projection."""

import numpy as np
import torch

from arraygeom import Camera, Distortion, Pose, Rig, intrinsics, rotation_from_vector, stack
from arraygeom.pose import rotation_vector
from calib.boards.bundle import BundleProblem, Observations, intrinsic_values, parameter_names
from calib.boards.detect import BoardViews, Detection
from calib.boards.target import Board, parse_board

BOARD = parse_board("charuco:9x7:60mm")


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def camera(
    focal,
    hw,
    centre=(0.0, 0.0, 0.0),
    turn=(0.0, 0.0, 0.0),
    lens=(),
    model="brown-conrady",
    offset=(3.0, -2.0),
):
    """A camera at `centre` in the world, rotated by a rotation vector in degrees."""
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
                (760.0, 764.0),
                (480, 640),
                (0.18, 0.02, 0.0),
                (0.5, -4.0, 0.8),
                (-0.25, 0.08, -0.0006, 0.0004, 0.0),
            ),
            "nir": camera(
                600.0, (480, 640), (-0.15, 0.0, 0.03), (-1.0, 3.0, -0.4), (-0.3, 0.12, 0.0, 0.0, 0.0)
            ),
            "wide": camera(
                420.0, (480, 640), (0.03, -0.2, 0.01), (-4.0, 0.0, 2.0), (-0.2, 0.05, 0.0, 0.0, 0.0)
            ),
        }
    )


def board_poses(count, *, seed=0, depth=(0.9, 2.4), tilt=35.0, spread=0.4) -> Pose:
    """`world_from_board` in front of a camera at the origin: random positions, depths and tilts."""
    random = np.random.default_rng(seed)
    middle = BOARD.points.mean(0)
    poses = []
    for _ in range(count):
        vector = np.deg2rad(np.append(random.uniform(-tilt, tilt, 2), random.uniform(-20, 20)))
        R = rotation_from_vector(tensor(*vector))
        z = random.uniform(*depth)
        target = tensor(*(z * random.uniform(-spread, spread, 2)), z)
        poses.append(Pose(R, target - R @ tensor(*middle)))
    return stack(poses)


def see(rig, boards, board: Board = BOARD, *, noise=0.0, seed=1) -> dict[str, BoardViews]:
    """Project the boards into every camera of a rig, with noise in pixels along x and y."""
    random = np.random.default_rng(seed)
    views = {}
    for name, camera in rig.cameras.items():
        seen = {}
        for frame in range(len(boards.t)):
            X = boards[frame].apply(torch.from_numpy(board.points))
            x, _, valid = camera.project(X)
            inside = (valid & camera.contains(x)).numpy()
            if inside.sum() >= 12:
                measured = x.numpy()[inside] + random.normal(0, noise, (inside.sum(), 2))
                seen[frame] = Detection(np.flatnonzero(inside), measured)
        views[name] = BoardViews(camera.hw, seen)
    return views


def all_free(cameras, *, lens: int = 5) -> dict[str, np.ndarray]:
    """All numbers but the first camera's pose and the lens's later terms."""
    free = {}
    for index, (name, c) in enumerate(cameras.items()):
        free[name] = np.ones(len(parameter_names(c)), dtype=bool)
        free[name][:6] = index > 0
        free[name][10 + lens :] = False
    return free


def scene_of(rig, boards, views, board: Board = BOARD) -> BundleProblem:
    """The ground truth as a problem to adjust."""
    seen = {}
    for name, v in views.items():
        parts = [(np.full(len(d.ids), frame), board.points[d.ids], d.x) for frame, d in v.seen.items()]
        seen[name] = Observations(*(np.concatenate(part) for part in zip(*parts)))
    return BundleProblem(dict(rig.cameras), boards, seen, tuple(range(len(boards.t))), all_free(rig.cameras))


def errors_of(fit, rig):
    """Estimate minus ground truth of every free parameter, in the order of `fit.names`."""
    found = []
    for name, camera_found in fit.problem.cameras.items():
        turn = rotation_vector(camera_found.R @ rig[name].R.T)
        values = intrinsic_values(camera_found) - intrinsic_values(rig[name])
        values[:6] = *turn.tolist(), *(camera_found.t - rig[name].t).tolist()
        entries = [f"{name}.{entry}" for entry in parameter_names(camera_found)]
        found += [v for v, entry in zip(values, entries) if entry in fit.names]
    return np.array(found)


def pose_errors(fit, rig):
    """The largest error of orientations (degrees) and of optical centres (metres)."""
    cameras = fit.problem.cameras.items()
    radians = [float(rotation_vector(c.R @ rig[n].R.T).norm()) for n, c in cameras]
    return np.degrees(max(radians)), max(float((c.centre - rig[n].centre).norm()) for n, c in cameras)
