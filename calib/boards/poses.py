"""Where the cameras are, to start from: relative poses of pairs by vote, joined along the best-connected tree."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch

from arraygeom import Camera, Pose

from .detect import Detection
from .intrinsics import Views, board_pose
from .photos import FrameKey
from .target import Board, Charuco

TOLERANCE = 0.03
"""A frame agrees with a pose if it predicts the board to this share of the image's width: one view of a small board
gives its tilt, hence the other camera's place, no better."""
FEWEST_TO_JUDGE = 3
"""Two cameras that share fewer frames than this are taken at their word."""
MOST_CANDIDATES = 15


class PairPose(NamedTuple):
    """How two cameras stand to each other, and which of the frames both see agree."""

    a_from_b: Pose
    agreeing: tuple[FrameKey, ...]
    shared: tuple[FrameKey, ...]
    corners: int

    @property
    def trusted(self) -> bool:
        """Whether enough of the frames agree."""
        return len(self.shared) < FEWEST_TO_JUDGE or len(self.agreeing) > max(1, len(self.shared) // 2)


@dataclass(frozen=True)
class Seen:
    """A camera with its views and the poses that come from them."""

    name: str
    camera: Camera
    views: Views
    poses: Mapping[FrameKey, Pose]

    @property
    def tolerance(self) -> float:
        """Pixels to which a prediction must fit."""
        return TOLERANCE * self.views.hw[1]


class RigStart(NamedTuple):
    """`cam_from_world` of each camera (the first is the world), `world_from_board` of each moment, views as numbered.

    left_out: images that disagree with the others, (camera, moment).
    """

    cam_from_world: dict[str, Pose]
    world_from_board: dict[FrameKey, Pose]
    views: dict[str, Views]
    left_out: list[tuple[str, FrameKey]]


def initial_rig(cameras: Sequence[Seen], board: Board) -> RigStart:
    """All cameras' poses and all boards' from pairs, along the tree whose edges hold most corners.

    Raises ValueError if cameras are not connected by frames that both see, or if the frames of a pair contradict
    each other: images that are mirrored, or not of the same moments.
    """
    pairs = {(a.name, b.name): found for a, b in combinations(cameras, 2) if (found := pair_pose(a, b, board))}
    poses = _along_tree(cameras, pairs, board)
    return _boards(cameras, poses, board)


def pair_pose(a: Seen, b: Seen, board: Board) -> PairPose | None:
    """The relative pose that most of the frames both see agree with; None if they share none."""
    shared = tuple(key for key in a.views.seen if key in b.views.seen)
    if not shared:
        return None
    turns = symmetry_poses(board)
    tried = shared[:: max(1, len(shared) // MOST_CANDIDATES)]
    candidates = [a.poses[key] @ turn @ b.poses[key].inverse() for key in tried for turn in turns]
    voted = max((_vote(a, b, pose, shared, board) for pose in candidates), key=lambda v: v.score)
    for _ in range(2):
        averaged = _average(
            [_nearest(voted.pose, a.poses[k], b.poses[k], turns) for k in voted.agreeing] or [voted.pose]
        )
        voted = max(voted, _vote(a, b, averaged, shared, board), key=lambda v: v.score)
    corners = sum(len(a.views.seen[k].ids) + len(b.views.seen[k].ids) for k in voted.agreeing)
    return PairPose(voted.pose, voted.agreeing, shared, corners)


class _Vote(NamedTuple):
    pose: Pose
    agreeing: tuple[FrameKey, ...]
    score: tuple[int, float]


def _vote(a: Seen, b: Seen, a_from_b: Pose, keys: Sequence[FrameKey], board: Board) -> _Vote:
    """Which frames agree with a relative pose; the score is how many, and then how well."""
    errors = _prediction_errors(a, b, a_from_b, keys, board)
    agree = errors < a.tolerance
    frames = tuple(key for key, good in zip(keys, agree) if good)
    return _Vote(a_from_b, frames, (len(frames), -float(errors[agree].sum())))


def _nearest(a_from_b: Pose, a_from_board: Pose, b_from_board: Pose, turns: Sequence[Pose]) -> Pose:
    """One frame's relative pose, at the numbering that comes closest to a given one."""
    poses = [a_from_board @ turn @ b_from_board.inverse() for turn in turns]
    return max(poses, key=lambda pose: float((pose.R * a_from_b.R).sum()))


def _average(poses: Sequence[Pose]) -> Pose:
    """The rotation nearest to the mean of all, and the median translation."""
    U, _, Vh = torch.linalg.svd(torch.stack([pose.R for pose in poses]).mean(0))
    flip = torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(U @ Vh).sign())], dtype=U.dtype))
    return Pose(U @ flip @ Vh, torch.stack([pose.t for pose in poses]).median(0).values)


