"""Rendered scenes as a data set of torch, and as a source of training scenes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.utils.data import Dataset, Sampler

from arraygeom.camera import Camera
from arraygeom.fields import ReceptiveField
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.rig import Rig
from arraygeom.sensor import Band, Curve, Sensor
from pat.sensors import (
    Case,
    Clip,
    Coded,
    Noise,
    Quantise,
    Spectral,
    Step,
    generator_for,
    record,
    record_array,
    seed_for,
)
from pat.synthesis.layered import ArrayBatch

from .patches import Patches, Stack, cut, same_cameras, scene_folders, scene_rig, stacked

LOADED = 64
"""Scenes whose patches are kept in memory by each process."""


@dataclass(frozen=True)
class Patch:
    """What the cameras record of a patch, and the truth; one, or a batch of them.

    `images` are coded as the chains leave them (sRGB by default), by camera, alpha first; `rig` is that of those
    images. `truth` is alpha's ideal view in colour (sRGB, 0..1), and `depth` its depth in metres, both on the
    grid that alpha had before its chain.
    """

    images: dict[str, Float[Tensor, "*b _ _ _"]]
    ground_truth: Float[Tensor, "*b 3 h w"]
    depth: Float[Tensor, "*b h w"]
    rig: Rig
    alpha: str

    def on_grid(self, field: ReceptiveField) -> list[FieldOnGrid]:
        """The field of every beta, on alpha's pixels."""
        return [FieldOnGrid.of(field, self.rig.pair(self.alpha, beta)) for beta in self.rig.betas(self.alpha)]


