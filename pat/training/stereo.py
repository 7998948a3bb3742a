"""Stereo pairs as training samples: a random window of an image as alpha and truth, of the other as beta.

Their depth is not known, so the loss is on the image alone. Their cameras are assumed: rectified, a metre
apart, with the pair's range of disparities.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image, UnidentifiedImageError
from torch import Generator, Tensor

from arraygeom.camera import Camera, intrinsics
from arraygeom.pixels import HW
from arraygeom.pose import Pose
from pat.data.pairs import PairFiles, pair_files
from pat.data.windows import reduced
from pat.media.images import read_image
from pat.synthesis.layered import ArrayBatch
from pat.synthesis.rigs import below, one_of

from .scenes import ACTIVE, Crops, active_items, chosen

REDUCED = 2
"""The largest reduction of a window: images found online are often less sharp than their pixels."""


class PairCrops(Crops):
    """Random windows of the rectified stereo pairs in folders.

    Raises ValueError for a folder without pairs, for a pair whose images differ in size, are not in colour or
    are smaller than `hw`; when it is read, for an image that cannot be read.
    """

    def _find(self, roots: Sequence[Path], choose: Callable[[int], bool]) -> None:
        found = [pair for root in roots for pair in pair_files(root)]
        self.pairs = chosen(found, choose, f"stereo pairs of {', '.join(map(str, roots))}")
        for pair in self.pairs:
            check_pair(pair, self.hw)
        self._images = lru_cache(ACTIVE)(
            lambda i: (read_image(self.pairs[i].left), read_image(self.pairs[i].right))
        )

    def sample(self, batch: int, generator: Generator, *, number: int, betas: int = 1) -> ArrayBatch:
        """Windows of group `number`, of the pairs active then. Several betas are of the same camera.

        There is no `depth`.
        """
        active = active_items(number, len(self.pairs), self.seed)
        sizes = self.beta_sizes(betas, generator)
        drawn = [self._window(one_of(active, generator), generator) for _ in range(batch)]
        alpha, beta = (torch.stack(images) for images in list(zip(*drawn))[:2])
        side, disparity = (torch.tensor(numbers, dtype=torch.float64) for numbers in list(zip(*drawn))[2:])
        chosen_images = [alpha, *(reduced(beta, size).clamp(max=1) for size in sizes)]
        return assumed_cameras(chosen_images, side, disparity, self.device)

    def _window(self, i: int, g: Generator) -> tuple[Tensor, Tensor, float, float]:
        """Alpha, beta, 1 where alpha is left and -1 where it is right, and the largest disparity."""
        images, (h, w) = self._images(i), self.hw
        hw = images[0].shape[1:]
        times = 1 + below(min(REDUCED, hw[0] // h, hw[1] // w), g)
        top, left = (below(whole - times * n + 1, g) for whole, n in zip(hw, self.hw))
        cut = [p[:, top : top + times * h, left : left + times * w] for p in images]
        small = [reduced(p[None], self.hw)[0].clamp(max=1) for p in cut]
        far = self.pairs[i].max_disparity / times
        return (small[0], small[1], 1.0, far) if below(2, g) else (small[1], small[0], -1.0, far)


def assumed_cameras(
    images: list[Tensor], side: Float[Tensor, " b"], disparity: Float[Tensor, " b"], device: str
) -> ArrayBatch:
    """The images, alpha first, cameras a metre apart that put the nearest points `disparity` pixels apart."""
    batch, _, h, w = images[0].shape
    K = intrinsics(float(w), (h, w)).expand(batch, 3, 3)
    t = torch.zeros(batch, 3, dtype=torch.float64)
    alpha = Camera(
        K=K, cam_from_world=Pose(torch.eye(3, dtype=torch.float64).expand(batch, 3, 3), t), hw=(h, w)
    )
    beta = alpha.replace(cam_from_world=Pose(alpha.R, torch.stack([-side, t[:, 1], t[:, 2]], -1)))
    betas = [beta.resize((p.shape[-2], p.shape[-1])) for p in images[1:]]
    cameras = [camera.to(device, torch.float32) for camera in (alpha, *betas)]
    near = w / disparity
    bounds = torch.stack([near, torch.full_like(near, torch.inf)], -1).to(device, torch.float32)
    return ArrayBatch([p.to(device) for p in images], [], cameras, bounds)


def check_pair(pair: PairFiles, hw: HW) -> None:
    """Raises ValueError unless both images are in colour, of one size, and at least `hw`."""
    left, right = _header(pair.left), _header(pair.right)
    if left != right:
        raise ValueError(
            f"{pair.left} is {_described(left)} and {pair.right.name} "
            f"{_described(right)}: pairs must be alike"
        )
    if left[2] == 1:
        raise ValueError(f"{pair.left} is grey: pairs to train on must be in colour")
    if left[0] < hw[0] or left[1] < hw[1]:
        raise ValueError(
            f"{pair.left} is {_described(left)}, smaller than the samples, {hw[1]}x{hw[0]}: lower `hw`"
        )


def _header(file: Path) -> tuple[int, int, int]:
    """Height, width and channels (1 or 3) of an image, without reading it whole."""
    try:
        with Image.open(file) as image:
            return image.height, image.width, 1 if image.mode[0] in "1LIF" else 3
    except (OSError, UnidentifiedImageError):
        raise ValueError(
            f"{file}: not an image that can be read: give a whole PNG, TIFF or JPEG file"
        ) from None


def _described(header: tuple[int, int, int]) -> str:
    h, w, channels = header
    return f"{w}x{h} {'grey' if channels == 1 else 'in colour'}"
