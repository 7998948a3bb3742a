"""Stereo pairs as training samples: a random window of an image as alpha and truth, of the other as beta.

Where their depth is not known, the loss is on the image alone. Their cameras are assumed: rectified, a metre
apart, with the pair's range of disparities.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from PIL import Image, UnidentifiedImageError
from torch import Generator, Tensor

from arraygeom.camera import Camera, intrinsics
from arraygeom.pixels import HW
from arraygeom.pose import Pose
from pat.data.pairs import MIDDLEBURY, PairFiles, pair_files
from pat.data.windows import reduced
from pat.media.images import read_image
from pat.synthesis.layered import ArrayBatch
from pat.synthesis.rigs import below

from .scenes import ACTIVE, Crops

COUNTERPART = {"disp2.png": "disp6.png", "disp1.png": "disp5.png"}
"""Files of the disparity of the right image, by those of the left."""
REDUCED = 2
"""The largest reduction of a window: images found online are often less sharp than their pixels."""


class Pictures(NamedTuple):
    """Two images (3, H, W), the largest disparity, pixels; and their disparities (H, W), 0 if not known."""

    left: Tensor
    right: Tensor
    largest: float
    disparities: tuple[Tensor, ...]


class PairCrops(Crops):
    """Random windows of the rectified stereo pairs in folders.

    Raises ValueError for a folder without pairs, for a pair whose images differ in size, are not in colour or
    are smaller than `hw`; when it is read, for an image that cannot be read.
    """

    what = "stereo pairs"
    measured = False

    def _listed(self, root: Path) -> list[PairFiles]:
        return pair_files(root)

    def _check(self) -> None:
        for pair in self.items:
            check_pair(pair, self.hw)
            if self.measured:
                disparity_files(pair)
        self._pictures = lru_cache(ACTIVE)(lambda i: read_pair(self.items[i], measured=self.measured))

    def _drawn(
        self, item: int, sizes: list[HW], g: Generator
    ) -> tuple[list[Tensor], list[Tensor], float, float]:
        """Alpha and beta, their disparities, 1 where alpha is left, -1 where right, the largest disparity."""
        pictures, (h, w) = self._pictures(item), self.hw
        whole = pictures.left.shape[1:]
        times = 1 + below(min(REDUCED, whole[0] // h, whole[1] // w), g)
        top, left = (below(n - times * m + 1, g) for n, m in zip(whole, self.hw))
        window = slice(top, top + times * h), slice(left, left + times * w)
        cut = [p[None, :, *window] for p in (pictures.left, pictures.right)]
        images = [reduced(p, self.hw)[0].clamp(max=1) for p in cut]
        disparities = [d[window][::times, ::times] / times for d in pictures.disparities]
        largest = pictures.largest / times
        if below(2, g):
            return images, disparities, 1.0, largest
        return images[::-1], disparities[::-1], -1.0, largest

    def _batched(self, drawn: list[Any], sizes: list[HW]) -> ArrayBatch:
        """Cameras are a metre apart, and of a focal length that puts the nearest points where they are."""
        images, disparities, sides, largest = zip(*drawn)
        alpha, beta = (torch.stack(same) for same in zip(*images))
        shown = [alpha, *(reduced(beta, size).clamp(max=1) for size in sizes)]
        side, nearest = (torch.tensor(numbers, dtype=torch.float64) for numbers in (sides, largest))
        batch, (h, w), t = len(drawn), self.hw, torch.zeros(len(drawn), 3, dtype=torch.float64)
        R, K = torch.eye(3, dtype=torch.float64).expand(batch, 3, 3), intrinsics(float(w), self.hw)
        left = Camera(K=K.expand(batch, 3, 3), cam_from_world=Pose(R, t), hw=(h, w))
        right = left.replace(cam_from_world=Pose(R, torch.stack([-side, t[:, 1], t[:, 2]], -1)))
        cameras = [c.to(self.device, torch.float32) for c in (left, *(right.resize(hw) for hw in sizes))]
        near = w / nearest
        bounds = torch.stack([near, torch.full_like(near, torch.inf)], -1).to(self.device, torch.float32)
        depth: list[Tensor] = []
        if self.measured:
            stacked = (torch.stack(same) for same in zip(*disparities))
            ours, theirs = (torch.where(d > 0, w / d, torch.nan) for d in stacked)
            depth = [ours, *(coarser(theirs, size) for size in sizes)]
        placed, depth = ([x.to(self.device) for x in made] for made in (shown, depth))
        return ArrayBatch(placed, depth, cameras, bounds)


class MeasuredPairs(PairCrops):
    """Random windows of Middlebury's pairs in folders, of the collections of 2003, 2005 and 2006.

    Raises ValueError as `PairCrops`, and for a pair without the disparity of both images.
    """

    measured = True


def read_pair(pair: PairFiles, *, measured: bool) -> Pictures:
    """The images of a pair, and if `measured` their disparities."""
    images = read_image(pair.left), read_image(pair.right)
    files = disparity_files(pair) if measured else ()
    known = (read_image(path)[0] * 255 / (255 / pair.max_disparity) for path in files)
    return Pictures(*images, pair.max_disparity, tuple(known))


def disparity_files(pair: PairFiles) -> tuple[Path, Path]:
    """Of the left and of the right image. Raises ValueError where one is missing."""
    for layout in MIDDLEBURY.values():
        names = layout.ground_truth, COUNTERPART.get(layout.ground_truth, "-")
        left, right = (pair.left.with_name(name) for name in names)
        if pair.left.name == layout.left and left.is_file() and right.is_file():
            return left, right
    raise ValueError(f"{pair.left.parent}: wanted both images' true disparities, disp1.png and disp5.png")


def coarser(depth: Float[Tensor, "b h w"], hw: HW) -> Float[Tensor, "b hs ws"]:
    """The depth at about the centres of larger pixels, never a mean across an edge."""
    h, w = depth.shape[-2:]
    rows, columns = (((torch.arange(n) + 0.5) * whole / n).long() for n, whole in zip(hw, (h, w)))
    return depth[:, rows][:, :, columns]


def check_pair(pair: PairFiles, hw: HW) -> None:
    """Raises ValueError unless both images are in colour, of one size, and at least `hw`."""
    left, right = _header(pair.left), _header(pair.right)
    if left != right:
        other = f"{pair.right.name} {_described(right)}"
        raise ValueError(f"{pair.left} is {_described(left)} and {other}: pairs must be alike")
    if left[2] == 1:
        raise ValueError(f"{pair.left} is grey: pairs to train on must be in colour")
    if left[0] < hw[0] or left[1] < hw[1]:
        wanted = f"smaller than the samples, {hw[1]}x{hw[0]}: lower `hw`"
        raise ValueError(f"{pair.left} is {_described(left)}, {wanted}")


def _header(file: Path) -> tuple[int, int, int]:
    """Height, width and channels (1 or 3) of an image, without reading it whole."""
    try:
        with Image.open(file) as image:
            return image.height, image.width, 1 if image.mode[0] in "1LIF" else 3
    except (OSError, UnidentifiedImageError):
        raise ValueError(f"{file}: not an image that can be read: give a whole PNG or JPEG file") from None


def _described(header: tuple[int, int, int]) -> str:
    h, w, channels = header
    return f"{w}x{h} {'grey' if channels == 1 else 'in colour'}"