class ScenePatches(Dataset[Patch]):
    """All patches of all scenes of a folder, degraded on the fly.

    `chains` say how each camera records (see `default_chains`), `cases` are degradations of alpha and of all betas
    on top, all equally likely. What is drawn depends on `seed`, `epoch` and the patch alone. Scenes are cut when
    they are first asked for and some stay in memory: shuffle with `SceneShuffle`. Raises ValueError for a folder
    without scenes; for a scene that is not whole, or of other sizes than the first, when it comes up.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        alpha: str | None = None,
        patches: Patches | None = None,
        chains: Mapping[str, Sequence[Step]] | None = None,
        cases: Sequence[Case] = (),
        seed: int = 0,
    ):
        self.scenes = SceneStacks(root, alpha=alpha, patches=patches)
        self.chains = default_chains(self.scenes.rig) if chains is None else chains
        for name in self.chains:
            self.scenes.rig.require(name)
        self.cases, self.seed, self.epoch = cases, seed, 0

    def __len__(self) -> int:
        return len(self.scenes) * self.scenes.patches.count

    def __getitem__(self, index: int) -> Patch:
        if not 0 <= index < len(self):
            raise IndexError(f"patch {index} of {len(self)}")
        scene, number = divmod(index, self.scenes.patches.count)
        return self._recorded(self.scenes[scene], number, seed_for(self.seed, self.epoch, index))

    def set_epoch(self, epoch: int) -> None:
        """Draw anew: noise and cases of every epoch differ."""
        self.epoch = epoch

    def _recorded(self, stack: Stack, number: int, seed: int) -> Patch:
        alpha = self.scenes.alpha
        one = slice(number, number + 1)
        rig, rgb = stack.rig[number], {name: views[one] for name, views in stack.rgb.items()}
        depth = {name: views[one] for name, views in stack.depth.items()}
        recorded = record_array(rgb, rig, self._chains(alpha, seed), seed=seed, depth=depth)
        return Patch(
            images={name: recorded.images[name][0] for name in (alpha, *rig.betas(alpha))},
            ground_truth=coded(rgb[alpha])[0],
            depth=depth[alpha][0],
            rig=recorded.rig,
            alpha=alpha,
        )

    def _chains(self, alpha: str, seed: int) -> dict[str, Sequence[Step]]:
        chains = {name: tuple(self.chains.get(name, ())) for name in self.scenes.rig.names}
        if not self.cases:
            return dict(chains)
        drawn = torch.randint(len(self.cases), (), generator=generator_for(seed, "case"))
        case = self.cases[int(drawn)]
        return {name: chain + (case.alpha if name == alpha else case.beta) for name, chain in chains.items()}


class SceneStacks:
    """The scenes of a folder, cut into patches when asked for; the latest `LOADED` stay in memory."""

    def __init__(self, root: str | Path, *, alpha: str | None = None, patches: Patches | None = None):
        self.folders = scene_folders(root)
        self._kept: OrderedDict[int, Stack] = OrderedDict()
        self.rig = scene_rig(self.folders[0])
        self.alpha = self.rig.require(alpha or self.rig.names[0])
        self.patches = patches or Patches.like_the_papers(self.rig[self.alpha].hw)

    def __len__(self) -> int:
        return len(self.folders)

    def __getitem__(self, index: int) -> Stack:
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        folder = self.folders[index]
        try:
            same_cameras(self.rig, scene_rig(folder))
        except ValueError as error:
            raise ValueError(f"{folder}: {error}") from None
        stack = cut(folder, self.patches, alpha=self.alpha)
        self._kept[index] = stack
        if len(self._kept) > LOADED:
            self._kept.popitem(last=False)
        return stack


class SceneShuffle(Sampler[int]):
    """A random order that reads each scene once: `mixed` scenes at a time, their patches shuffled together."""

    def __init__(self, data: ScenePatches, *, mixed: int = 16, seed: int = 0):
        self.data, self.mixed, self.seed = data, mixed, seed

    def __len__(self) -> int:
        return len(self.data)

    def __iter__(self) -> Iterator[int]:
        g = generator_for(self.seed, "order", self.data.epoch)
        count = self.data.scenes.patches.count
        for scenes in torch.randperm(len(self.data.scenes), generator=g).split(self.mixed):
            patches = (scenes[:, None] * count + torch.arange(count)).flatten()
            yield from patches[torch.randperm(len(patches), generator=g)].tolist()


def collate(patches: Sequence[Patch]) -> Patch:
    """A batch; its rig is a batch of rigs. For `torch.utils.data.DataLoader(collate_fn=collate)`."""
    first = patches[0]
    return Patch(
        images={name: torch.stack([p.images[name] for p in patches]) for name in first.images},
        ground_truth=torch.stack([p.ground_truth for p in patches]),
        depth=torch.stack([p.depth for p in patches]),
        rig=stacked([p.rig for p in patches]),
        alpha=first.alpha,
    )


class RenderedScenes:
    """Patches of rendered scenes where layered ones are expected: `sample` is that of `LayeredScenes`.

    A batch mixes patches of several scenes that are in memory; `mixed` of them are, and one is exchanged about
    every time that as many patches as it has were given. Raises ValueError for cameras with a lens model.
    """

    def __init__(self, root: str | Path, *, alpha: str | None = None, patches: Patches | None = None, mixed: int = 16):
        self.scenes = SceneStacks(root, alpha=alpha, patches=patches)
        for name, camera in self.scenes.rig.cameras.items():
            if isinstance(camera, Camera) and camera.distortion is not None:
                raise ValueError(f"camera '{name}' has a lens model, training scenes are of pinholes: use ScenePatches")
        self.mixed = min(mixed, len(self.scenes))
        self._pool: list[int] = []

    def sample(self, batch: int, generator: Generator) -> ArrayBatch:
        """Ideal images (sRGB) of alpha and betas with their truth; all cameras are pinholes."""
        self._exchange(batch, generator)
        count = self.scenes.patches.count
        drawn = [(self._pool[_draw(len(self._pool), generator)], _draw(count, generator)) for _ in range(batch)]
        stacks = [(self.scenes[scene], number) for scene, number in drawn]
        rig = stacked([stack.rig[number] for stack, number in stacks])
        names = (self.scenes.alpha, *rig.betas(self.scenes.alpha))
        images = [coded(torch.stack([stack.rgb[n][i] for stack, i in stacks])) for n in names]
        depth = [torch.stack([stack.depth[n][i] for stack, i in stacks]) for n in names]
        cameras = [rig[n].to(torch.float32) for n in names]
        K, R, t, hw = ([getattr(c, key) for c in cameras] for key in ("K", "R", "t", "hw"))
        return ArrayBatch(images, depth, K, R, t, hw, _bounds(depth[0]))

    def _exchange(self, batch: int, generator: Generator) -> None:
        while len(self._pool) < self.mixed:
            self._pool.append(_draw(len(self.scenes), generator))
        chance = batch / self.scenes.patches.count
        if float(torch.rand((), generator=generator)) < chance:
            self._pool[_draw(self.mixed, generator)] = _draw(len(self.scenes), generator)


def _bounds(depth: Float[Tensor, "b h w"]) -> Float[Tensor, "b 2"]:
    """The nearest and the farthest of what is there; what is infinitely far, or not seen by a lens, does not count."""
    there = depth.isfinite()
    near = torch.where(there, depth, torch.inf).flatten(1).amin(1)
    far = torch.where(there, depth, 0.0).flatten(1).amax(1)
    return torch.stack([near, torch.maximum(near, far)], -1)


def _draw(below: int, generator: Generator) -> int:
    return int(torch.randint(below, (), generator=generator))


def coded(rgb: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Linear light as an sRGB image."""
    return record(rgb, [Clip(), Coded()], Generator()).image


def default_chains(rig: Rig) -> dict[str, tuple[Step, ...]]:
    """What each camera's response says, a little noise, 8 bits, sRGB coding."""
    return {
        name: (_spectral(c.sensor), Noise(8000, 3), Clip(), Coded(), Quantise(8)) for name, c in rig.cameras.items()
    }


def _spectral(sensor: Sensor) -> Spectral:
    if isinstance(sensor.response, Band | Curve):
        return Spectral(sensor.response)
    return Spectral("luminance" if sensor.response in ("mono", "luminance") else "rgb")
