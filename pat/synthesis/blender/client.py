"""Rendering from a process that never imports bpy: worker processes, asked over pipes."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from arraygeom.rig import Rig

from ..rendered import Rendered
from ..scene import Scene
from .settings import RenderSettings


class RenderError(RuntimeError):
    """A scene that could not be rendered: one line says why. `crashed` if the process died or hung."""

    def __init__(self, message: str, *, crashed: bool = False):
        super().__init__(message)
        self.crashed = crashed


class Worker:
    """A process that renders one scene after another (`python -m pat.synthesis.blender.worker`)."""

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process."""
        raise NotImplementedError

    def render(
        self, scene: Scene, rig: Rig, out: Path, *, settings: RenderSettings, timeout: float | None = None
    ) -> Rendered:
        """As `render`; the process is started anew after a crash."""
        raise NotImplementedError


def render(scene: Scene, rig: Rig, out: Path, *, settings: RenderSettings, timeout: float | None = None) -> Rendered:
    """Render a scene into the folder `out`, which appears whole, in a process of its own.

    Raises ValueError for what cannot be rendered (one line: skew, a camera inside an object, a missing library),
    RenderError if the process dies or takes longer than `timeout` seconds.
    """
    with Worker() as worker:
        return worker.render(scene, rig, out, settings=settings, timeout=timeout)