def symmetry_poses(board: Board) -> list[Pose]:
    """The turns of the board that belong to its renumberings: point i goes to where point `image[i]` was."""
    found = []
    for image in board.symmetries:
        before, after = board.points - board.points.mean(0), board.points[image] - board.points.mean(0)
        cosine, sine = (
            (before[:, :2] * after[:, :2]).sum(),
            (before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]).sum(),
        )
        angle = np.arctan2(sine, cosine)
        R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        found.append(Pose(torch.from_numpy(R), torch.from_numpy(board.points.mean(0) - R @ board.points.mean(0))))
    return found


def _prediction_errors(a: Seen, b: Seen, a_from_b: Pose, keys: Iterable[FrameKey], board: Board) -> np.ndarray:
    """By frame: the median distance in a's image to where b's board pose says, at the best numbering."""
    detections, poses = zip(*((a.views.seen[key], b.poses[key]) for key in keys))
    counts = [len(d.ids) for d in detections]
    points = torch.from_numpy(board.points)
    errors = []
    for turn in symmetry_poses(board):
        X = torch.cat([(a_from_b @ pose @ turn).apply(points[d.ids]) for d, pose in zip(detections, poses)])
        x, _, valid = a.camera.project_local(X)
        distance = np.linalg.norm(x.numpy() - np.concatenate([d.x for d in detections]), axis=-1)
        distance = np.where(valid.numpy(), distance, np.inf)
        errors.append([np.median(part) for part in np.split(distance, np.cumsum(counts)[:-1])])
    return np.min(errors, axis=0)


def _along_tree(cameras: Sequence[Seen], pairs: Mapping[tuple[str, str], PairPose], board: Board) -> dict[str, Pose]:
    """Prim's: from the first camera, always the camera that is joined by most corners."""
    poses = {cameras[0].name: Pose.identity()}
    trusted = {names: pair for names, pair in pairs.items() if pair.trusted}
    while len(poses) < len(cameras):
        edges = {names: pair for names, pair in trusted.items() if (names[0] in poses) != (names[1] in poses)}
        if not edges:
            raise ValueError(_why_unconnected(cameras, list(poses), pairs, board))
        (a, b), pair = max(edges.items(), key=lambda edge: edge[1].corners)
        if a in poses:
            poses[b] = pair.a_from_b.inverse() @ poses[a]
        else:
            poses[a] = pair.a_from_b @ poses[b]
    return poses


def _boards(cameras: Sequence[Seen], poses: dict[str, Pose], board: Board) -> RigStart:
    """Board poses from the camera that sees most of each, and the other cameras' numbering made to agree."""
    boards: dict[FrameKey, Pose] = {}
    seen: dict[str, dict[FrameKey, Detection]] = {c.name: {} for c in cameras}
    left_out = []
    for key in dict.fromkeys(key for c in cameras for key in c.views.seen):
        views = sorted((c for c in cameras if key in c.views.seen), key=lambda c: -len(c.views.seen[key].ids))
        anchor = max(views, key=lambda c: _agreement(c, views, key, poses, board))
        boards[key] = poses[anchor.name].inverse() @ anchor.poses[key]
        for camera in views:
            error, numbered = _numbered(camera, key, poses[camera.name] @ boards[key], board)
            if camera is anchor or error < 3 * camera.tolerance:
                seen[camera.name][key] = numbered
            else:
                left_out.append((camera.name, key))
    views_by_name = {c.name: Views(c.views.hw, seen[c.name]) for c in cameras}
    return RigStart({c.name: poses[c.name] for c in cameras}, boards, views_by_name, left_out)


