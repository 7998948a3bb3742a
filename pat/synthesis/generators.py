"""Scenes from seeds: the paper's abstract ones, photograph-textured ones, calibration boards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from arraygeom.pose import Pose
from arraygeom.rig import Rig

from .scene import Board, Scene


def abstract(seed: int, rig: Rig) -> Scene:
    """The paper's scenes: 10 to 20 textured shapes in a room, at the depths of the rig."""
    raise NotImplementedError


def photographs(seed: int, rig: Rig, folder: str | Path) -> Scene:
    """Shapes like those of `abstract`, textured with the pictures under a folder."""
    raise NotImplementedError


def board(poses: Sequence[Pose], spec: Board, *, seed: int = 0) -> Scene:
    """A calibration board that is at the k-th pose (world_from_board) at the time of k seconds."""
    raise NotImplementedError


GENERATORS: dict[str, Callable[..., Scene]] = {"abstract": abstract, "photographs": photographs, "board": board}
"""By name. All take a seed; "abstract" and "photographs" a rig."""
