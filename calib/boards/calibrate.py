"""From what cameras saw of a board to a rig, with what is known of its accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from arraygeom import Camera, Pose, Rig, epipolar_distance, stack
from arraygeom.pixels import map_homogeneous

from .bundle import BoardPoses, Expected, Fit, Observations, Scene, adjust, intrinsic_numbers, noise, parameter_names
from .intrinsics import Lens, Start, Views, calibrate_camera, check_tilts
from .observability import gate, usual
from .photos import FrameKey
from .poses import Seen, initial_rig
from .target import Board

SAME_MOMENT = "taken at the same moments, numbered alike, not mirrored, with a stiff board"
FEWEST_TO_HOLD_OUT = 8
"""With fewer frames that two cameras share none is held out."""
DOUBTFUL, HOPELESS = 3.0, 20.0
"""So many times worse together than alone, a camera is in doubt, or refused."""
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
    epipolar: Mapping[tuple[str, str], Float[np.ndarray, "_"]]
    held_out: Mapping[tuple[str, str], Float[np.ndarray, "_"]]
    notes: tuple[str, ...] = field(default=())

    @property
    def rms(self) -> float:
        """The reprojection error of all points of all images, pixels, gross errors included."""
        return self.fit.scene.rms()

    def deviations(self) -> dict[str, float]:
        """The standard deviation of each number that was free, by its name ("left.focal.0"), in its own unit."""
        assert self.fit.covariance is not None
        return dict(zip(self.fit.names, np.sqrt(self.fit.covariance.diagonal()).tolist()))


def calibrate(
    views: Mapping[str, Views], board: Board, *, lens: Lens | Mapping[str, Lens] = "brown-conrady"
) -> Calibration:
    """The rig that explains what its cameras saw of a board. Its world is the first camera.

    `lens` is the model for all cameras, or for each by name. Raises ValueError, saying what to do, if a camera has too
    few images or only parallel boards, if cameras are not connected, or if their frames contradict each other.
    """
    models = {name: lens if isinstance(lens, str) else lens[name] for name in views}
    alone = {name: fit_alone(name, v, board, lens=models[name], final=len(views) == 1) for name, v in views.items()}
    begin = initial_rig([Seen(name, a.camera, a.views, a.cam_from_board) for name, a in alone.items()], board)
    cameras = {name: a.camera.replace(cam_from_world=begin.cam_from_world[name]) for name, a in alone.items()}
    together = _together(_scene(cameras, begin.world_from_board, begin.views, board), alone)
    rig = Rig(together.fit.scene.cameras)
    return Calibration(
        rig=rig,
        board=board,
        fit=together.fit,
        frames=tuple(begin.world_from_board),
        views=begin.views,
        alone={name: a.fit.scene.rms() for name, a in alone.items()},
        epipolar=epipolar_errors(rig, begin.views),
        held_out=_held_out(cameras, begin.world_from_board, begin.views, board, together),
        notes=(*_images_left_out(views, alone, begin.left_out), *together.notes),
    )


class Alone(NamedTuple):
    """One camera calibrated by itself; its world is its own frame, `views` the images kept."""

    fit: Fit
    views: Views
    frames: tuple[FrameKey, ...]
    notes: tuple[str, ...]

    @property
    def camera(self) -> Camera:
        """The camera, at the origin."""
        return next(iter(self.fit.scene.cameras.values()))

    @property
    def cam_from_board(self) -> dict[FrameKey, Pose]:
        """The board's pose in the camera by moment."""
        structure = self.fit.scene.structure
        assert isinstance(structure, BoardPoses)
        boards = structure.world_from_board
        return {key: Pose(boards.R[i], boards.t[i]) for i, key in enumerate(self.frames)}


def fit_alone(name: str, views: Views, board: Board, *, lens: Lens = "brown-conrady", final: bool = True) -> Alone:
    """One camera's intrinsics and lens from its own images. Raises ValueError as `calibrate` does.

    Where this is not `final`, as other cameras will add what they know, a focal length that is told badly is let pass.
    """
    start = calibrate_camera(name, views, board, lens=lens)
    kept = _without_outliers(views, start)
    if len(kept.seen) < len(views.seen):
        start = calibrate_camera(name, kept, board, lens=lens)
    scene = _scene({name: start.camera}, start.cam_from_board, {name: kept}, board)
    fit, _, notes = _fitted(scene, final=final)
    found = Alone(fit, kept, tuple(start.cam_from_board), tuple(notes))
    check_tilts(name, found.cam_from_board)
    return found


