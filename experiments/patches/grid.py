"""Patches of rendered scenes: cut on the fly, reduced, each with the rig of its own windows.

The paper's are 49 windows of 384x128 of every 2048x1536 view, reduced cubically to 96x32. Each camera's
window has about alpha's angle of view, centred where the middle of alpha's window projects at the middle
inverse depth of the rig's range (not at its true depth, which a network could exploit).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.batching import stack
from arraygeom.camera import Camera
from arraygeom.pixels import HW
from arraygeom.rig import Rig, middle_depth
from pat.data.windows import read_view, scene_rig, window

PAPER_WIDTH = 2048


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
        tops, lefts = (_evenly(whole - part, n) for whole, part, n in zip(hw, self.hw, self.grid))
        return [(top, left) for top in tops for left in lefts]


def _evenly(room: int, count: int) -> list[int]:
    return [
        round(room * (i + 0.5) / count) if count == 1 else round(room * i / (count - 1)) for i in range(count)
    ]


class PatchStack(NamedTuple):
    """A scene's patches: linear RGB and depth (metres) by camera, and the batched cameras of the windows."""

    rgb: dict[str, Float[Tensor, "n 3 _ _"]]
    depth: dict[str, Float[Tensor, "n _ _"]]
    rig: Rig


def cut(folder: Path, patches: PatchGrid, *, alpha: str) -> PatchStack:
    """All patches of a scene.

    Raises ValueError, naming the folder, for images that cannot be read, patches that do not fit, and a rig
    that is not calibrated.
    """
    rig = scene_rig(folder)
    views = {name: read_view(folder, name) for name in rig.names}
    try:
        windows = _windows({name: view.camera for name, view in views.items()}, rig, alpha, patches)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from None
    found = {}
    for name, (corners, hw) in windows.items():
        small = hw[0] // patches.reduce, hw[1] // patches.reduce
        found[name] = [window(views[name], top, left, hw, small) for top, left in corners]
    near, far = (d.expand(patches.count) for d in rig.pair(alpha, alpha).depth_range)
    return PatchStack(
        rgb={name: torch.stack([view.rgb for view in found[name]]) for name in rig.names},
        depth={name: torch.stack([view.depth for view in found[name]]) for name in rig.names},
        rig=rig.replace(
            cameras={name: stack([view.camera for view in found[name]]) for name in rig.names},
            depth=(near, far),
        ),
    )


Corners = list[tuple[int, int]]


def _windows(
    cameras: dict[str, Camera], rig: Rig, alpha: str, patches: PatchGrid
) -> dict[str, tuple[Corners, HW]]:
    """For each camera, the corners of its windows and their size."""
    corners = patches.corners(rig[alpha].hw)
    found = {alpha: (corners, patches.hw)}
    h, w = patches.hw
    middles = torch.tensor(
        [[left + (w - 1) / 2, top + (h - 1) / 2] for top, left in corners], dtype=torch.float64
    )
    depth = middle_depth(*rig.pair(alpha, alpha).depth_range)
    X = cameras[alpha].unproject(middles, depth.expand(len(middles)).double())
    for name in rig.betas(alpha):
        beta = cameras[name]
        hw = _beta_size(cameras[alpha], beta, patches)
        seen, _, valid = beta.project(X)
        centre = middles.new_tensor([(beta.hw[1] - 1) / 2, (beta.hw[0] - 1) / 2])
        x = torch.where(valid[:, None], seen, centre).tolist()
        found[name] = [_corner(middle, hw, beta.hw) for middle in x], hw
    return found


def _corner(x: list[float], hw: HW, whole: HW) -> tuple[int, int]:
    """(top, left) of a window centred at x, shifted into the image."""
    top, left = (round(x[1] - (hw[0] - 1) / 2), round(x[0] - (hw[1] - 1) / 2))
    return min(max(top, 0), whole[0] - hw[0]), min(max(left, 0), whole[1] - hw[1])


def _beta_size(alpha: Camera, beta: Camera, patches: PatchGrid) -> HW:
    """About alpha's angle of view, a multiple of the reduction, and within beta's image."""
    ratio = [float(beta.K[i, :2].norm() / alpha.K[i, :2].norm()) for i in (1, 0)]
    r = patches.reduce
    sides = [max(round(n * s / r), 1) * r for n, s in zip(patches.hw, ratio)]
    h, w = (min(side, whole // r * r) for side, whole in zip(sides, beta.hw))
    if min(h, w) < r:
        raise ValueError(f"an image of {beta.hw[1]}x{beta.hw[0]} is too small for patches reduced {r} times")
    return h, w


def same_cameras(one: Rig, other: Rig) -> None:
    """Raises ValueError unless two rigs have the same cameras with images of the same sizes."""
    sizes = [{name: f"{c.hw[1]}x{c.hw[0]}" for name, c in rig.cameras.items()} for rig in (one, other)]
    if sizes[0] != sizes[1]:
        shown = [", ".join(f"{name} {wh}" for name, wh in s.items()) for s in sizes]
        raise ValueError(
            f"has images of other sizes than the first ({shown[1]}; first: {shown[0]}): one rig a folder"
        )
