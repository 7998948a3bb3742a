"""Which lens model the images support: each is fitted to some frames and judged on the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from arraygeom import stack

from .board import Board
from .bundle import BoardPoses, BundleProblem, Observations, readjusted
from .camera_parameters import parameter_names
from .intrinsics import BoardViews, Lens, board_pose
from .photos import FrameKey
from .rig import SingleCalibration, calibrate_single

MODELS: tuple[Lens, ...] = ("none", "kannala-brandt", "brown-conrady", "rational", "thin-prism", "tilted")
"""By number of coefficients."""
FOLDS = 4
FEWEST_FRAMES = 8
EQUAL = 0.01
"""Errors that differ by less than this share are equal."""


@dataclass(frozen=True)
class LensComparison:
    """Mean square errors of a coordinate (pixels^2) of each frame by each model that can be fitted without it."""

    errors: Mapping[Lens, Float[np.ndarray, " f"]]

    def rms(self, lens: Lens) -> float:
        """The held-out error along x or y, pixels."""
        return float(np.sqrt(self.errors[lens].mean()))

    @property
    def advised(self) -> Lens:
        """The model with fewest coefficients that predicts as well as the best, to a standard error or one percent."""
        if not self.errors:
            return "brown-conrady"
        best = min(self.errors, key=self.rms)
        return next(lens for lens in MODELS if lens in self.errors and self._equal(lens, best))

    def _equal(self, lens: Lens, best: Lens) -> bool:
        worse = self.errors[lens] - self.errors[best]
        error = float(worse.std(ddof=1)) / len(worse) ** 0.5
        return float(worse.mean()) <= max(error, 2 * EQUAL * float(self.errors[best].mean()))

    @property
    def advice(self) -> str:
        """The advised model and all errors, in a sentence."""
        if not self.errors:
            return f"too few frames to compare lens models ({FEWEST_FRAMES} are needed): brown-conrady is used"
        listed = ", ".join(f"{lens} {self.rms(lens):.3f}" for lens in MODELS if lens in self.errors)
        return f"the images support the lens model {self.advised} (error on held-out frames, px: {listed})"


def compare_lenses(views: Mapping[str, BoardViews], board: Board) -> dict[str, LensComparison]:
    """The lens models of each camera, judged on frames that they were not fitted to."""
    return {name: _compared(name, v, board) for name, v in views.items()}


def _compared(name: str, views: BoardViews, board: Board) -> LensComparison:
    if len(views.seen) < FEWEST_FRAMES:
        return LensComparison({})
    kept = calibrate_single(name, views, board, final=False).views
    found: dict[Lens, np.ndarray] = {}
    for lens in MODELS:
        try:
            found[lens] = np.concatenate([_fold_errors(name, kept, board, lens, fold) for fold in range(FOLDS)])
        except ValueError:
            continue  # it does not fit at all, as a fisheye's model of a long lens may
    return LensComparison(found)


def _fold_errors(name: str, views: BoardViews, board: Board, lens: Lens, fold: int) -> np.ndarray:
    """Mean squares of the frames of one fold by a camera fitted to the others."""
    out = list(views.seen)[fold::FOLDS]
    used = BoardViews(views.hw, {key: d for key, d in views.seen.items() if key not in out})
    fit = calibrate_single(name, used, board, lens=lens, final=False)
    return np.array([_frame_error(fit, key, views, board) for key in out])


def _frame_error(fit: SingleCalibration, key: FrameKey, views: BoardViews, board: Board) -> float:
    """Of one frame, with the board's pose fitted to it. Raises ValueError as `board_pose`."""
    camera, found, solved = fit.camera, views.seen[key], fit.fit.problem
    pose = board_pose(camera, found, board)
    part = board.part[found.ids[:1]]
    problem = BundleProblem(
        {"": camera},
        BoardPoses(stack([pose])),
        {"": Observations(np.zeros(len(found.ids), dtype=int), board.points[found.ids], found.x)},
        shape=None if solved.shape is None else solved.shape.of_blocks(part),
    )
    fixed = {"": np.zeros(len(parameter_names(camera)), dtype=bool)}
    r = readjusted(problem, fixed, {"": fit.fit.sigma[next(iter(solved.cameras))]}).residuals()[""]
    return float((r**2).sum() / max(r.size - BoardPoses.width, 1))
