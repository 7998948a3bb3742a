"""Stereo pairs, true disparity of both images, as training samples: images, depth, occlusion are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from pat.data.pairs import MIDDLEBURY, PairFiles, pair_files
from pat.data.windows import reduced
from pat.media.images import read_image
from pat.synthesis.layered import ArrayBatch
from pat.synthesis.rigs import below, one_of

from .scenes import active_items, chosen
from .stereo import ACTIVE, REDUCED, PairCrops, assumed_cameras, check_pair

COUNTERPART = {"disp2.png": "disp6.png", "disp1.png": "disp5.png"}
"""Files of the disparity of the right image, by those of the left."""


class MeasuredPairs(PairCrops):
    """Random windows of Middlebury's pairs in folders, of the collections of 2003, 2005 and 2006.

    Raises ValueError as `PairCrops`, and for a pair without the disparity of both images.
    """

    def _find(self, roots: Sequence[Path], choose: Callable[[int], bool]) -> None:
        found = [pair for root in roots for pair in pair_files(root)]
        self.pairs = chosen(found, choose, f"stereo pairs of {', '.join(map(str, roots))}")
        for pair in self.pairs:
            check_pair(pair, self.hw)
            disparity_files(pair)
        self._read = lru_cache(ACTIVE)(lambda i: read_measured(self.pairs[i]))

    def sample(self, batch: int, generator: Generator, *, number: int, betas: int = 1) -> ArrayBatch:
        """Windows of group `number`, of the pairs active then. Several betas are of the same camera.

        Depth is NaN where it is not known.
        """
        active = active_items(number, len(self.pairs), self.seed)
        sizes = self.beta_sizes(betas, generator)
        drawn = [self._cut(one_of(active, generator), generator) for _ in range(batch)]
        alpha, beta, near, far = (torch.stack(parts) for parts in list(zip(*drawn))[:4])
        side, largest = (torch.tensor(numbers, dtype=torch.float64) for numbers in list(zip(*drawn))[4:])
        images = [alpha, *(reduced(beta, size).clamp(max=1) for size in sizes)]
        batch_of = assumed_cameras(images, side, largest, self.device)
        w = self.hw[1]
        depth = [depth_of(near, w), *(coarser(depth_of(far, w), size) for size in sizes)]
        return replace(batch_of, depth=[d.to(self.device) for d in depth])

    def _cut(self, i: int, g: Generator) -> tuple[Tensor, Tensor, Tensor, Tensor, float, float]:
        """Alpha, beta, their disparities, 1 where alpha is left, -1 where right, the largest disparity."""
        pair, (h, w) = self._read(i), self.hw
        hw = pair.left.shape[1:]
        times = 1 + below(min(REDUCED, hw[0] // h, hw[1] // w), g)
        top, left = (below(whole - times * n + 1, g) for whole, n in zip(hw, self.hw))
        rows, columns = slice(top, top + times * h), slice(left, left + times * w)
        images = [
            reduced(p[None, :, rows, columns], self.hw)[0].clamp(max=1) for p in (pair.left, pair.right)
        ]
        cut = (
            d[rows, columns][::times, ::times] / times for d in (pair.left_disparity, pair.right_disparity)
        )
        near, far = cut
        largest = pair.largest / times
        if below(2, g):
            return images[0], images[1], near, far, 1.0, largest
        return images[1], images[0], far, near, -1.0, largest


class Measured(NamedTuple):
    """Two images (3, H, W), their disparities (H, W), pixels, 0 if not known, and the largest possible."""

    left: Tensor
    right: Tensor
    left_disparity: Tensor
    right_disparity: Tensor
    largest: float


def read_measured(pair: PairFiles) -> Measured:
    """The images and disparities of a pair."""
    left, right = (read_image(path)[0] * 255 for path in disparity_files(pair))
    scale = 255 / pair.max_disparity
    return Measured(
        read_image(pair.left), read_image(pair.right), left / scale, right / scale, pair.max_disparity
    )


def disparity_files(pair: PairFiles) -> tuple[Path, Path]:
    """Of the left and of the right image. Raises ValueError where one is missing."""
    for layout in MIDDLEBURY.values():
        files = [
            pair.left.with_name(name)
            for name in (layout.ground_truth, COUNTERPART.get(layout.ground_truth, "-"))
        ]
        if pair.left.name == layout.left and all(file.is_file() for file in files):
            return files[0], files[1]
    raise ValueError(
        f"{pair.left.parent}: wanted the true disparity of both images beside them, disp1.png and disp5.png"
    )


def depth_of(disparity: Float[Tensor, "b h w"], width: int) -> Float[Tensor, "b h w"]:
    """Of the cameras of `assumed_cameras`, in metres; NaN where the disparity is 0."""
    return torch.where(disparity > 0, width / disparity, torch.nan)


def coarser(depth: Float[Tensor, "b h w"], hw: tuple[int, int]) -> Float[Tensor, "b hs ws"]:
    """The depth at about the centres of larger pixels, never a mean across an edge."""
    h, w = depth.shape[-2:]
    rows, columns = (((torch.arange(n) + 0.5) * whole / n).long() for n, whole in zip(hw, (h, w)))
    return depth[:, rows][:, :, columns]
