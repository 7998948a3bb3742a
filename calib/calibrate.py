"""From what cameras saw of a board to a rig, with what is known of its accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Camera, Pose, Rig, epipolar_distance
from arraygeom.pixels import map_homogeneous

from .boards import Board
from .bundle import BoardPoses, Fit, Observations, Scene, adjust, noise, parameter_names
from .intrinsics import Lens, Start, Views, board_pose, calibrate_camera
from .observability import gate
from .photos import FrameKey
from .poses import Seen, initial_rig

FEWEST_TO_HOLD_OUT = 8
"""With fewer frames that two cameras share none is held out."""
EVERY = 5
"""One in so many frames is held out."""


@dataclass(frozen=True)
class Calibration:
    """A rig and how well it is known.

    fit: scene, noise and covariance of the bundle adjustment, its blocks being `frames` in order.
    alone: each camera's reprojection error (RMS, px) when it is calibrated by itself.
    views: what was used, numbered alike in all cameras. held_out: epipolar errors of frames left out for it, px.
    """

    rig: Rig
    board: Board
    fit: Fit
    frames: tuple[FrameKey, ...]
    views: Mapping[str, Views]
    alone: Mapping[str, float]
    epipolar: Mapping[tuple[str, str], Float[np.ndarray, " n"]]
    held_out: Mapping[tuple[str, str], Float[np.ndarray, " n"]]
    notes: tuple[str, ...] = field(default=())

    @property
    def rms(self) -> float:
        """The reprojection error of all points of all pictures, pixels, gross errors included."""
        return self.fit.scene.rms()

    def deviations(self) -> dict[str, float]:
        """The standard deviation of each number that was free, by its name ("left.focal.0"), in its own unit."""
        assert self.fit.covariance is not None
        return dict(zip(self.fit.names, np.sqrt(self.fit.covariance.diagonal()).tolist()))


def calibrate(views: Mapping[str, Views], board: Board, *, lens: Lens | Mapping[str, Lens] = "brown-conrady") -> Calibration:
    """The rig that explains what its cameras saw of a board. Its world is the first camera.

    `lens` is the model for all cameras, or for each by name. Raises ValueError, saying what to do, if a camera has too
    few pictures or only parallel boards, if cameras are not connected, or if their frames contradict each other.
    """
    models = {name: lens if isinstance(lens, str) else lens[name] for name in views}
    starts = {name: calibrate_camera(name, v, board, lens=models[name]) for name, v in views.items()}
    kept = {name: _without_outliers(views[name], start) for name, start in starts.items()}
    begin = initial_rig([Seen.of(name, start, kept[name]) for name, start in starts.items()], board)
    cameras = {name: s.camera.replace(cam_from_world=begin.cam_from_world[name]) for name, s in starts.items()}
    frames = tuple(begin.world_from_board)
    scene = _scene(cameras, begin.world_from_board, begin.views, board)
    fit, free, notes = _fitted(scene)
    notes = [*_pictures_left_out(views, kept, begin.left_out), *notes]
    rig = Rig(fit.scene.cameras)
    alone = {name: _camera_rms(start) for name, start in starts.items()}
    return Calibration(
        rig=rig,
        board=board,
        fit=fit,
        frames=frames,
        views=begin.views,
        alone=alone,
        epipolar=epipolar_errors(rig, begin.views),
        held_out=_held_out(cameras, begin.world_from_board, begin.views, board, free),
        notes=(*notes, *_apart(fit, alone)),
    )


def epipolar_errors(rig: Rig, views: Mapping[str, Views]) -> dict[tuple[str, str], Float[np.ndarray, " n"]]:
    """By pair: distances in undistorted pixels from beta's points to the lines of alpha's and the reverse, all frames."""
    found = {}
    for a, b in combinations(views, 2):
        xa, xb = _common(views[a], views[b])
        if len(xa):
            found[a, b] = _two_way_distance(rig, a, b, xa, xb)
    return found


def undistorted(camera: Camera, x: Float[np.ndarray, "n 2"]) -> tuple[torch.Tensor, torch.Tensor]:
    """The pixels of the same camera without its lens, and which are valid."""
    pixels = torch.from_numpy(x)
    if camera.distortion is None:
        return pixels, torch.ones(len(x), dtype=torch.bool)
    normalised = map_homogeneous(torch.linalg.inv(camera.K)[:2], pixels)
    straight, valid = camera.distortion.undistort(normalised)
    return map_homogeneous(camera.K[:2], straight), valid


def _two_way_distance(rig: Rig, a: str, b: str, xa: np.ndarray, xb: np.ndarray) -> np.ndarray:
    (pa, va), (pb, vb) = undistorted(*_camera_and(rig, a, xa)), undistorted(*_camera_and(rig, b, xb))
    there = epipolar_distance(rig.pair(a, b).fundamental, pa, pb).abs()
    back = epipolar_distance(rig.pair(b, a).fundamental, pb, pa).abs()
    return ((there + back) / 2)[va & vb].numpy()


def _camera_and(rig: Rig, name: str, x: np.ndarray) -> tuple[Camera, np.ndarray]:
    camera = rig[name]
    assert isinstance(camera, Camera)
    return camera, x


def _common(a: Views, b: Views) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of the points that both saw in the same frames."""
    parts: list[tuple[np.ndarray, np.ndarray]] = [(np.zeros((0, 2)), np.zeros((0, 2)))]
    for key in a.seen:
        if key in b.seen:
            _, i, j = np.intersect1d(a.seen[key].ids, b.seen[key].ids, return_indices=True)
            parts.append((a.seen[key].x[i], b.seen[key].x[j]))
    xa, xb = (np.concatenate(part) for part in zip(*parts))
    return xa, xb


