"""A believable scene of a system, rendered with Blender for its cameras: a still life, or a landscape."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, Rig
from experiments.scenes import SCENES
from experiments.stage import RenderedView
from pat.media.colour import srgb_from_linear
from pat.synthesis.blender import RenderSettings, render

FARTHEST = 300.0
"""Metres that the sky is given: haze leaves some of its colour."""
SETTINGS = RenderSettings(samples=40, denoise="accurate", fast_light=False, bounces=3)


class RenderedScene:
    """One of `experiments.scenes` seen by a rig's cameras, each at its own frame rate and time offset.

    `moving` seconds are what its moving object takes, `duration` seconds are rendered, `seed` determines all.
    """

    def __init__(
        self, rig: Rig, generator: str, seed: int, *, infrared: bool, moving: float, duration: float
    ) -> None:
        self.rig, self.alpha, self.seed = rig, rig.names[0], seed
        scene = SCENES[generator](seed, rig, moving=moving)
        pinholes = {n: c.replace(distortion=None) for n, c in rig.cameras.items() if isinstance(c, Camera)}
        settings = replace(SETTINGS, infrared=infrared, duration=duration)
        with TemporaryDirectory() as folder:
            rendered = render(scene, rig.replace(cameras=pinholes), Path(folder) / "scene", settings=settings)
            self.frames = {n: [rendered.frame(n, i) for i in range(rendered.frames(n))] for n in rig.names}

    def light(self, name: str, frame: int = 0) -> Float[Tensor, "1 3 h w"]:
        """The linear light a camera receives in a frame; over 1 is brighter than paper in the window."""
        return self.frames[name][frame].rgb[None]

    def infrared(self, name: str) -> Float[Tensor, "1 1 h w"]:
        """The near infrared that a camera receives, at most 1."""
        nir = self.frames[name][0].nir
        assert nir is not None
        return nir[None].clamp(0, 1)

    def seen(self, name: str) -> RenderedView:
        """The image (sRGB, clipped at white) and the depth that a camera sees."""
        depth = self.frames[name][0].depth.clamp(max=FARTHEST)
        return srgb_from_linear(self.light(name).clamp(0, 1)), depth
