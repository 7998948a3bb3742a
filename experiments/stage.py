"""The scenes of a system, for any of its cameras: layered ones, in any light, at any time; or Blender's."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom import Camera, Pose, Rig, stack
from arraygeom.pose import matvec
from arraygeom.runtime.chunks import Box, assembled, tiles_of
from experiments.scenes import SCENES
from pat.lab.evaluation.ablation import sample_photographs
from pat.lab.synthesis.blender import RenderSettings, render
from pat.lab.synthesis.layered import LayeredScenes
from pat.lab.synthesis.layers import Layers, draw_layers
from pat.lab.synthesis.rig_distribution import RigDistribution
from pat.lab.synthesis.rigs import RigBatch, in_frame_of
from pat.media.colour import srgb_from_linear

RenderedView = tuple[Float[Tensor, "1 3 h w"], Float[Tensor, "h w"]]


BAND = 4_000_000
"""Samples (pixels times oversampling) rendered at once: about 1.5 GiB with ten layers."""


def purpose_generator(seed: int, purpose: str) -> Generator:
    """Randomness for one purpose in a scene of a seed, the same each time."""
    return Generator().manual_seed(seed * 1_000_003 + sum(ord(c) * 31**i for i, c in enumerate(purpose)))


class SystemScene(LayeredScenes):
    """A scene in front of a rig's alpha, between two depths in metres.

    Textures are patterns and the images that scikit-image ships; `seed` determines all.
    """

    def __init__(self, rig: Rig, alpha: str, *, depths: tuple[float, float], layers: int, seed: int) -> None:
        self.rig, self.alpha, self.seed = rig, alpha, seed
        bank = sample_photographs(count=10, seed=seed)
        super().__init__(bank, RigDistribution(), hw=rig[alpha].hw, layers=(layers, layers), seed=seed)
        near, far = (torch.tensor([d], dtype=torch.float64) for d in depths)
        rigs = RigBatch([self.camera(name) for name in (alpha, *rig.betas(alpha))], near, far)
        self.scene = draw_layers(
            rigs, self.layers, self.photos, len(self.outlines), purpose_generator(seed, "scene")
        )

    def camera(self, name: str) -> Camera:
        """A camera of the rig as a batch of one, in alpha's frame."""
        alpha, camera = self.rig[self.alpha], self.rig[name]
        return stack([in_frame_of(alpha, camera).replace(distortion=None)])

    @torch.no_grad()
    def seen(self, name: str, layers: Layers | None = None) -> RenderedView:
        """The image (sRGB) and the depth that a camera sees, of the scene itself or of changed layers.

        Large images are rendered in bands of rows, with a row around for the width of outlines.
        """
        camera = self.camera(name)
        finest = max(float(self.camera(n).K[0, 0, 0]) for n in self.rig.names)
        factor = min(max(round(finest / float(camera.K[0, 0, 0])), 2), 4)
        h, w = camera.hw
        rows = max(BAND // (w * factor**2), 1)

        def rendered(band: Box) -> RenderedView:
            top, bottom, left, right = band
            cropped = camera.crop(top, left, (bottom - top, right - left))
            image, depth = self._seen(layers or self.scene, cropped, factor)[:2]
            return image, depth[0]

        return assembled((h, w), ((tile, rendered(tile.outer)) for tile in tiles_of((h, w), (rows, w), 1)))

    def painted(self, values: Sequence[float]) -> Layers:
        """The scene with a grey value, 0..1, for each layer instead of its texture."""
        paint = torch.zeros_like(self.scene.colour)
        paint[..., 3] = torch.tensor(values, dtype=paint.dtype)[None, :, None]
        return dataclasses.replace(self.scene, colour=paint)

    def mixed(self, weights: Float[Tensor, "l 4"]) -> Layers:
        """The scene in grey: for each layer weights of its texture's red, green and blue, and a constant."""
        weights = weights[None, :, None].to(self.scene.colour)
        grey = (weights[..., :3] @ self.scene.colour).expand(-1, -1, 3, -1).clone()
        grey[..., 3] += weights[..., 3]
        return dataclasses.replace(self.scene, colour=grey)

    def moved(self, layer: int, step: Float[Tensor, "3"]) -> Layers:
        """The scene with one layer moved, metres in alpha's frame."""
        planes, moving = self.scene.plane_from_world, torch.zeros_like(self.scene.plane_from_world.t)
        moving[:, layer] = step.to(moving)
        moved = Pose(planes.R, planes.t - matvec(planes.R, moving))
        return dataclasses.replace(self.scene, plane_from_world=moved)

    def shares(self) -> Float[Tensor, " l"]:
        """The part of alpha's image that each layer covers."""
        count = self.scene.present.shape[1]
        image, _ = self.seen(self.alpha, self.painted([(i + 1) / 32 for i in range(count)]))
        index = (image[0, 0] * 32).round().long().clamp(1, count) - 1
        return torch.bincount(index.flatten(), minlength=count) / index.numel()


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
        settings = dataclasses.replace(SETTINGS, infrared=infrared, duration=duration)
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
