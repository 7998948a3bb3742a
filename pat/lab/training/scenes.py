"""Rendered scenes as training samples: a random window of any camera is alpha, of any others betas.

Folders hold the output of `pat lab render`. Scenes may differ in rigs and image sizes; images of cameras with
a lens model are undistorted as `pat fuse` does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom import Camera, Rig, pixel_grid, stack
from arraygeom.pixels import HW
from pat.lab.data import windows
from pat.lab.data.windows import RenderedView
from pat.lab.synthesis.layered import ArrayBatch
from pat.lab.synthesis.rigs import below, in_frame_of, one_of, scaled
from pat.media.colour import srgb_image
from pat.sensors import generator_for

T = TypeVar("T")
ACTIVE = 8
"""Number of scenes or pairs that samples are drawn from at a time; their images stay in memory."""
GROUPS_PER_EXCHANGE = 8
"""Number of groups of samples after which one of the active items is exchanged."""
REDUCED = 4
"""Largest reduction of a window."""
SKY = 1e6
"""Distance in metres assigned to infinitely far points: their parallax is negligible."""
DECENTRED = 0.1
"""Largest random shift of a beta's window, as a fraction of its size."""


class Crops:
    """Base class of random windows of the items in folders.

    Subclasses define `sample`, and `_find(roots, choose)`, which lists the items.

    Args:
        roots: folders.
        hw: (height, width) of alpha in the samples.
        resolutions: factors of betas' resolution against alpha's, to draw from.
        seed: seed of the order in which items are used.
        device: device of the samples.
        choose: called with an item's number, returns True to take it.

    Raises:
        NotImplementedError: in this base class.
    """

    def __init__(
        self,
        roots: Sequence[Path],
        *,
        hw: HW,
        resolutions: tuple[float, ...] = (1.0,),
        seed: int = 0,
        device: str = "cpu",
        choose: Callable[[int], bool] = lambda i: True,
    ):
        self.hw, self.resolutions, self.seed, self.device = hw, resolutions, seed, device
        self._find(roots, choose)

    def _find(self, roots: Sequence[Path], choose: Callable[[int], bool]) -> None:
        """List the items, and refuse unusable ones."""
        raise NotImplementedError

    def sample(self, batch: int, generator: Generator, *, number: int, betas: int = 1) -> ArrayBatch:
        """Draw windows from the items that are active for group `number`.

        Args:
            batch: number of windows.
            generator: random generator on the CPU.
            number: number of the group, which decides the active items.
            betas: number of betas of a window.

        Returns:
            A batch of `batch` samples with `betas` betas; depth is NaN where unknown.

        Raises:
            NotImplementedError: in this base class.
        """
        raise NotImplementedError

    def beta_sizes(self, betas: int, generator: Generator) -> list[HW]:
        """Draw the sizes of betas.

        Returns:
            (height, width) of each of `betas` betas.
        """
        return [scaled(self.hw, one_of(self.resolutions, generator)) for _ in range(betas)]


