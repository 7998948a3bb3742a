"""Calibration of a rig from detected board points, with its accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float

from arraygeom import Rig
from arraygeom.runtime.threads import torch_in_one_thread

from .board import Board
from .bundle import Solved
from .detect import BoardViews
from .intrinsics import LENSES, Lens
from .photos import FrameKey
from .poses import StartDeviations, initial_rig, rig_near_start
from .solve import calibrate_single, misfit_notes, solve_inliers, solve_together
from .uncertainty import with_disagreement
from .validation import epipolar_errors, held_out_errors, left_out_notes, start_notes


@dataclass(frozen=True)
class Calibration:
    """Calibrated rig with its accuracy.

    Attributes:
        rig: the rig; its world is the first camera's frame, or the start's.
        board: the board.
        fit: result of the bundle adjustment.
        single: reprojection error (RMS, pixels) of each camera calibrated alone; empty with a start.
        epipolar: distances of common points from their epipolar lines by pair, undistorted pixels; pairs
            without common points are missing.
        notes: sentences on the calibration.
    """

    rig: Rig
    board: Board
    fit: Solved = field(repr=False)
    single: Mapping[str, float]
    epipolar: Mapping[tuple[str, str], Float[np.ndarray, " _"]] = field(repr=False)
    notes: tuple[str, ...] = field(default=())

    @property
    def views(self) -> Mapping[str, BoardViews]:
        """Detections used, numbered consistently in all cameras."""
        return self.fit.views

    @property
    def frames(self) -> tuple[FrameKey, ...]:
        """Moments of the boards' poses."""
        return self.fit.problem.frames

    @property
    def rms(self) -> float:
        """Reprojection error of all points used, pixels."""
        return self.fit.problem.rms()

    @cached_property
    def held_out(self) -> dict[tuple[str, str], Float[np.ndarray, " _"]]:
        """Epipolar errors (pixels) by pair on held-out frames; empty for too few (see `held_out_errors`)."""
        return held_out_errors(self.fit, self.views)

    def deviations(self) -> dict[str, float]:
        """Return the standard deviation of each free parameter by name, in its unit; empty if unknown."""
        return self.fit.deviations


@torch_in_one_thread()
def calibrate(
    views: Mapping[str, BoardViews],
    board: Board,
    *,
    lens: Lens | Mapping[str, Lens] = "brown-conrady",
    start: Rig | None = None,
    deviations: StartDeviations | None = None,
) -> Calibration:
    """Calibrate a rig from detected board points.

    Args:
        views: detections by camera.
        board: the board.
        lens: lens model of all cameras, or of each by name.
        start: rig known to within `deviations`; one image of each camera, of a common moment, is then enough,
            and the start's world and kinds of lenses are kept, their coefficients fitted; a pinhole gets the
            model `lens`. None for cameras of which nothing is known.
        deviations: standard deviations about the start; None for the defaults. Unused without a start.

    Returns:
        The calibration of the cameras in `views`, in the first one's frame or the start's world; the rig has
        no depth range.

    Raises:
        ValueError: with advice, for no views, an unknown lens model, too few images, parallel boards, cameras
            without common frames, frames that contradict each other or determine too little
            (numpy.linalg.LinAlgError), or a start that does not fit.
        IndexError: for points that the board has not; cv2.error: if OpenCV fails on a board's pose.
    """
    if not views:
        raise ValueError("there are no views: give those of one camera or more, by name")
    models = dict.fromkeys(views, lens) if isinstance(lens, str) else lens
    for name in views:
        if models.get(name) not in LENSES:
            raise ValueError(f"lens of '{name}': {models.get(name)!r} is none of {', '.join(LENSES)}")
    if start is None:
        singles = {
            name: calibrate_single(name, v, board, lens=models[name], final=len(views) == 1)
            for name, v in views.items()
        }
        fitted = solve_together(initial_rig(singles, board), board, singles)
    else:
        singles, stated = {}, deviations or StartDeviations()
        initial = rig_near_start(start, views, board, models, stated)
        fitted = solve_inliers(initial, initial.views, board)
    solved = with_disagreement(fitted, board, unchecked=bool(singles) and board.flat)
    notes = [*solved.notes, *misfit_notes(solved)]
    if start is None:
        notes[:0] = left_out_notes(views, singles, fitted)
    else:
        notes[:0] = start_notes(initial.views, fitted, stated, models)
        notes += [
            f"{n}: of the start, is not in the rig: it has no images" for n in start.names if n not in views
        ]
    rig = Rig(solved.problem.cameras)
    single = {name: camera.problem.rms() for name, camera in singles.items()}
    return Calibration(rig, board, solved, single, epipolar_errors(rig, solved.views), tuple(notes))