def _agreement(anchor: Seen, views: Sequence[Seen], key: FrameKey, poses: Mapping[str, Pose], board: Board) -> int:
    """How many cameras agree with where one camera says that the board is."""
    world_from_board = poses[anchor.name].inverse() @ anchor.poses[key]
    errors = [(c, _numbered(c, key, poses[c.name] @ world_from_board, board)[0]) for c in views]
    return sum(error < c.tolerance for c, error in errors)


def _numbered(camera: Seen, key: FrameKey, cam_from_board: Pose, board: Board) -> tuple[float, Detection]:
    """The numbering of an image's points that suits a board pose best, and its median error in pixels."""
    found = camera.views.seen[key]
    choices = [Detection(image[found.ids], found.x) for image in board.symmetries]
    errors = []
    for choice in choices:
        x, _, valid = camera.camera.project_local(cam_from_board.apply(torch.from_numpy(board.points[choice.ids])))
        errors.append(float(np.median(np.where(valid.numpy(), np.linalg.norm(x.numpy() - choice.x, axis=-1), np.inf))))
    best = int(np.argmin(errors))
    return errors[best], choices[best]


def _why_unconnected(
    cameras: Sequence[Seen], joined: Sequence[str], pairs: Mapping[tuple[str, str], PairPose], board: Board
) -> str:
    """What to say when the cameras joined so far have no trusted edge to the rest."""
    rest = [c.name for c in cameras if c.name not in joined]
    crossing = {names: pair for names, pair in pairs.items() if (names[0] in joined) != (names[1] in joined)}
    if not crossing:
        see = "see" if len(rest) > 1 else "sees"
        return (
            f"{_listed(rest)} never {see} the board in the same frame as {_listed(joined)}: take images with the "
            "board where both see it, and check that images of one moment have the same number"
        )
    (a, b), pair = max(crossing.items(), key=lambda edge: len(edge[1].shared))
    by_name = {c.name: c for c in cameras}
    return (
        f"{a} and {b} contradict each other: only {len(pair.agreeing)} of the {len(pair.shared)} frames both see fit "
        f"one relative pose; {_contradiction(by_name[a], by_name[b], board)}"
    )


def _contradiction(a: Seen, b: Seen, board: Board) -> str:
    """What would make two cameras' frames agree: one mirrored, or one a few frames late."""
    for mirrored, other in () if isinstance(board, Charuco) else ((b, a), (a, b)):
        if (found := pair_pose(other, _mirrored(mirrored, board), board)) and found.trusted:
            return f"they agree once {mirrored.name} is mirrored: save its images as the camera sees, not mirrored"
    for shift in (1, -1, 2, -2, 3, -3):
        found = pair_pose(a, _shifted(a, b, shift), board)
        if found and found.trusted and len(found.shared) >= FEWEST_TO_JUDGE:
            frames, late = ("frame", "frames")[abs(shift) > 1], "late" if shift > 0 else "early"
            return f"they agree once {b.name} is taken to be {abs(shift)} {frames} {late}: renumber its images"
    return "were the images taken at the same moments, numbered alike, and the cameras not moved in between?"


def _mirrored(seen: Seen, board: Board) -> Seen:
    """The camera as if its images were mirrored."""
    width, columns = seen.views.hw[1], board.columns
    K = seen.camera.K.clone()
    K[0, 2] = width - 1 - K[0, 2]
    camera = seen.camera.replace(K=K)
    flipped = {}
    for key, d in seen.views.seen.items():
        ids = (d.ids // columns) * columns + (columns - 1 - d.ids % columns)
        flipped[key] = Detection(ids, np.stack([width - 1 - d.x[:, 0], d.x[:, 1]], -1))
    poses = {key: board_pose(camera, d, board) for key, d in flipped.items()}
    return Seen(seen.name, camera, Views(seen.views.hw, flipped), poses)


def _shifted(a: Seen, b: Seen, shift: int) -> Seen:
    """b with each image numbered as the one `shift` before it among all numbers of both."""
    keys = sorted({*a.views.seen, *b.views.seen}, key=lambda k: (isinstance(k, str), k))
    renamed = {key: keys[i - shift] for i, key in enumerate(keys) if 0 <= i - shift < len(keys)}
    seen = {renamed[key]: d for key, d in b.views.seen.items() if key in renamed}
    poses = {renamed[key]: p for key, p in b.poses.items() if key in renamed}
    return Seen(b.name, b.camera, Views(b.views.hw, seen), poses)


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