class RenderedCrops(Crops):
    """Random windows of rendered scenes; arguments as of `Crops`.

    Raises:
        FileNotFoundError: for a missing folder.
        ValueError: for a folder without scenes or with an incomplete one, no chosen scene, and a scene whose
            rig cannot be read, or as `large_enough`.
    """

    def _find(self, roots: Sequence[Path], choose: Callable[[int], bool]) -> None:
        folders = [folder for root in roots for folder in windows.scene_folders(root)]
        self.folders = chosen(folders, choose, f"rendered scenes of {', '.join(map(str, roots))}")
        rigs = [windows.scene_rig(folder) for folder in self.folders]
        self.names = [rig.names for rig in rigs]
        self.alphas = [large_enough(folder, rig, self.hw) for folder, rig in zip(self.folders, rigs)]
        self._view = lru_cache(3 * ACTIVE)(self._read)

    def sample(self, batch: int, generator: Generator, *, number: int, betas: int = 1) -> ArrayBatch:
        """Draw windows from the scenes that are active for group `number`.

        If a scene has fewer other cameras than betas are wanted, several betas are of the same camera.

        Args:
            batch: number of windows.
            generator: random generator on the CPU.
            number: number of the group, which decides the active scenes.
            betas: number of betas of a window.

        Returns:
            A batch of `batch` samples with `betas` betas of pinhole cameras; depth is NaN where unknown.

        Raises:
            ValueError: naming the scene, if its images cannot be read.
        """
        scenes = active_items(number, len(self.folders), self.seed)
        sizes = self.beta_sizes(betas, generator)
        with torch.no_grad():
            drawn = [self._windows(one_of(scenes, generator), sizes, generator) for _ in range(batch)]
        return batched(drawn, self.device)

    def _read(self, scene: int, name: str) -> RenderedView:
        return windows.undistorted(windows.read_view(self.folders[scene], name))

    def _windows(self, scene: int, sizes: list[HW], g: Generator) -> list[RenderedView]:
        """Alpha's window and one of each beta."""
        name = one_of(self.alphas[scene], g)
        names = [n for n in self.names[scene] if n != name]
        order = [names[i] for i in torch.randperm(len(names), generator=g).tolist()]
        whole = self._view(scene, name)
        times = 1 + below(min(REDUCED, *(a // b for a, b in zip(whole.camera.hw, self.hw))), g)
        size = self.hw[0] * times, self.hw[1] * times
        top, left = [below(a - b + 1, g) for a, b in zip(whole.camera.hw, size)]
        alpha = finite_window(whole, top, left, size, self.hw)
        betas = [self._view(scene, order[i % len(order)]) for i in range(len(sizes))]
        return [alpha, *(beside(alpha, beta, small, self.hw, g) for beta, small in zip(betas, sizes))]


def active_items(number: int, count: int, seed: int) -> list[int]:
    """Choose the items (of `count`) that group `number` of samples is drawn from: a function of these numbers
    alone.

    >>> active_items(0, 3, seed=0) == active_items(100, 3, seed=0) == [0, 1, 2]
    True

    Returns:
        Numbers of at most `ACTIVE` items, each once.
    """
    if count <= ACTIVE:
        return list(range(count))
    first = number // GROUPS_PER_EXCHANGE
    items = (_order(count, seed, i // count)[i % count] for i in range(first, first + 2 * ACTIVE))
    return [*dict.fromkeys(items)][:ACTIVE]  # a new random order may begin with some of the last ones


@lru_cache(8)
def _order(count: int, seed: int, epoch: int) -> list[int]:
    return torch.randperm(count, generator=generator_for(seed, "order", epoch)).tolist()


def chosen(every: list[T], choose: Callable[[int], bool], what: str) -> list[T]:
    """Select items by their number.

    Args:
        every: all items.
        choose: called with an item's number, from 0, returns True to take it.
        what: name of the items in messages.

    Returns:
        The selected items.

    Raises:
        ValueError: if there are none.
    """
    items = [item for i, item in enumerate(every) if choose(i)]
    if not items:
        raise ValueError(f"{what}: {len(every)} are too few to learn from and to hold out: give more")
    return items


def large_enough(folder: Path, rig: Rig, hw: HW) -> list[str]:
    """List the cameras of a scene that can be alpha, at least as large as `hw` after undistortion.

    Args:
        folder: folder of the scene, for messages.
        hw: (height, width) of alpha in the samples.

    Returns:
        Their names.

    Raises:
        ValueError: if none is large enough, a camera is not calibrated, there are fewer than two, or a lens
            is valid for no pixel.
    """
    sizes = {name: windows.pinhole_of(c).hw for name, c in rig.cameras.items() if isinstance(c, Camera)}
    count = len(rig.names)
    if len(sizes) < max(count, 2):
        raise ValueError(f"{folder}: {len(sizes)} of {count} cameras are calibrated: all must be, and two")
    names = [name for name, size in sizes.items() if size[0] >= hw[0] and size[1] >= hw[1]]
    if not names:
        listed = ", ".join(f"{name} {w}x{h}" for name, (h, w) in sizes.items())
        raise ValueError(f"{folder}: no image is as large as samples, {hw[1]}x{hw[0]} ({listed}): lower `hw`")
    return names


def beside(alpha: RenderedView, beta: RenderedView, size: HW, hw: HW, g: Generator) -> RenderedView:
    """Cut beta's window with about alpha's angle of view, around the projection of alpha's centre at a random
    depth (beta's middle if it cannot be projected), shifted at random and then moved into the image.

    Args:
        alpha: alpha's window.
        beta: beta's whole view.
        size: (height, width) of the result.
        hw: (height, width) of alpha's window.
        g: random generator of the depth and the shift.

    Returns:
        Beta's window, resized to `size`, with its camera; one larger than the image has NaN depth beyond.
    """
    ratio = pixels_per_radian(beta.camera) / pixels_per_radian(alpha.camera)
    wanted = (max(round(hw[0] * ratio), 1), max(round(hw[1] * ratio), 1))
    middle = torch.tensor([(hw[1] - 1) / 2, (hw[0] - 1) / 2], dtype=torch.float64)
    near, far = (float(d) for d in bounds(alpha.depth[None])[0])
    share = float(torch.rand((), generator=g))
    depth = middle.new_tensor(1 / (share / near + (1 - share) / far))
    projected = beta.camera.project(alpha.camera.unproject(middle, depth))
    shift = DECENTRED * (2 * torch.rand(2, generator=g, dtype=torch.float64) - 1)
    centre = middle.new_tensor([beta.camera.hw[1] / 2, beta.camera.hw[0] / 2])
    centre = projected.x if bool(projected.valid) else centre
    x, y = (centre + shift * middle.new_tensor([wanted[1], wanted[0]])).tolist()
    top, left = (_inside(c - n / 2, n, whole) for c, n, whole in zip((y, x), wanted, beta.camera.hw))
    return finite_window(beta, top, left, wanted, size)


def _inside(start: float, length: int, whole: int) -> int:
    """Start of a window, shifted into the image, or centred on it if the window is larger."""
    low, high = sorted((0, whole - length))
    return round(min(max(start, low), high))


def pixels_per_radian(camera: Camera) -> float:
    """Return the angular resolution in the middle of a camera's image, pixels for each radian."""
    return float(camera.K[:2, :2].det().abs().sqrt())


def finite_window(view: RenderedView, top: int, left: int, size: HW, hw: HW) -> RenderedView:
    """Cut a `window` (see its arguments) and replace infinite depths by those at a distance of `SKY` metres.

    Returns:
        The window, with its camera; depth stays NaN where unknown.
    """
    cut = windows.window(view, top, left, size, hw)
    rays, _ = cut.camera.rays(pixel_grid(hw, dtype=torch.float64))
    depth = torch.where(cut.depth.isposinf(), (SKY / rays.norm(dim=-1)).to(cut.depth), cut.depth)
    return cut._replace(depth=depth)


def bounds(depth: Float[Tensor, "b h w"]) -> Float[Tensor, "b 2"]:
    """Compute the nearest and farthest depth of each map, NaN ignored.

    Returns:
        Bounds (b, 2) in metres; both `SKY` for a map without depth.
    """
    unseen = depth.isnan()
    near = torch.where(unseen, SKY, depth).flatten(1).amin(1)
    return torch.stack([near, torch.maximum(near, torch.where(unseen, 0.0, depth).flatten(1).amax(1))], -1)


def batched(drawn: Sequence[Sequence[RenderedView]], device: str) -> ArrayBatch:
    """Stack samples to a batch.

    Args:
        drawn: views of each sample, alpha first; views of one place have the same size in all samples.
        device: device of the batch.

    Returns:
        A batch on the device, images sRGB-encoded, cameras float32, alpha's frame as the world, no index.
    """
    views = list(zip(*drawn))
    images = [srgb_image(torch.stack([v.rgb for v in same])).to(device) for same in views]
    depth = [torch.stack([v.depth for v in same]).to(device) for same in views]
    cameras = [
        stack([in_frame_of(alpha.camera, v.camera) for alpha, v in zip(views[0], same)]).to(
            device, torch.float32
        )
        for same in views
    ]
    return ArrayBatch(images, depth, cameras, bounds(depth[0]))
