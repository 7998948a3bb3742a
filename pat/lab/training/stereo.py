"""Stereo pairs as training samples: a random window of one image is alpha and truth, of the other beta.

True disparities are known. Cameras are assumed: rectified, a metre apart, with the pair's range of
disparities.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from PIL import Image
from torch import Generator, Tensor

from arraygeom import Camera, Pose, intrinsics
from arraygeom.pixels import HW
from pat.lab.data.pairs import PairFiles, pair_files
from pat.lab.data.windows import reduced
from pat.lab.synthesis.layered import ArrayBatch
from pat.lab.synthesis.rigs import below, one_of
from pat.media.images import read_image

from .scenes import ACTIVE, Crops, active_items, chosen

DISPARITIES = ("disp2.png", "disp6.png"), ("disp1.png", "disp5.png")
"""File names of the disparities of the left and the right image."""
REDUCED = 2
"""Largest reduction of a window: images found online are often less sharp than their pixels."""


class Pictures(NamedTuple):
    """Images and disparities of a pair.

    Attributes:
        left: left image (3, h, w) in 0..1.
        right: right image (3, h, w) in 0..1.
        disparities: disparities (h, w) of both images' pixels, pixels; 0 where unknown.
        largest: largest disparity that the files can hold, pixels.
    """

    left: Tensor
    right: Tensor
    disparities: tuple[Tensor, Tensor]
    largest: float


class MeasuredPairs(Crops):
    """Random windows of Middlebury's pairs, from the collections of 2003, 2005 and 2006; arguments as of
    `Crops`.

    Raises:
        FileNotFoundError: for a missing folder, or right image of Middlebury's.
        ValueError: for a folder without pairs, no chosen pair, and as `check`.
    """

    def _find(self, roots: Sequence[Path], choose: Callable[[int], bool]) -> None:
        pairs = [pair for root in roots for pair in pair_files(root)]
        self.pairs = chosen(pairs, choose, f"stereo pairs of {', '.join(map(str, roots))}")
        for pair in self.pairs:
            self.check(pair)
        self._pictures = lru_cache(ACTIVE)(lambda i: self.read(self.pairs[i]))

    def check(self, pair: PairFiles) -> None:
        """Check that both images are in colour, of one size, at least `hw`, and have disparities of a scale
        that is known by Middlebury's names of folders (`middlebury_pairs`).

        Raises:
            ValueError: naming the file, if not, or if an image is missing or none.
        """
        left, right = _header(pair.left), _header(pair.right)
        if left != right:
            raise ValueError(
                f"{pair.left} is {_described(left)} and {pair.right.name} "
                f"{_described(right)}: pairs must be alike"
            )
        if left[2] == 1:
            raise ValueError(f"{pair.left} is grey: pairs to train on must be in colour")
        h, w = self.hw
        if left[0] < h or left[1] < w:
            raise ValueError(f"{pair.left} is {_described(left)}, below samples of {w}x{h}: lower `hw`")
        disparity_files(pair)
        if pair.ground_truth is None:
            names = "name its folder, or the one above, as Middlebury's collection, such as 2006_third"
            raise ValueError(f"{pair.left}: the scale of the disparities is unknown: {names}")

    def read(self, pair: PairFiles) -> Pictures:
        """Read the images and disparities of a pair.

        Returns:
            Images in 0..1, and disparities in pixels.

        Raises:
            ValueError: for a file that cannot be read, and a missing file of disparities.
            FileNotFoundError: for a missing image.
        """
        left, right = (read_image(path)[0] * pair.max_disparity for path in disparity_files(pair))
        return Pictures(read_image(pair.left), read_image(pair.right), (left, right), pair.max_disparity)

    def sample(self, batch: int, generator: Generator, *, number: int, betas: int = 1) -> ArrayBatch:
        """Draw windows from the pairs that are active for group `number`.

        Several betas are of the same camera, at sizes of their own.

        Args:
            batch: number of windows.
            generator: random generator on the CPU.
            number: number of the group, which decides the active pairs.
            betas: number of betas of a window.

        Returns:
            A batch of `batch` samples, cameras as of `assumed_cameras`; depth is NaN where unknown.

        Raises:
            ValueError: for an image that cannot be read.
        """
        active = active_items(number, len(self.pairs), self.seed)
        sizes = self.beta_sizes(betas, generator)
        drawn = [self._window(one_of(active, generator), generator) for _ in range(batch)]
        images, disparities, sides, largest = zip(*drawn)
        alpha, beta = (torch.stack(same) for same in zip(*images))
        side, nearest = (torch.tensor(numbers, dtype=torch.float64) for numbers in (sides, largest))
        shown = [alpha, *(reduced(beta, size).clamp(max=1) for size in sizes)]
        cameras = assumed_cameras(shown, side, nearest, self.device)
        near, far = (depth_of(torch.stack(same), self.hw[1]) for same in zip(*disparities))
        depth = [near, *(coarser(far, size) for size in sizes)]
        return replace(cameras, depth=[d.to(self.device) for d in depth])

    def _window(self, i: int, g: Generator) -> tuple[list[Tensor], list[Tensor], float, float]:
        """Alpha and beta, their disparities, 1 if alpha is left and -1 if right, and the largest
        disparity."""
        pictures, (h, w) = self._pictures(i), self.hw
        whole = pictures.left.shape[1:]
        times = 1 + below(min(REDUCED, whole[0] // h, whole[1] // w), g)
        top, left = (below(n - times * m + 1, g) for n, m in zip(whole, self.hw))
        window = slice(top, top + times * h), slice(left, left + times * w)
        cut = [p[None, :, *window] for p in (pictures.left, pictures.right)]
        images = [reduced(p, self.hw)[0].clamp(max=1) for p in cut]
        disparities = [d[window][::times, ::times] / times for d in pictures.disparities]
        if below(2, g):
            return images, disparities, 1.0, pictures.largest / times
        return images[::-1], disparities[::-1], -1.0, pictures.largest / times


def disparity_files(pair: PairFiles) -> tuple[Path, Path]:
    """Find the disparity files (`DISPARITIES`) of the left and the right image beside the left image.

    Returns:
        Paths of left's and of right's disparity.

    Raises:
        ValueError: if one is missing.
    """
    for names in DISPARITIES:
        left, right = (pair.left.with_name(name) for name in names)
        if left.is_file() and right.is_file():
            return left, right
    raise ValueError(f"{pair.left.parent}: the true disparities are missing, disp1.png and disp5.png")


def depth_of(disparity: Float[Tensor, "b h w"], width: int) -> Float[Tensor, "b h w"]:
    """Convert disparity to depth for the cameras of `assumed_cameras`.

    Args:
        disparity: disparity in pixels; 0 where unknown.
        width: width of the image, pixels.

    Returns:
        Depth (b, h, w) in metres; NaN where the disparity is not above 0.
    """
    return torch.where(disparity > 0, width / disparity, torch.nan)


def coarser(depth: Float[Tensor, "b h w"], hw: HW) -> Float[Tensor, "b hs ws"]:
    """Pick depth at about the centres of coarser pixels, never a mean across an edge.

    Returns:
        Depth (b, *hw).
    """
    h, w = depth.shape[-2:]
    rows, columns = (((torch.arange(n) + 0.5) * whole / n).long() for n, whole in zip(hw, (h, w)))
    return depth[:, rows][:, :, columns]


def assumed_cameras(
    images: list[Tensor], side: Float[Tensor, " b"], disparity: Float[Tensor, " b"], device: str
) -> ArrayBatch:
    """Make a batch of images with cameras a metre apart, alpha first.

    Args:
        images: images (b, c, h, w) in 0..1, alpha's first; the betas are the other camera, resized.
        side: 1 where alpha is left, -1 where right.
        disparity: disparity of the nearest points in pixels, which sets the near bound; the far bound is
            infinity.
        device: device of the batch.

    Returns:
        The batch, alpha's frame as the world; its lists of depth and index are empty.
    """
    batch, _, h, w = images[0].shape
    K = intrinsics(float(w), (h, w)).expand(batch, 3, 3)
    t = torch.zeros(batch, 3, dtype=torch.float64)
    pose = Pose(torch.eye(3, dtype=torch.float64).expand(batch, 3, 3), t)
    alpha = Camera(K=K, cam_from_world=pose, hw=(h, w))
    beta = alpha.replace(cam_from_world=Pose(alpha.R, torch.stack([-side, t[:, 1], t[:, 2]], -1)))
    betas = [beta.resize((p.shape[-2], p.shape[-1])) for p in images[1:]]
    cameras = [camera.to(device, torch.float32) for camera in (alpha, *betas)]
    near = w / disparity
    bounds = torch.stack([near, torch.full_like(near, torch.inf)], -1).to(device, torch.float32)
    return ArrayBatch([p.to(device) for p in images], [], cameras, bounds)


def _header(file: Path) -> tuple[int, int, int]:
    """Height, width and channels (1 or 3) of an image, without decoding it."""
    try:
        with Image.open(file) as image:
            return image.height, image.width, 1 if image.mode[0] in "1LIF" else 3
    except (OSError, Image.DecompressionBombError) as error:
        raise ValueError(f"{file}: cannot be read ({error}): give a PNG, TIFF or JPEG") from None


def _described(header: tuple[int, int, int]) -> str:
    h, w, channels = header
    return f"{w}x{h} {'grey' if channels == 1 else 'in colour'}"
