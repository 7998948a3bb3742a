"""One scene, rendered in this process."""

from __future__ import annotations

from pathlib import Path

from arraygeom.rig import Rig

from ..rendered import Rendered
from ..scene import Scene
from .settings import RenderSettings


def render_here(scene: Scene, rig: Rig, out: Path, *, settings: RenderSettings) -> Rendered:
    """As `pat.synthesis.blender.render`, in this process: it imports bpy. Raises ValueError."""
    raise NotImplementedError
