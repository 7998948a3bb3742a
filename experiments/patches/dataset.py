"""Patches of rendered scenes, recorded by simulated cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from arraygeom.rig import Rig
from arraygeom.sensor import Band, Curve, Sensor
from experiments.sensors import EncodeSRGB, Spectral, record_array
from pat.data.windows import scene_folders, scene_rig
from pat.media.colour import srgb_image
from pat.sensors import Clip, Noise, Quantise, Step, seed_for

from .grid import PatchGrid, PatchStack, cut, same_cameras

LOADED = 64
"""Scenes whose patches are cached in memory."""


@dataclass(frozen=True)
class Patch:
    """The recorded images of a patch and their ground truth.

    `images` are encoded as the chains leave them (sRGB by default), by camera, alpha first; `rig` is that of
    those images. `ground_truth` is alpha's ideal view in colour (sRGB, 0..1), and `depth` its depth in
    metres, both on the grid that alpha had before its chain.
    """

    images: dict[str, Float[Tensor, "_ _ _"]]
    ground_truth: Float[Tensor, "3 h w"]
    depth: Float[Tensor, "h w"]
    rig: Rig
    alpha: str


class ScenePatches:
    """All patches of all scenes of a folder, degraded on the fly.

    `chains` simulate each camera (see `default_chains`). Random numbers depend on `seed` and the patch alone.
    Scenes are cut on first use and the latest are cached. Raises ValueError for a folder without scenes; for
    a scene that is incomplete, or of other sizes than the first, when it is read.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        alpha: str | None = None,
        patches: PatchGrid | None = None,
        chains: Mapping[str, Sequence[Step]] | None = None,
        seed: int = 0,
    ):
        self.folders = scene_folders(root)
        self.rig = scene_rig(self.folders[0])
        self.alpha = self.rig.require(alpha or self.rig.names[0])
        self.patches = patches or PatchGrid.like_the_papers(self.rig[self.alpha].hw)
        self.chains = default_chains(self.rig) if chains is None else chains
        for name in self.chains:
            self.rig.require(name)
        self.seed = seed
        self._stack = lru_cache(LOADED)(self._cut)

    def __len__(self) -> int:
        return len(self.folders) * self.patches.count

    def __getitem__(self, index: int) -> Patch:
        if not 0 <= index < len(self):
            raise IndexError(f"patch {index} of {len(self)}")
        scene, number = divmod(index, self.patches.count)
        return self._recorded(self._stack(scene), number, seed_for(self.seed, 0, index))

    def _cut(self, scene: int) -> PatchStack:
        folder = self.folders[scene]
        try:
            same_cameras(self.rig, scene_rig(folder))
        except ValueError as error:
            raise ValueError(f"{folder}: {error}") from None
        return cut(folder, self.patches, alpha=self.alpha)

    def _recorded(self, stack: PatchStack, number: int, seed: int) -> Patch:
        alpha = self.alpha
        one = slice(number, number + 1)
        rig, rgb = stack.rig[number], {name: views[one] for name, views in stack.rgb.items()}
        depth = {name: views[one] for name, views in stack.depth.items()}
        recorded = record_array(rgb, rig, self.chains, seed=seed, depth=depth)
        return Patch(
            images={name: recorded.images[name][0] for name in (alpha, *rig.betas(alpha))},
            ground_truth=srgb_image(rgb[alpha])[0],
            depth=depth[alpha][0],
            rig=recorded.rig,
            alpha=alpha,
        )


def default_chains(rig: Rig) -> dict[str, tuple[Step, ...]]:
    """Each camera's spectral response, a little noise, sRGB encoding, 8 bits."""
    return {
        name: (_spectral(c.sensor), Noise(8000, 3), Clip(), EncodeSRGB(), Quantise(8))
        for name, c in rig.cameras.items()
    }


def _spectral(sensor: Sensor) -> Spectral:
    if isinstance(sensor.response, Band | Curve):
        return Spectral(sensor.response)
    return Spectral("luminance" if sensor.response in ("mono", "luminance") else "rgb")
