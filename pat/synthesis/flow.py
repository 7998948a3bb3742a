"""Optical flow from depth, index and the objects' motions."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.camera import Camera
from arraygeom.pixels import pixel_grid

from .rendered import RenderedFrame
from .scene import Motion, Scene


def flow(scene: Scene, camera: Camera, frame: RenderedFrame, step: float) -> Float[Tensor, "2 h w"]:
    """Displacement (x, y) in pixels over `step` seconds of every pixel's point; 0 where nothing is.

    Exact for any lens: points move with their object and are projected again.
    """
    camera = camera.to(dtype=torch.float64)
    x = pixel_grid(camera.hw, dtype=torch.float64)
    moved = torch.zeros_like(x)
    for i, thing in enumerate(scene.objects):
        here = (frame.index == i + 1) & frame.depth.isfinite()
        if not thing.motion.still and here.any():
            X = camera.unproject(x[here], frame.depth[here].double())
            later = camera.project(_moved(thing.motion, X, frame.time, step))
            moved[here] = torch.where(later.valid[:, None], later.x - x[here], torch.nan)
    return moved.movedim(-1, 0).float()


def _moved(motion: Motion, X: Float[Tensor, "n 3"], time: float, step: float) -> Float[Tensor, "n 3"]:
    now, later = (torch.from_numpy(motion.at(t).matrix) for t in (time, time + step))
    A = later @ torch.linalg.inv(now)
    return X @ A[:3, :3].T + A[:3, 3]
