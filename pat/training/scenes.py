"""Rendered scenes as training samples: a random window of any camera as alpha, of any others as betas.

Folders hold what `pat render` leaves. Scenes may differ in their rigs and in the sizes of their images; cameras with
a lens are straightened as `pat fuse` does it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom.batching import stack
from arraygeom.camera import Camera
from arraygeom.pixels import HW, pixel_grid
from arraygeom.rig import Rig
from arraygeom.undistortion import pinhole_view, resampled
from pat.data.patches import reading, reduced, reduced_depth, scene_folders, scene_rig
from pat.data.scenes import coded
from pat.sensors import generator_for
from pat.synthesis.layered import ArrayBatch
from pat.synthesis.rendered import Rendered, RenderedFrame
from pat.synthesis.rigs import scaled

T = TypeVar("T")
HELD = 8
"""Scenes, or pairs, that samples are taken from at a time; their images stay in memory."""
TURN = 8
"""After so many groups of samples one of them is exchanged."""
REDUCED = 4
"""How many times a window is reduced at most."""
SKY = 1e6
"""The distance from the camera, in metres, of what is infinitely far: its place in beta is the same to the eye."""
DECENTRED = 0.1
"""How far a beta's window misses what alpha's middle may see, as a fraction of its size."""


class View(NamedTuple):
    """An image in linear light, the depth of its pixels (metres; NaN where the camera sees nothing), its pinhole."""

    rgb: Float[Tensor, "3 h w"]
    depth: Float[Tensor, "h w"]
    camera: Camera


class Crops:
    """Random windows of what is in folders; `hw` is alpha's size in the samples.

    `resolutions` are those of betas, as in `RigDistribution`; `choose` says by its number whether an item is taken.
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
        """Looks at what is there, and refuses what cannot be used."""
        raise NotImplementedError

    def beta_sizes(self, betas: int, generator: Generator) -> list[HW]:
        """Sizes of betas, drawn."""
        return [scaled(self.hw, one_of(self.resolutions, generator)) for _ in range(betas)]


