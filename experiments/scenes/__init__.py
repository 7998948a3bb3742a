"""Scenes as one would photograph them, for Blender: a still life in a room, and a landscape."""

from collections.abc import Callable

from pat.lab.synthesis.scene import Scene

from .landscape import landscape
from .still_life import still_life

SCENES: dict[str, Callable[..., Scene]] = {"still-life": still_life, "landscape": landscape}
"""Scenes by name; each takes a seed and a rig."""

__all__ = ["SCENES", "landscape", "still_life"]