class _Together(NamedTuple):
    """All cameras' fit, what was free in it, notes, and whether cameras were taken to be alike in noise."""

    fit: Fit
    free: dict[str, np.ndarray]
    notes: list[str]
    alike: bool = False

    def again(self, scene: Scene) -> Fit:
        """The same fit to other frames."""
        return adjust(replace(scene, expected=self.fit.scene.expected), self.free, alike=self.alike)


def _together(scene: Scene, alone: Mapping[str, Alone]) -> _Together:
    """All cameras at once; if they fit far worse so than alone, with what each alone tells of its intrinsics.

    Boards that move between the exposures of cameras that are not synchronised would bend the lenses otherwise.
    """
    if len(scene.cameras) == 1:
        (only,) = alone.values()
        fixed = {name: _free(c, False, lens=0) for name, c in scene.cameras.items()}
        return _Together(only.fit, fixed, list(only.notes))
    fit, free, notes = _fitted(scene)
    if not (doubts := _doubts(fit, alone)):
        return _Together(fit, free, notes)
    known = {name: _as_expected(name, a) for name, a in alone.items()}
    free = {name: known[name].information.diagonal() > 0 for name in scene.cameras}
    for index, mask in enumerate(free.values()):
        mask[:6] = index > 0
    fit = adjust(replace(scene, expected=known), free, alike=True)
    kept = "so each camera's intrinsics are held to what its own images tell"
    return _Together(fit, free, [*(note for a in alone.values() for note in a.notes), f"{doubts}; {kept}"], alike=True)


def _as_expected(name: str, alone: Alone) -> Expected:
    """What a camera's own images tell of its intrinsics; nothing of the numbers that were kept fixed."""
    fit, entries = alone.fit, parameter_names(alone.camera)
    told = [entries.index(entry.removeprefix(f"{name}.")) for entry in fit.names]
    information = np.zeros((len(entries), len(entries)))
    if fit.covariance is not None:
        information[np.ix_(told, told)] = np.linalg.inv(fit.covariance)
    return Expected(intrinsic_numbers(alone.camera), information)


def epipolar_errors(rig: Rig, views: Mapping[str, Views]) -> dict[tuple[str, str], Float[np.ndarray, "_"]]:
    """By pair: distances in undistorted pixels from beta's points to the lines of alpha's, and the reverse."""
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
    poses = stack(list(boards.values()))
    seen = {name: _observations(v, index, board) for name, v in views.items()}
    return Scene(cameras, BoardPoses(poses), seen, {name: usual(camera) for name, camera in cameras.items()})


def _observations(views: Views, index: Mapping[FrameKey, int], board: Board) -> Observations:
    parts = [(np.full(len(d.ids), index[key]), board.points[d.ids], d.x) for key, d in views.seen.items()]
    return Observations(*(np.concatenate(part) for part in zip(*parts)))


def _fitted(scene: Scene, *, final: bool = True) -> tuple[Fit, dict[str, np.ndarray], list[str]]:
    """All that the images tell: fitted, and what they turn out not to tell given up, until that is nothing."""
    sigma = noise(scene, 0)
    full = {name: _free(camera, index > 0, lens=5) for index, (name, camera) in enumerate(scene.cameras.items())}
    scene, free, notes = gate(scene, full, sigma, final=False)
    fit = adjust(scene, free)
    while True:
        scene, free, more = gate(fit.scene, free, fit.sigma, final=final)
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
    together: _Together,
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
    return epipolar_errors(Rig(together.again(scene).scene.cameras), kept)


def _images_left_out(
    views: Mapping[str, Views], alone: Mapping[str, Alone], left_out: list[tuple[str, FrameKey]]
) -> list[str]:
    notes = []
    for name, v in views.items():
        if distorted := [str(key) for key in v.seen if key not in alone[name].views.seen]:
            notes.append(f"{name}: left out {', '.join(distorted)}: the board found there does not fit the camera")
        if astray := [str(key) for other, key in left_out if other == name]:
            notes.append(f"{name}: left out {', '.join(astray)}: they contradict the other cameras' images")
    return notes


def _doubts(fit: Fit, alone: Mapping[str, Alone]) -> str:
    """Which cameras fit much worse together than alone, in words. Raises ValueError if that is hopeless."""
    doubts = []
    for name, r in fit.scene.residuals().items():
        together, by_itself = float(np.sqrt((r**2).sum(-1).mean())), alone[name].fit.scene.rms()
        fits = f"{name} fits to {by_itself:.2f} px alone but to {together:.2f} px with the others"
        if together > HOPELESS * max(by_itself, 0.3):
            raise ValueError(f"{fits}: were the images {SAME_MOMENT}?")
        if together > 0.5 and together > DOUBTFUL * by_itself:
            doubts.append(fits)
    return f"{', '.join(doubts)} (were the images {SAME_MOMENT}?)" if doubts else ""