class RenderedCrops(Crops):
    """Random windows of the rendered scenes in folders.

    Raises ValueError for a folder without scenes or with one that is not whole, for a scene of one camera, and for
    one of which no image is as large as `hw`; when it comes up, for one whose images cannot be read.
    """

    def _find(self, roots: Sequence[Path], choose: Callable[[int], bool]) -> None:
        found = [folder for root in roots for folder in scene_folders(root)]
        self.folders = chosen(found, choose, f"rendered scenes of {', '.join(map(str, roots))}")
        rigs = [scene_rig(folder) for folder in self.folders]
        self.names = [rig.names for rig in rigs]
        self.alphas = [large_enough(folder, rig, self.hw) for folder, rig in zip(self.folders, rigs)]
        self._view = lru_cache(3 * HELD)(lambda scene, name: read_view(self.folders[scene], name))

    def sample(self, batch: int, generator: Generator, *, number: int, betas: int = 1) -> ArrayBatch:
        """Windows of group `number`, of the scenes whose turn it is.

        A scene with fewer other cameras than betas are wanted has several betas in one place.
        """
        scenes = in_hand(number, len(self.folders), self.seed)
        sizes = self.beta_sizes(betas, generator)
        with torch.no_grad():
            drawn = [self._windows(one_of(scenes, generator), sizes, generator) for _ in range(batch)]
        return batched(drawn, self.device)

    def _windows(self, scene: int, sizes: list[HW], g: Generator) -> list[View]:
        """Alpha's window and one of each beta."""
        name = one_of(self.alphas[scene], g)
        names = [n for n in self.names[scene] if n != name]
        order = [names[i] for i in torch.randperm(len(names), generator=g).tolist()]
        whole = self._view(scene, name)
        times = 1 + below(min(REDUCED, *(a // b for a, b in zip(whole.camera.hw, self.hw))), g)
        size = self.hw[0] * times, self.hw[1] * times
        corner = [below(a - b + 1, g) for a, b in zip(whole.camera.hw, size)]
        alpha = window(whole, corner[0], corner[1], size, self.hw)
        betas = [self._view(scene, order[i % len(order)]) for i in range(len(sizes))]
        return [alpha, *(beside(alpha, beta, small, self.hw, g) for beta, small in zip(betas, sizes))]


def in_hand(number: int, count: int, seed: int) -> list[int]:
    """Which of `count` items group `number` of samples is taken from: a function of these numbers alone.

    >>> in_hand(0, 3, seed=0) == in_hand(100, 3, seed=0) == [0, 1, 2]
    True
    """
    if count <= HELD:
        return list(range(count))
    places = range(number // TURN, number // TURN + HELD)
    return [_order(count, seed, place // count)[place % count] for place in places]


@lru_cache(8)
def _order(count: int, seed: int, epoch: int) -> list[int]:
    return torch.randperm(count, generator=generator_for(seed, "order", epoch)).tolist()


def chosen(found: list[T], choose: Callable[[int], bool], what: str) -> list[T]:
    """Those chosen by their number. Raises ValueError if none is."""
    kept = [item for i, item in enumerate(found) if choose(i)]
    if not kept:
        raise ValueError(f"{what}: {len(found)} are too few to learn from some and to hold others out: give more")
    return kept


def large_enough(folder: Path, rig: Rig, hw: HW) -> list[str]:
    """The cameras of a scene that can be alpha. Raises ValueError if none can, or there is no other."""
    cameras = {name: rig[name] for name in rig.names}
    sizes = {name: pinhole_of(c).hw for name, c in cameras.items() if isinstance(c, Camera)}
    if len(sizes) < max(len(cameras), 2):
        raise ValueError(f"{folder}: has {len(sizes)} calibrated cameras of {len(cameras)}: all must be, two at least")
    names = [name for name, size in sizes.items() if size[0] >= hw[0] and size[1] >= hw[1]]
    if not names:
        said = ", ".join(f"{name} {w}x{h}" for name, (h, w) in sizes.items())
        raise ValueError(f"{folder}: no image is as large as the samples, {hw[1]}x{hw[0]} ({said}): lower `hw`")
    return names


def read_view(folder: Path, name: str) -> View:
    """The first frame of a camera. Raises ValueError, naming the folder, for one that cannot be used."""
    with reading(folder):
        frame, camera = Rendered(folder).frame(name), Rendered(folder).rig[name]
    assert isinstance(camera, Camera)
    hw = (frame.depth.shape[-2], frame.depth.shape[-1])
    if hw != camera.hw or frame.rgb.shape[1:] != frame.depth.shape:
        raise ValueError(
            f"{folder}: the image of '{name}' is {hw[1]}x{hw[0]}, its rig says {camera.hw[1]}x{camera.hw[0]}: "
            "remove it and run 'pat render' again"
        )
    return straight(frame, camera.to(torch.float64))


def straight(frame: RenderedFrame, camera: Camera) -> View:
    """A frame without its lens's bending."""
    if camera.distortion is None:
        return View(frame.rgb, frame.depth, camera)
    pinhole = pinhole_of(camera)
    rgb = resampled(frame.rgb, camera, pinhole, extended=True).values[0].clamp(min=0)
    depth = resampled(frame.depth[None], camera, pinhole, interpolation="nearest")
    return View(rgb, torch.where(depth.valid[0], depth.values[0, 0], torch.nan), pinhole)


def pinhole_of(camera: Camera) -> Camera:
    """The camera itself, or its pinhole view if it has a lens."""
    return camera if camera.distortion is None else pinhole_view(camera)


def beside(alpha: View, beta: View, size: HW, hw: HW, g: Generator) -> View:
    """A window of beta of alpha's angle of view, about where alpha's middle would be seen at a random depth."""
    sharper = pitch(beta.camera) / pitch(alpha.camera)
    wanted = (max(round(hw[0] * sharper), 1), max(round(hw[1] * sharper), 1))
    middle = torch.tensor([(hw[1] - 1) / 2, (hw[0] - 1) / 2], dtype=torch.float64)
    near, far = (float(d) for d in bounds(alpha.depth[None])[0])
    share = float(torch.rand((), generator=g))
    depth = middle.new_tensor(1 / (share / near + (1 - share) / far))
    seen = beta.camera.project(alpha.camera.unproject(middle, depth))
    missed = DECENTRED * (2 * torch.rand(2, generator=g, dtype=torch.float64) - 1)
    centre = seen.x if bool(seen.valid) else middle.new_tensor([beta.camera.hw[1] / 2, beta.camera.hw[0] / 2])
    x, y = (centre + missed * middle.new_tensor([wanted[1], wanted[0]])).tolist()
    top, left = (_inside(c - n / 2, n, whole) for c, n, whole in zip((y, x), wanted, beta.camera.hw))
    return window(beta, top, left, wanted, size)


def _inside(start: float, length: int, whole: int) -> int:
    """Where a window starts, moved into the image, or about it where it is larger."""
    low, high = sorted((0, whole - length))
    return round(min(max(start, low), high))


def pitch(camera: Camera) -> float:
    """Pixels a radian in the middle of the image."""
    return float(camera.K[:2, :2].det().abs().sqrt())


def window(view: View, top: int, left: int, size: HW, hw: HW) -> View:
    """A window of a view, reduced (or enlarged) to `hw`. Beyond the image its edge is repeated, without depth."""
    rows, columns = (torch.arange(n) + start for n, start in zip(size, (top, left)))
    h, w = view.camera.hw
    there = ((rows >= 0) & (rows < h))[:, None] & (columns >= 0) & (columns < w)
    rows, columns = rows.clamp(0, h - 1)[:, None], columns.clamp(0, w - 1)
    depth = torch.where(there, view.depth[rows, columns], torch.nan)
    camera = view.camera.crop(top, left, size).resize(hw)
    return View(
        reduced(view.rgb[:, rows, columns][None], hw)[0], finite(reduced_depth(depth[None], hw)[0], camera), camera
    )


def finite(depth: Float[Tensor, "h w"], camera: Camera) -> Float[Tensor, "h w"]:
    """The depth with what is infinitely far put `SKY` away."""
    rays, _ = camera.rays(pixel_grid(camera.hw, dtype=torch.float64))
    return torch.where(depth.isposinf(), (SKY / rays.norm(dim=-1)).to(depth), depth)


def bounds(depth: Float[Tensor, "b h w"]) -> Float[Tensor, "b 2"]:
    """The nearest and the farthest of what is seen; `SKY` where nothing is."""
    unseen = depth.isnan()
    near = torch.where(unseen, SKY, depth).flatten(1).amin(1)
    return torch.stack([near, torch.maximum(near, torch.where(unseen, 0.0, depth).flatten(1).amax(1))], -1)


def batched(drawn: Sequence[Sequence[View]], device: str) -> ArrayBatch:
    """Samples of views of the same sizes, each with alpha first, as one batch."""
    views = list(zip(*drawn))
    images = [coded(torch.stack([v.rgb for v in same])).to(device) for same in views]
    depth = [torch.stack([v.depth for v in same]).to(device) for same in views]
    relative = [[v.camera.cam_from_world @ one[0].camera.cam_from_world.inverse() for v in one] for one in drawn]
    poses = [stack(same) for same in zip(*relative)]
    K = [torch.stack([v.camera.K for v in same]).to(device, torch.float32) for same in views]
    R, t = ([getattr(p, part).to(device, torch.float32) for p in poses] for part in ("R", "t"))
    return ArrayBatch(images, depth, K, R, t, [same[0].camera.hw for same in views], bounds(depth[0]))


def one_of(items: Sequence[T], g: Generator) -> T:
    """One of several, all equally likely."""
    return items[below(len(items), g)]


def below(count: int, g: Generator) -> int:
    """A whole number from 0 to `count` - 1."""
    return int(torch.randint(count, (), generator=g))
