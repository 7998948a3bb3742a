"""The paper's patches of rendered scenes, recorded by simulated cameras, and figures of them.

The paper's are 49 windows of 384x128 of every 2048x1536 view, reduced cubically to 96x32. Each camera's
window has about alpha's angle of view, centred where the middle of alpha's window projects at the middle
inverse depth of the rig's range (not at its true depth, which a network could exploit).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from arraygeom.camera import Camera
from arraygeom.fields import recorded_field
from arraygeom.pixels import HW
from arraygeom.rig import Rig, middle_depth
from arraygeom.sensor import Band, Curve, Sensor
from arraygeom.viz import COLOURS, draw_sampling_locations, numpy, show_image
from experiments.sensors import EncodeSRGB, Spectral, record_array
from pat.data.windows import RenderedView, read_view, scene_folders, scene_rig, window
from pat.media.colour import srgb_image
from pat.media.figures import colour_depth
from pat.sensors import Clip, Noise, Quantise, Step, seed_for

PAPER_WIDTH = 2048
SHOWN = 6
"""Pixels of alpha whose fields are drawn."""


@dataclass(frozen=True, kw_only=True)
class PatchGrid:
    """`grid` rows and columns of windows of height and width `hw`, evenly spaced, reduced `reduce` times."""

    hw: HW = (128, 384)
    grid: tuple[int, int] = (7, 7)
    reduce: int = 4

    def __post_init__(self) -> None:
        if min(*self.hw, *self.grid, self.reduce) < 1 or any(side % self.reduce for side in self.hw):
            raise ValueError(
                f"patches: {self.hw[1]}x{self.hw[0]} pixels cannot be reduced "
                f"{self.reduce} times: use a divisor"
            )

    @classmethod
    def like_the_papers(cls, hw: HW) -> PatchGrid:
        """96x32 patches that cover of an image of this size what the paper's cover of its own.

        >>> PatchGrid.like_the_papers((384, 512))
        PatchGrid(hw=(32, 96), grid=(7, 7), reduce=1)
        """
        reduce = max(round(4 * hw[1] / PAPER_WIDTH), 1)
        return cls(hw=(32 * reduce, 96 * reduce), reduce=reduce)

    @property
    def count(self) -> int:
        """How many there are of one image."""
        return self.grid[0] * self.grid[1]

    def corners(self, hw: HW) -> list[tuple[int, int]]:
        """(top, left) of each. Raises ValueError for an image that is smaller than a patch."""
        if hw[0] < self.hw[0] or hw[1] < self.hw[1]:
            raise ValueError(
                f"patches of {self.hw[1]}x{self.hw[0]} do not fit into an image "
                f"of {hw[1]}x{hw[0]}: give smaller ones"
            )
        tops, lefts = (_evenly(whole - size, n) for whole, size, n in zip(hw, self.hw, self.grid))
        return [(top, left) for top in tops for left in lefts]


def _evenly(room: int, count: int) -> list[int]:
    return [round(room * i / (count - 1)) for i in range(count)] if count > 1 else [round(room / 2)]


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
    Raises ValueError for a folder without scenes; for a scene that is incomplete, or of other sizes than the
    first, when it is read.
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
        self._scene = lru_cache(1)(self._read)

    def __len__(self) -> int:
        return len(self.folders) * self.patches.count

    def __getitem__(self, index: int) -> Patch:
        if not 0 <= index < len(self):
            raise IndexError(f"patch {index} of {len(self)}")
        scene, number = divmod(index, self.patches.count)
        rig, views = self._scene(scene)
        try:
            ideal = windows(views, rig, self.alpha, self.patches, number)
        except ValueError as error:
            raise ValueError(f"{self.folders[scene]}: {error}") from None
        recorded = record_array(
            {name: view.rgb[None] for name, view in ideal.items()},
            rig.replace(cameras={name: ideal[name].camera for name in rig.names}),
            self.chains,
            seed=seed_for(self.seed, 0, index),
        )
        alpha_view = ideal[self.alpha]
        images = {name: image[0] for name, image in recorded.images.items()}
        return Patch(images, srgb_image(alpha_view.rgb), alpha_view.depth, recorded.rig, self.alpha)

    def _read(self, scene: int) -> tuple[Rig, dict[str, RenderedView]]:
        """The rig and the views of a scene. Raises ValueError, naming the folder, if they are of no use."""
        folder = self.folders[scene]
        rig = scene_rig(folder)
        sizes, first = ({n: f"{c.hw[1]}x{c.hw[0]}" for n, c in r.cameras.items()} for r in (rig, self.rig))
        if sizes != first:
            here, there = (", ".join(f"{name} {wh}" for name, wh in s.items()) for s in (sizes, first))
            what = f"has images of other sizes than the first ({here}; first: {there})"
            raise ValueError(f"{folder}: {what}: one rig a folder")
        return rig, {name: read_view(folder, name) for name in rig.names}


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


def windows(
    views: Mapping[str, RenderedView], rig: Rig, alpha: str, patches: PatchGrid, number: int
) -> dict[str, RenderedView]:
    """Each camera's ideal view of one patch, alpha's first.

    Raises ValueError for patches that do not fit, and a rig without a depth range.
    """
    alpha_camera, (h, w), r = views[alpha].camera, patches.hw, patches.reduce
    top, left = patches.corners(alpha_camera.hw)[number]
    made = {alpha: window(views[alpha], top, left, patches.hw, (h // r, w // r))}
    middle = torch.tensor([left + (w - 1) / 2, top + (h - 1) / 2], dtype=torch.float64)
    X = alpha_camera.unproject(middle, middle_depth(*rig.pair(alpha, alpha).depth_range).double())
    for name in rig.betas(alpha):
        beta_camera = views[name].camera
        hw = _beta_size(alpha_camera, beta_camera, patches)
        x, _, valid = beta_camera.project(X)
        centre = x.tolist() if valid else [(n - 1) / 2 for n in beta_camera.hw[::-1]]
        top, left = (
            min(max(round(c - (n - 1) / 2), 0), whole - n)
            for c, n, whole in zip(centre[::-1], hw, beta_camera.hw)
        )
        made[name] = window(views[name], top, left, hw, (hw[0] // r, hw[1] // r))
    return made


def _beta_size(alpha: Camera, beta: Camera, patches: PatchGrid) -> HW:
    """About alpha's angle of view, a multiple of the reduction, and within beta's image."""
    ratio = [float(beta.K[i, :2].norm() / alpha.K[i, :2].norm()) for i in (1, 0)]
    r = patches.reduce
    sides = [max(round(n * s / r), 1) * r for n, s in zip(patches.hw, ratio)]
    h, w = (min(side, whole // r * r) for side, whole in zip(sides, beta.hw))
    if min(h, w) < r:
        raise ValueError(f"an image of {beta.hw[1]}x{beta.hw[0]} is too small for patches reduced {r} times")
    return h, w


def draw_patches(patches: Sequence[Patch]) -> Figure:
    """One line for each patch: alpha and betas as recorded with a few pixels' fields, ground truth, depth."""
    columns = len(patches[0].images) + 2
    h, w = patches[0].ground_truth.shape[-2:]
    figure = Figure(figsize=(3.2 * columns, (3.2 * h / w + 0.35) * len(patches)), layout="constrained")
    for row, patch in enumerate(patches):
        x = _pixels(patch.rig[patch.alpha].hw)
        further = ("ground truth", patch.ground_truth), ("depth", colour_depth(patch.depth))
        for column, (name, image) in enumerate([*patch.images.items(), *further]):
            axes = figure.add_subplot(len(patches), columns, row * columns + column + 1)
            show_image(axes, (image.shape[-2], image.shape[-1]), image.expand(3, -1, -1).clamp(0, 1))
            axes.set_title(f"{name} (alpha)" if column == 0 else name, fontsize=8)
            if column == 0:
                axes.scatter(*numpy(x).T, c=COLOURS[: len(x)], s=18, edgecolors="white", linewidths=0.6)
            elif column < len(patch.images):
                pair = patch.rig.pair(patch.alpha, name)
                draw_sampling_locations(axes, recorded_field(pair), pair, x)
    return figure


def _pixels(hw: HW) -> Float[Tensor, "n 2"]:
    """A few pixels all over an image, in a zigzag."""
    across = (torch.arange(SHOWN) + 0.5) / SHOWN * hw[1]
    down = torch.tensor([0.25, 0.75]).repeat(SHOWN)[:SHOWN] * hw[0]
    return torch.stack([across, down], -1).floor()
