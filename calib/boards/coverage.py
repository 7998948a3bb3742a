"""Coverage of images, depths and tilts by the observed boards, and advice on what is missing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from arraygeom import Pose

from .board import Board
from .intrinsics import BoardViews
from .photos import FrameKey

CELLS = 6, 8
"""Rows and columns of the coverage grid."""
WIDE_ENOUGH = 0.6
DEEP_ENOUGH = 1.5
TILTED_ENOUGH = 20.0
POSITIONS = ("top left", "top", "top right"), ("left", "middle", "right"), ("bottom left", "bottom", "bottom right")


class Coverage(NamedTuple):
    """Coverage of one camera by its boards.

    cells: points in each cell of the image. depths: (nearest, furthest) point, metres. tilts: (least, most)
    angle between the board's normal and the optical axis, degrees. missing: advice, one sentence each.
    """

    cells: Int[np.ndarray, "r c"]
    depths: tuple[float, float]
    tilts: tuple[float, float]
    missing: tuple[str, ...]

    @property
    def share(self) -> float:
        """The share of cells with a point."""
        return float((self.cells > 0).mean())


def coverage(views: BoardViews, cam_from_board: Mapping[FrameKey, Pose], board: Board) -> Coverage:
    """Coverage of a camera by its boards, from their poses in it."""
    h, w = views.hw
    x = np.concatenate([d.x for d in views.seen.values()])
    rows, columns = CELLS
    cells, _, _ = np.histogram2d(x[:, 1], x[:, 0], bins=(rows, columns), range=((-0.5, h - 0.5), (-0.5, w - 0.5)))
    poses = {key: cam_from_board[key] for key in views.seen}
    depths = [board.points[d.ids] @ poses[k].R[2].numpy() + float(poses[k].t[2]) for k, d in views.seen.items()]
    tilts = np.degrees([np.arccos(min(1.0, abs(float(pose.R[2, 2])))) for pose in poses.values()])
    found = Coverage(cells.astype(np.int64), _range(np.concatenate(depths)), _range(tilts), ())
    return found._replace(missing=tuple(_missing(found)))


def _range(values: np.ndarray) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def _missing(found: Coverage) -> list[str]:
    missing = []
    thirds = found.cells.reshape(3, CELLS[0] // 3, CELLS[1])
    empty = [
        POSITIONS[i][j]
        for i, band in enumerate(thirds)
        for j, part in enumerate(np.array_split(band, 3, axis=1))
        if not part.any()
    ]
    if empty:
        missing.append(f"no points at the {', '.join(empty)} of the image: the lens model is extrapolated there")
    elif found.share < WIDE_ENOUGH:
        missing.append(f"points in only {found.share:.0%} of the image: fill it, corners too")
    if found.depths[1] < DEEP_ENOUGH * found.depths[0]:
        near, far = found.depths
        missing.append(
            f"boards at one depth only ({near:.3g} to {far:.3g} m): bring it closer in some, further in others"
        )
    if found.tilts[1] < TILTED_ENOUGH:
        missing.append(f"boards tilted by {found.tilts[1]:.0f} degrees at most: tilt it by 20 to 40")
    return missing
