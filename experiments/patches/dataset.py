"""Patches of rendered scenes as a torch dataset."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from arraygeom.fields import ReceptiveField
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.rig import Rig
from arraygeom.sensor import Band, Curve, Sensor
from experiments.sensors import EncodeSRGB, Spectral, record_array
from pat.data.windows import scene_folders, scene_rig
from pat.media.colour import srgb_image
from pat.sensors import Clip, DegradationCase, Noise, Quantise, Step, generator_for, seed_for

from .grid import PatchGrid, PatchStack, cut, same_cameras, stacked

LOADED = 64
"""Scenes whose patches each process caches in memory."""


@dataclass(frozen=True)
class Patch:
    """The recorded images of a patch and their ground truth; one, or a batch of them.

    `images` are encoded as the chains leave them (sRGB by default), by camera, alpha first; `rig` is that of
    those images. `ground_truth` is alpha's ideal view in colour (sRGB, 0..1), and `depth` its depth in
    metres, both on the grid that alpha had before its chain.
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

    `chains` simulate each camera (see `default_chains`), `cases` are further degradations of alpha and of all
    betas, all equally likely. Random numbers depend on `seed`, `epoch` and the patch alone. Scenes are cut on
    first use and the latest are cached: shuffle with `SceneShuffle`. Raises ValueError for a folder without
    scenes; for a scene that is incomplete, or of other sizes than the first, when it is read.
    """

    def __init__(
        self,
        root: str | Path,
        *,
        alpha: str | None = None,
        patches: PatchGrid | None = None,
        chains: Mapping[str, Sequence[Step]] | None = None,
        cases: Sequence[DegradationCase] = (),
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
        """Draw other noise and cases."""
        self.epoch = epoch

    def _recorded(self, stack: PatchStack, number: int, seed: int) -> Patch:
        alpha = self.scenes.alpha
        one = slice(number, number + 1)
        rig, rgb = stack.rig[number], {name: views[one] for name, views in stack.rgb.items()}
        depth = {name: views[one] for name, views in stack.depth.items()}
        recorded = record_array(rgb, rig, self._chains(alpha, seed), seed=seed, depth=depth)
        return Patch(
            images={name: recorded.images[name][0] for name in (alpha, *rig.betas(alpha))},
            ground_truth=srgb_image(rgb[alpha])[0],
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
    """The scenes of a folder, cut into patches on first use; the latest `LOADED` are cached."""

    def __init__(self, root: str | Path, *, alpha: str | None = None, patches: PatchGrid | None = None):
        self.folders = scene_folders(root)
        self._cache: OrderedDict[int, PatchStack] = OrderedDict()
        self.rig = scene_rig(self.folders[0])
        self.alpha = self.rig.require(alpha or self.rig.names[0])
        self.patches = patches or PatchGrid.like_the_papers(self.rig[self.alpha].hw)

    def __len__(self) -> int:
        return len(self.folders)

    def __getitem__(self, index: int) -> PatchStack:
        if index in self._cache:
            self._cache.move_to_end(index)
            return self._cache[index]
        folder = self.folders[index]
        try:
            same_cameras(self.rig, scene_rig(folder))
        except ValueError as error:
            raise ValueError(f"{folder}: {error}") from None
        stack = cut(folder, self.patches, alpha=self.alpha)
        self._cache[index] = stack
        if len(self._cache) > LOADED:
            self._cache.popitem(last=False)
        return stack


class SceneShuffle(Sampler[int]):
    """A random order that reads each scene once: `mixed` scenes at a time, patches shuffled together."""

    def __init__(self, data: ScenePatches, *, mixed: int = 16):
        self.data, self.mixed = data, mixed

    def __len__(self) -> int:
        return len(self.data)

    def __iter__(self) -> Iterator[int]:
        g = generator_for(self.data.seed, "order", self.data.epoch)
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
