"""Initial poses of cameras and boards.

Relative poses of pairs by vote, joined along a maximum spanning tree; or the poses of a roughly known rig.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch.nn.functional import pad

from arraygeom import Camera, Distortion, Pose, Rig
from arraygeom.distortion import BROWN_CONRADY, pinhole_coefficients

from .board import Board
from .bundle import CameraPrior, InitialRig, Solved, intrinsic_values, typical_prior
from .detect import BoardViews, Detection
from .intrinsics import LENSES, CalibratedViews, Lens, board_pose
from .photos import FrameKey

TOLERANCE = 0.03
"""Prediction error as a share of the image width below which a frame agrees with a pose: one view of a small
board determines its tilt, hence the other camera's position, no better."""
FEWEST_TO_JUDGE = 3
"""Least number of shared frames to check two cameras for consistency."""
MOST_CANDIDATES = 15


class RelativePose(NamedTuple):
    """Relative pose of two cameras, with the frames in which both see the board.

    Attributes:
        a_from_b: pose of the first camera from the second, metres.
        agreeing: shared frames that agree with it; may be empty.
        shared: all shared frames.
        score: number of agreeing frames, then minus the sum of their errors in the first camera's pixels;
            larger is better.
    """

    a_from_b: Pose
    agreeing: tuple[FrameKey, ...]
    shared: tuple[FrameKey, ...]
    score: tuple[int, float]

    @property
    def consistent(self) -> bool:
        """True if most frames agree, or there are too few to judge."""
        return len(self.shared) < FEWEST_TO_JUDGE or len(self.agreeing) > max(1, len(self.shared) // 2)


@dataclass(frozen=True)
class StartDeviations:
    """Standard deviations of each camera's parameters about a start rig.

    Attributes:
        position: optical centre along each axis, metres.
        rotation: rotation about each axis, degrees.
        focal: share of the focal length.
        centre: principal point as a share of the width.

    Raises:
        ValueError: for a value that is not positive and finite.
    """

    position: float = 5e-4
    rotation: float = 3.0
    focal: float = 0.02
    centre: float = 0.01

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < float("inf"):
                raise ValueError(f"the start's deviation {name}={value:g} is not a positive number")

    @classmethod
    def from_numbers(cls, deviations: Mapping[str, float]) -> StartDeviations:
        """Make deviations from values by name; the others keep their defaults.

        Raises:
            ValueError: for an unknown name, and values that are not positive.
        """
        if unknown := deviations.keys() - vars(cls()).keys():
            raise ValueError(f"a start has no deviation '{min(unknown)}': it has {', '.join(vars(cls()))}")
        return cls(**deviations)


def start_prior(camera: Camera, deviations: StartDeviations) -> CameraPrior:
    """Make the prior of a camera whose parameters are roughly known from a start rig.

    Args:
        camera: camera of the start rig.
        deviations: standard deviations about it.

    Returns:
        The prior: the mean is the camera, its pose and lens coefficients too; deviations of the lens and of
        the aspect ratio are an ordinary camera's (`typical_prior`).
    """
    information = typical_prior(camera).information.copy()
    information[:3, :3] = np.eye(3) / np.radians(deviations.rotation) ** 2
    information[3:6, 3:6] = np.eye(3) / deviations.position**2
    mean = intrinsic_values(camera)
    information[6:8, 6:8] += np.full((2, 2), 0.25) / (deviations.focal * float(mean[6:8].mean())) ** 2
    information[8:10, 8:10] = np.eye(2) / (deviations.centre * camera.hw[1]) ** 2
    return CameraPrior(mean, information, camera.cam_from_world)


def initial_rig(singles: Mapping[str, Solved], board: Board) -> InitialRig:
    """Estimate poses of all cameras and boards from pairs, along the spanning tree of most agreeing corners.

    Args:
        singles: each camera's own calibration by name, at least one.

    Returns:
        Initial values as `consistent_boards` makes them; the first camera is the world.

    Raises:
        ValueError: if a camera shares no frame with those joined before, or most frames of its pairs
            contradict each other (mirrored images, different moments).
    """
    cameras = [
        CalibratedViews(name, single.problem.cameras[name], single.views[name], single.problem.board_poses)
        for name, single in singles.items()
    ]
    pairs = {(a.name, b.name): pair for a, b in combinations(cameras, 2) if (pair := pair_pose(a, b, board))}
    return consistent_boards(cameras, _along_tree(cameras, pairs, board), board)


def rig_near_start(
    start: Rig,
    views: Mapping[str, BoardViews],
    board: Board,
    lens: Mapping[str, Lens],
    deviations: StartDeviations,
) -> InitialRig:
    """Initialise cameras at a start rig's positions, rotated so that they agree on the boards.

    The camera with most images keeps its orientation. Cameras keep the start's intrinsics and lens; Brown and
    Conrady's gets the terms that `lens` has more, as zeros, and a pinhole the model `lens` without effect.

    Args:
        start: roughly known rig; cameras without `views` are ignored.
        views: detections by camera, at least one camera.
        lens: name of the lens model by camera, one of `LENSES`.
        deviations: standard deviations about the start.

    Returns:
        Initial values as `consistent_boards` makes them, with priors about the start.

    Raises:
        KeyError: for a camera without a lens model, or an unknown one.
        ValueError: if the start lacks a camera or has it in another size, a camera shares no moment with
            another, or none of its images fits the start.
        ValueError, cv2.error: as `board_pose`.
    """
    cameras = []
    for name, v in views.items():
        camera = _start_camera(name, start, v, lens[name])
        others = [other.seen.keys() for n, other in views.items() if n != name]
        if others and not any(v.seen.keys() & keys for keys in others):
            raise ValueError(f"{name}: shares no frame with another camera: check the images' numbers")
        board_poses = {key: board_pose(camera, d, board) for key, d in v.seen.items()}
        cameras.append(CalibratedViews(name, camera, v, board_poses))
    poses = _aligned(cameras, board)
    priors = {v.name: start_prior(v.camera, deviations) for v in cameras}
    initial = consistent_boards(cameras, poses, board)
    if lost := [name for name, v in initial.views.items() if not v.seen]:
        raise ValueError(
            f"{lost[0]}: its boards are nowhere near where the start and the other cameras put them: "
            "are the start's positions right, and in metres?"
        )
    return initial._replace(priors=priors)


def _start_camera(name: str, start: Rig, views: BoardViews, model_name: Lens) -> Camera:
    """Camera of a start, see `rig_near_start`; ValueError if it is missing or of another size."""
    camera = start.cameras.get(name)
    if not isinstance(camera, Camera):
        raise ValueError(f"{name}: the start has no calibrated camera called so; it has {list(start.names)}")
    if camera.hw != views.hw:
        (h, w), (rows, columns) = camera.hw, views.hw
        raise ValueError(f"{name}: its images are {columns}x{rows} and the start states {w}x{h}")
    model, count = LENSES[model_name]
    distortion = camera.distortion
    if distortion is None and count:
        lens = Distortion(model, torch.zeros(count, dtype=torch.float64))
        camera = camera.replace(distortion=lens.with_coefficients(pinhole_coefficients(lens)))
    elif distortion is not None and distortion.model == model == BROWN_CONRADY:
        missing = max(0, count - distortion.coefficients.shape[-1])
        camera = camera.replace(
            distortion=distortion.with_coefficients(pad(distortion.coefficients, (0, missing)))
        )
    return camera.to(torch.float64)


def _aligned(cameras: Sequence[CalibratedViews], board: Board) -> dict[str, Pose]:
    """`cam_from_world` of all cameras, oriented by frames shared with an earlier one, else unchanged."""
    first, symmetries = max(cameras, key=lambda v: len(v.poses)), symmetry_poses(board)
    poses = {first.name: first.camera.cam_from_world}
    for _ in cameras[1:]:
        pairs = ((a, b) for a in cameras for b in cameras if a.name in poses and b.name not in poses)
        a, b = max(pairs, key=lambda pair: len(pair[0].poses.keys() & pair[1].poses.keys()))
        pose, nominal = b.camera.cam_from_world, a.camera.cam_from_world @ b.camera.cam_from_world.inverse()
        if shared := [key for key in b.poses if key in a.poses]:
            a_from_b = average_pose(
                [nearest_pose(nominal, a.poses[key], b.poses[key], symmetries) for key in shared]
            )
            pose = Pose.from_centre(a_from_b.R.T @ poses[a.name].R, b.camera.centre)
        poses[b.name] = pose
    return poses


def pair_pose(a: CalibratedViews, b: CalibratedViews, board: Board) -> RelativePose | None:
    """Find the relative pose of two cameras with which most shared frames agree.

    Returns:
        The pose, even if few frames agree or none; None without shared frames.
    """
    shared = tuple(key for key in a.views.seen if key in b.views.seen)
    if not shared:
        return None
    symmetries = symmetry_poses(board)
    tried = shared[:: max(1, len(shared) // MOST_CANDIDATES)]
    candidates = [
        a.poses[key] @ symmetry @ b.poses[key].inverse() for key in tried for symmetry in symmetries
    ]
    voted = max((_vote(a, b, pose, shared, board) for pose in candidates), key=lambda v: v.score)
    for _ in range(2):
        poses = [nearest_pose(voted.a_from_b, a.poses[k], b.poses[k], symmetries) for k in voted.agreeing]
        averaged = _vote(a, b, average_pose(poses or [voted.a_from_b]), shared, board)
        voted = max(voted, averaged, key=lambda v: v.score)
    return voted


def _vote(
    a: CalibratedViews, b: CalibratedViews, a_from_b: Pose, shared: tuple[FrameKey, ...], board: Board
) -> RelativePose:
    """Relative pose with the frames that agree with it."""
    errors = _prediction_errors(a, {key: a_from_b @ b.poses[key] for key in shared}, board).min(0)
    agree = errors < _tolerance(a)
    frames = tuple(key for key, good in zip(shared, agree) if good)
    return RelativePose(a_from_b, frames, shared, (len(frames), -float(errors[agree].sum())))


def nearest_pose(a_from_b: Pose, a_from_board: Pose, b_from_board: Pose, symmetries: Sequence[Pose]) -> Pose:
    """Return one frame's relative pose, for the board numbering that brings it closest to `a_from_b`."""
    poses = [a_from_board @ symmetry @ b_from_board.inverse() for symmetry in symmetries]
    return max(poses, key=lambda pose: float((pose.R * a_from_b.R).sum()))


def average_pose(poses: Sequence[Pose]) -> Pose:
    """Average poses: the chordal mean of rotations, and the median translation."""
    R = Rotation.from_matrix(np.stack([pose.R for pose in poses])).mean().as_matrix()
    return Pose(torch.from_numpy(R), torch.stack([pose.t for pose in poses]).median(0).values)


def symmetry_poses(board: Board) -> list[Pose]:
    """Return the rotations of a board that belong to its renumberings (`Board.symmetries`)."""
    poses, mean = [], board.points.mean(0)
    for image in board.symmetries:
        R = Rotation.align_vectors(board.points[image] - mean, board.points - mean)[0].as_matrix()
        poses.append(Pose(torch.from_numpy(R), torch.from_numpy(mean - R @ mean)))
    return poses


def _prediction_errors(
    camera: CalibratedViews, cam_from_board: Mapping[FrameKey, Pose], board: Board
) -> Float[np.ndarray, "s k"]:
    """Median distance of a camera's points from predicted board poses, pixels, by numbering and frame."""
    detections = [camera.views.seen[key] for key in cam_from_board]
    ends, points = np.cumsum([len(d.ids) for d in detections])[:-1], torch.from_numpy(board.points)
    errors = []
    for image in board.symmetries:
        X = torch.cat([p.apply(points[image[d.ids]]) for d, p in zip(detections, cam_from_board.values())])
        x, _, valid = camera.camera.project_local(X)
        distance = np.linalg.norm(x.numpy() - np.concatenate([d.x for d in detections]), axis=-1)
        distance = np.where(valid.numpy(), distance, np.inf)
        errors.append([np.median(distances) for distances in np.split(distance, ends)])
    return np.array(errors)


def _tolerance(camera: CalibratedViews) -> float:
    """Largest error of an agreeing prediction, pixels."""
    return TOLERANCE * camera.views.hw[1]


def _along_tree(
    cameras: Sequence[CalibratedViews], pairs: Mapping[tuple[str, str], RelativePose], board: Board
) -> dict[str, Pose]:
    """Join cameras from the first one by Prim's algorithm, by the number of corners in agreeing frames."""
    poses, detections = {cameras[0].name: Pose.identity()}, {c.name: c.views.seen for c in cameras}

    def corners(edge: tuple[tuple[str, str], RelativePose]) -> int:
        return sum(len(detections[name][key].ids) for name in edge[0] for key in edge[1].agreeing)

    consistent = {names: pair for names, pair in pairs.items() if pair.consistent}
    while len(poses) < len(cameras):
        edges = _crossing(consistent, poses)
        if not edges:
            raise ValueError(_connection_error(cameras, poses, pairs, board))
        (a, b), pair = max(edges.items(), key=corners)
        if a in poses:
            poses[b] = pair.a_from_b.inverse() @ poses[a]
        else:
            poses[a] = pair.a_from_b @ poses[b]
    return poses


def _crossing(
    pairs: Mapping[tuple[str, str], RelativePose], joined: Collection[str]
) -> dict[tuple[str, str], RelativePose]:
    """Pairs of which exactly one camera is joined."""
    return {names: pair for names, pair in pairs.items() if (names[0] in joined) != (names[1] in joined)}


def consistent_boards(cameras: Sequence[CalibratedViews], poses: dict[str, Pose], board: Board) -> InitialRig:
    """Choose board poses that most cameras agree with, and number all cameras' points consistently.

    Args:
        cameras: cameras with their own board poses.
        poses: `cam_from_world` by camera, of all cameras.

    Returns:
        Initial values, with a board pose for each moment; images that contradict it are in `left_out` and not
        in `views`, in which a camera may keep none.
    """
    boards: dict[FrameKey, Pose] = {}
    detections: dict[str, dict[FrameKey, Detection]] = {c.name: {} for c in cameras}
    left_out = []
    for key in dict.fromkeys(key for c in cameras for key in c.views.seen):
        views = sorted((c for c in cameras if key in c.views.seen), key=lambda c: -len(c.views.seen[key].ids))
        proposed = [poses[c.name].inverse() @ c.poses[key] for c in views]
        errors = [
            [_prediction_errors(c, {key: poses[c.name] @ pose}, board)[:, 0] for c in views]
            for pose in proposed
        ]
        agreeing = [sum(e.min() < _tolerance(c) for e, c in zip(row, views)) for row in errors]
        anchor = int(np.argmax(agreeing))
        boards[key] = proposed[anchor]
        for i, (camera, error) in enumerate(zip(views, errors[anchor])):
            if i == anchor or error.min() < 3 * _tolerance(camera):
                detection = camera.views.seen[key]
                numbers = board.symmetries[int(error.argmin())]
                detections[camera.name][key] = Detection(numbers[detection.ids], detection.x)
            else:
                left_out.append((camera.name, key))
    placed = {c.name: c.camera.replace(cam_from_world=poses[c.name]) for c in cameras}
    views_of = {c.name: BoardViews(c.views.hw, detections[c.name]) for c in cameras}
    return InitialRig(placed, boards, views_of, left_out)


def _connection_error(
    cameras: Sequence[CalibratedViews],
    joined: Collection[str],
    pairs: Mapping[tuple[str, str], RelativePose],
    board: Board,
) -> str:
    """Error message if no consistent pair joins the remaining cameras."""
    by_name = {c.name: c for c in cameras}
    if not (crossing := _crossing(pairs, joined)):
        rest = ", ".join(name for name in by_name if name not in joined)
        return (
            f"{rest}: never sees the board in the same frame as {' or '.join(joined)}: take images with the "
            "board where both see it, and check that images of one moment have the same number"
        )
    (a, b), pair = max(crossing.items(), key=lambda edge: len(edge[1].shared))
    return (
        f"{a} and {b} contradict each other: only {len(pair.agreeing)} of the {len(pair.shared)} frames both "
        f"see fit one relative pose; {_explain_contradiction(by_name[a], by_name[b], board)}"
    )


def _explain_contradiction(a: CalibratedViews, b: CalibratedViews, board: Board) -> str:
    """Find what would make two cameras' frames agree: mirroring one, or shifting it by a few frames."""
    for mirrored, other in () if board.identified else ((b, a), (a, b)):
        if (pair := pair_pose(other, _mirrored(mirrored, board), board)) and pair.consistent:
            return f"they agree once {mirrored.name} is mirrored: save its images as captured, not mirrored"
    for shift in (1, -1, 2, -2, 3, -3):
        pair = pair_pose(a, _shifted(a, b, shift), board)
        if pair and pair.consistent and len(pair.shared) >= FEWEST_TO_JUDGE:
            frames, late = ("frame", "frames")[abs(shift) > 1], "late" if shift > 0 else "early"
            return f"they agree if {b.name} is {abs(shift)} {frames} {late}: renumber its images"
    return "were the images taken at the same moments, with matching numbers, and without moving the cameras?"


def _mirrored(calibrated: CalibratedViews, board: Board) -> CalibratedViews:
    """Camera with its images mirrored."""
    width, columns = calibrated.views.hw[1], board.columns
    K = calibrated.camera.K.clone()
    K[0, 2] = width - 1 - K[0, 2]
    camera = calibrated.camera.replace(K=K)
    flipped = {}
    for key, d in calibrated.views.seen.items():
        ids = (d.ids // columns) * columns + (columns - 1 - d.ids % columns)
        flipped[key] = Detection(ids, np.stack([width - 1 - d.x[:, 0], d.x[:, 1]], -1))
    poses = {key: board_pose(camera, d, board) for key, d in flipped.items()}
    return CalibratedViews(calibrated.name, camera, BoardViews(calibrated.views.hw, flipped), poses)


def _shifted(a: CalibratedViews, b: CalibratedViews, shift: int) -> CalibratedViews:
    """Camera b with each image renumbered as the one `shift` positions before, among all numbers of both."""
    keys = sorted({*a.views.seen, *b.views.seen}, key=lambda k: (isinstance(k, str), k))
    renamed = {key: keys[i - shift] for i, key in enumerate(keys) if 0 <= i - shift < len(keys)}
    detections = {renamed[key]: d for key, d in b.views.seen.items() if key in renamed}
    poses = {renamed[key]: p for key, p in b.poses.items() if key in renamed}
    return CalibratedViews(b.name, b.camera, BoardViews(b.views.hw, detections), poses)