def _without_outliers(views: Views, start: Start) -> Views:
    """The views whose own reprojection error is not far above the others'."""
    limit = max(2.0, 10 * float(np.median(list(start.rms.values()))))
    return Views(views.hw, {key: d for key, d in views.seen.items() if start.rms[key] < limit})


def _scene(
    cameras: Mapping[str, Camera], boards: Mapping[FrameKey, Pose], views: Mapping[str, Views], board: Board
) -> Scene:
    index = {key: i for i, key in enumerate(boards)}
    poses = Pose(torch.stack([p.R for p in boards.values()]), torch.stack([p.t for p in boards.values()]))
    seen = {name: _observations(v, index, board) for name, v in views.items()}
    return Scene(cameras, BoardPoses(poses), seen)


def _observations(views: Views, index: Mapping[FrameKey, int], board: Board) -> Observations:
    parts = [(np.full(len(d.ids), index[key]), board.points[d.ids], d.x) for key, d in views.seen.items()]
    return Observations(*(np.concatenate(part) for part in zip(*parts)))


def _fitted(scene: Scene) -> tuple[Fit, dict[str, np.ndarray], list[str]]:
    """First what every camera has, then all that the pictures tell."""
    plain = {name: _free(camera, index > 0, lens=2) for index, (name, camera) in enumerate(scene.cameras.items())}
    first = adjust(scene, plain, rounds=2)
    full = {name: _free(camera, index > 0, lens=5) for index, (name, camera) in enumerate(scene.cameras.items())}
    scene, free, notes = gate(first.scene, full, first.sigma)
    fit = adjust(scene, free)
    while True:
        scene, free, more = gate(fit.scene, free, fit.sigma)
        if not more:
            return fit, free, notes
        notes, fit = notes + more, adjust(scene, free)


def _free(camera: Camera, posed: bool, *, lens: int) -> np.ndarray:
    """A mask of the camera's numbers: its pose if it is not the reference, K, and so many terms of the lens."""
    names = parameter_names(camera)
    mask = np.ones(len(names), dtype=bool)
    mask[:6] = posed
    mask[10 + lens :] = False
    return mask


def _held_out(
    cameras: Mapping[str, Camera],
    boards: Mapping[FrameKey, Pose],
    views: Mapping[str, Views],
    board: Board,
    free: Mapping[str, np.ndarray],
) -> dict[tuple[str, str], np.ndarray]:
    """Epipolar errors on one frame in five for a rig made from the others; empty if there are too few."""
    shared = [key for key in boards if sum(key in v.seen for v in views.values()) > 1]
    if len(shared) < FEWEST_TO_HOLD_OUT:
        return {}
    out = set(shared[EVERY // 2 :: EVERY])
    used = {name: Views(v.hw, {k: d for k, d in v.seen.items() if k not in out}) for name, v in views.items()}
    kept = {name: Views(v.hw, {k: d for k, d in v.seen.items() if k in out}) for name, v in views.items()}
    if any(len(v.seen) < 3 for v in used.values()):
        return {}
    scene = _scene(cameras, {k: p for k, p in boards.items() if k not in out}, used, board)
    return epipolar_errors(Rig(adjust(scene, free).scene.cameras), kept)


def _camera_rms(start: Start) -> float:
    return float(np.sqrt(np.mean(np.square(list(start.rms.values())))))


def _pictures_left_out(
    views: Mapping[str, Views], kept: Mapping[str, Views], left_out: list[tuple[str, FrameKey]]
) -> list[str]:
    notes = []
    for name, v in views.items():
        if bent := [str(key) for key in v.seen if key not in kept[name].seen]:
            notes.append(f"{name}: left out {', '.join(bent)}: the board found there does not fit the camera")
        if astray := [str(key) for other, key in left_out if other == name]:
            notes.append(f"{name}: left out {', '.join(astray)}: they contradict the other cameras' pictures")
    return notes


def _apart(fit: Fit, alone: Mapping[str, float]) -> list[str]:
    """Cameras that fit much worse together than each alone."""
    notes = []
    for name, r in fit.scene.residuals().items():
        together = float(np.sqrt((r**2).sum(-1).mean()))
        if together > 0.5 and together > 3 * alone[name]:
            notes.append(
                f"{name}: fits to {alone[name]:.2f} px alone but {together:.2f} px with the others: were the pictures "
                "taken at the same moment, and is the board stiff?"
            )
    return notes
