"""Patches of rendered scenes: cut on the fly, reduced, each with the rig of its own windows.

The paper's are 49 windows of 384x128 of every 2048x1536 view, reduced cubically to 96x32. Each camera's window has
about alpha's angle of view and lies where the middle of alpha's window would be seen at the middle inverse depth of
the rig's range (not at its true depth, which would tell a network where to look).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom.batching import stack
from arraygeom.camera import Camera
from arraygeom.pixels import HW, map_homogeneous, pixel_grid, resize_matrix
from arraygeom.rig import Rig, middle_depth
from arraygeom.sampling import sample
from pat.synthesis.rendered import RENDER_FILE, Rendered, RenderedFrame, is_rendered

PAPER_WIDTH = 2048


@dataclass(frozen=True, kw_only=True)
class Patches:
    """`grid` rows and columns of windows of height and width `hw`, spread evenly, reduced `reduce` times."""

    hw: HW = (128, 384)
    grid: tuple[int, int] = (7, 7)
    reduce: int = 4

    def __post_init__(self) -> None:
        if min(*self.hw, *self.grid, self.reduce) < 1 or any(side % self.reduce for side in self.hw):
            raise ValueError(
                f"patches: {self.hw[1]}x{self.hw[0]} pixels cannot be reduced {self.reduce} times: use a divisor"
            )

    @classmethod
    def like_the_papers(cls, hw: HW) -> Patches:
        """96x32 patches that cover of an image of this size what the paper's cover of its own.

        >>> Patches.like_the_papers((384, 512))
        Patches(hw=(32, 96), grid=(7, 7), reduce=1)
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
                f"patches of {self.hw[1]}x{self.hw[0]} do not fit into an image of {hw[1]}x{hw[0]}: give smaller ones"
            )
        tops, lefts = (_spread(whole - part, n) for whole, part, n in zip(hw, self.hw, self.grid))
        return [(top, left) for top in tops for left in lefts]


def _spread(room: int, count: int) -> list[int]:
    return [round(room * (i + 0.5) / count) if count == 1 else round(room * i / (count - 1)) for i in range(count)]


class Stack(NamedTuple):
    """All patches of a scene: linear RGB and depth (metres) by camera, and the batched cameras of those windows."""

    rgb: dict[str, Float[Tensor, "n 3 _ _"]]
    depth: dict[str, Float[Tensor, "n _ _"]]
    rig: Rig


def scene_folders(root: str | Path) -> list[Path]:
    """The whole scenes in a folder of a job, of scenes, or a scene itself, in order of their names.

    Raises FileNotFoundError for no such folder, ValueError where there is no scene, or one that is not whole.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"{root}: no such folder: check the path")
    if is_rendered(root):
        return [root]
    inside = root / "scenes" if (root / "scenes").is_dir() else root
    folders = sorted(f for f in inside.iterdir() if f.is_dir() and not f.name.startswith("."))
    if not any(is_rendered(f) for f in folders):
        raise ValueError(f"{root}: holds no rendered scene: make some with 'pat render CONFIG --scenes N --out {root}'")
    for folder in folders:
        if not is_rendered(folder):
            raise ValueError(f"{folder}: is not a whole scene (no {RENDER_FILE}): remove it and run 'pat render' again")
    return folders


@contextmanager
def reading(folder: Path) -> Iterator[None]:
    """Errors of what is read name the folder and say what to do."""
    try:
        yield
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, TypeError) as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{folder}: cannot be read ({said}): remove it and run 'pat render' again") from None


def scene_rig(folder: Path) -> Rig:
    """The cameras of a scene. Raises ValueError if they cannot be read."""
    with reading(folder):
        return Rendered(folder).rig


def cut(folder: Path, patches: Patches, *, alpha: str) -> Stack:
    """All patches of a scene.

    Raises ValueError, naming the folder, for images that cannot be read, patches that do not fit, and a rig
    that is not calibrated.
    """
    rig = scene_rig(folder)
    with reading(folder):
        frames = Rendered(folder).first_frames()
    try:
        windows = _windows(rig, alpha, patches)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from None
    found = {name: _cut_view(_camera(rig, name), frames[name], *windows[name], patches.reduce) for name in rig.names}
    cameras = {name: camera for name, (_, _, camera) in found.items()}
    near, far = (d.expand(patches.count) for d in rig.pair(alpha, alpha).depth_range)
    return Stack(
        rgb={name: rgb for name, (rgb, _, _) in found.items()},
        depth={name: depth for name, (_, depth, _) in found.items()},
        rig=rig.replace(cameras=cameras, depth=(near, far)),
    )


Corners = list[tuple[int, int]]


def _windows(rig: Rig, alpha: str, patches: Patches) -> dict[str, tuple[Corners, HW]]:
    """For each camera, the corners of its windows and their size."""
    corners = patches.corners(rig[alpha].hw)
    found = {alpha: (corners, patches.hw)}
    camera, depth = _camera(rig, alpha), middle_depth(*rig.pair(alpha, alpha).depth_range)
    h, w = patches.hw
    middles = torch.tensor([[left + (w - 1) / 2, top + (h - 1) / 2] for top, left in corners], dtype=torch.float64)
    X = camera.unproject(middles, depth.expand(len(middles)).double())
    for name in rig.betas(alpha):
        beta = _camera(rig, name)
        hw = _beta_size(camera, beta, patches)
        seen, _, valid = beta.project(X)
        middle = torch.where(valid[:, None], seen, middles.new_tensor([(beta.hw[1] - 1) / 2, (beta.hw[0] - 1) / 2]))
        found[name] = [_placed(x, hw, beta.hw) for x in middle.tolist()], hw
    return found


def _placed(x: list[float], hw: HW, whole: HW) -> tuple[int, int]:
    """(top, left) of a window about x, moved into the image."""
    top, left = (round(x[1] - (hw[0] - 1) / 2), round(x[0] - (hw[1] - 1) / 2))
    return min(max(top, 0), whole[0] - hw[0]), min(max(left, 0), whole[1] - hw[1])


def _beta_size(alpha: Camera, beta: Camera, patches: Patches) -> HW:
    """About alpha's angle of view, a multiple of the reduction, and within beta's image."""
    ratio = [float(beta.K[i, :2].norm() / alpha.K[i, :2].norm()) for i in (1, 0)]
    r = patches.reduce
    sides = [max(round(n * s / r), 1) * r for n, s in zip(patches.hw, ratio)]
    h, w = (min(side, whole // r * r) for side, whole in zip(sides, beta.hw))
    if min(h, w) < r:
        raise ValueError(f"an image of {beta.hw[1]}x{beta.hw[0]} is too small for patches reduced {r} times")
    return h, w


def _cut_view(
    camera: Camera, frame: RenderedFrame, corners: Corners, hw: HW, reduce: int
) -> tuple[Tensor, Tensor, Camera]:
    windows = [camera.crop(top, left, hw) for top, left in corners]
    small = hw[0] // reduce, hw[1] // reduce
    rgb = torch.stack([frame.rgb[:, top : top + hw[0], left : left + hw[1]] for top, left in corners])
    depth = torch.stack([frame.depth[top : top + hw[0], left : left + hw[1]] for top, left in corners])
    return reduced(rgb, small), reduced_depth(depth, small), stack([window.resize(small) for window in windows])


def reduced(rgb: Float[Tensor, "n c h w"], hw: HW) -> Float[Tensor, "n c h2 w2"]:
    """Cubic (a = -0.5, antialiased) reduction of linear light, which stays above zero."""
    if rgb.shape[-2:] == hw:
        return rgb
    return interpolate(rgb, hw, mode="bicubic", align_corners=False, antialias=True).clamp(min=0)


def reduced_depth(depth: Float[Tensor, "n h w"], hw: HW) -> Float[Tensor, "n h2 w2"]:
    """Depth at the new pixels' centres: inverse depth interpolated on even surfaces, the nearest pixel's at edges."""
    old = (depth.shape[-2], depth.shape[-1])
    if old == hw:
        return depth
    back = resize_matrix(hw, old)
    x = map_homogeneous(back[:2], pixel_grid(hw, dtype=torch.float64)).to(depth)[None]
    between = 1 / sample(1 / depth[:, None], x).values[:, 0]
    nearest = sample(depth[:, None], x, interpolation="nearest").values[:, 0]
    even = (between / nearest - 1).abs() < 0.01
    return torch.where(even, between, nearest)


def _camera(rig: Rig, name: str) -> Camera:
    camera = rig[name]
    if not isinstance(camera, Camera):
        raise ValueError(f"camera '{name}' is not calibrated")
    return camera


def stacked(rigs: list[Rig]) -> Rig:
    """A batch of rigs of the same cameras. Raises ValueError where sizes or names differ."""
    first = rigs[0]
    for rig in rigs[1:]:
        same_cameras(first, rig)
    return stack(rigs)


def same_cameras(one: Rig, other: Rig) -> None:
    """Raises ValueError unless two rigs have the same cameras with images of the same sizes."""
    sizes = [{name: f"{c.hw[1]}x{c.hw[0]}" for name, c in rig.cameras.items()} for rig in (one, other)]
    if sizes[0] != sizes[1]:
        said = [", ".join(f"{name} {wh}" for name, wh in s.items()) for s in sizes]
        raise ValueError(f"has images of other sizes than the first ({said[1]}; first: {said[0]}): one rig a folder")
