"""Pairs to learn from: of single photographs, and real ones in other colours and sizes.

A photograph is cut into its regions, each a surface at a depth of its own. Edges of depth are then edges of
things, as in real pairs, and what is hidden is texture of photographs. Left is the photograph itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from skimage.segmentation import felzenszwalb
from torch import Tensor
from torch.nn.functional import interpolate

from pat.lab.data.pairs import Disparity, StereoPair
from pat.media.images import read_image

Image = NDArray[np.float32]
HW = (320, 448)
MOST = 80.0
"""Disparity, pixels."""
MARGIN = 15.0
"""Pixels by which the disparities that are searched exceed those there are."""


def mirrored(pair: StereoPair, root: Path | None = None) -> StereoPair:
    """The mirror image, right as alpha, with Middlebury's true disparity of that."""
    left, right = pair.right.flip(-1), pair.left.flip(-1)
    if root is None or pair.max_disparity is None:
        return replace(pair, left=left, right=right)
    stated = read_image(root / pair.name / "disp5.png")[0].flip(-1) * pair.max_disparity
    return replace(pair, left=left, right=right, disparity=Disparity(stated, stated > 0))


def varied_pair(pair: StereoPair, seed: int) -> StereoPair:
    """A pair of another size and in other colours: bands exchanged, mixed, brighter and darker."""
    rng = np.random.default_rng(seed)
    size, wide = pair.left.shape[1:], pair.left.shape[2] > 1.5 * HW[1]
    scale = rng.uniform(0.6, 1.0) if wide else rng.uniform(0.9, 1.45)
    height, width = (max(round(n * scale), least) // 8 * 8 for n, least in zip(size, HW))

    def larger(image: Tensor, mode: str = "bicubic") -> Tensor:
        smooth = {"antialias": True} if mode == "bicubic" else {}
        return interpolate(image[None], (height, width), mode=mode, **smooth)[0]

    left, right = recoloured([larger(image).clamp(0, 1) for image in (pair.left, pair.right)], rng)
    most, truth = pair.max_disparity, None
    if pair.disparity is not None:
        value, valid = (larger(plane[None].float(), "nearest-exact")[0] for plane in pair.disparity)
        truth = Disparity(value * width / size[1], valid > 0)
        most = float(pair.disparity.value.max())
    assert most is not None
    return StereoPair(f"{pair.name} {seed}", left, right, most * width / size[1] + MARGIN, truth)


def recoloured(images: Sequence[Float[Tensor, "3 h w"]], rng: np.random.Generator) -> list[Tensor]:
    """Images with their bands exchanged, other curves, and mixed; 0..1."""
    drawn = rng.permutation(3), rng.uniform(0.65, 1.5, (3, 1, 1)), np.eye(3) + rng.normal(0, 0.25, (3, 3))
    bands, curve, mix = map(torch.from_numpy, drawn)
    changed = [x[bands].clamp(min=1e-4) ** curve.float() for x in images]
    changed = [torch.einsum("ij,jyx->iyx", mix.float(), x) for x in changed]
    of_all = torch.cat([x.flatten(1)[:, ::7] for x in changed], 1)
    low, high = torch.quantile(of_all, torch.tensor([0.002, 0.998]), dim=1)[:, :, None, None]
    low = low.clamp(max=0)
    return [((x - low) / (high - low).clamp(min=1)).clamp(0, 1) for x in changed]


def photo_pair(path: Path, behind: Path, seed: int) -> StereoPair:
    """A pair of one photograph, `behind` what only right sees; all that is drawn depends on the seed alone.

    Raises ValueError for a file that is no image.
    """
    rng = np.random.default_rng(seed)
    left, other = (window_of(file, rng) for file in (path, behind))
    if rng.random() < 0.4:
        left = _with_objects(left, other[::-1, ::-1], rng)
    regions = felzenszwalb(
        left, scale=rng.uniform(100, 1200), sigma=0.8, min_size=int(rng.uniform(150, 2500))
    )
    planes = _planes(regions, rng)
    right = _seen_from_right(left, other, regions, planes)
    one, two = (torch.from_numpy(np.ascontiguousarray(x)).movedim(-1, 0) for x in (left, right))
    (base, sx, sy), (y, x) = planes[regions, :3].transpose(2, 0, 1), np.indices(regions.shape)
    truth = torch.from_numpy((base + sx * x + sy * y).astype(np.float32))
    true_disparity = Disparity(truth, torch.ones_like(truth, dtype=torch.bool))
    return StereoPair(f"{path.stem} {seed}", one, two, MOST + MARGIN, true_disparity)


def window_of(path: Path, rng: np.random.Generator) -> Image:
    """A random window of a photograph, red, green, blue, at a random size; mirrored half of the time."""
    read = cv2.imread(str(path))
    if read is None:
        raise ValueError(f"{path}: not an image")
    image = read[..., ::-1]
    h, w = image.shape[:2]
    least = max(HW[0] / h, HW[1] / w)
    scale = least * rng.uniform(1, max(1.02, min(2.5, 0.9 / least)))
    size = (max(round(w * scale), HW[1]), max(round(h * scale), HW[0]))
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    y, x = (int(rng.integers(0, a - b + 1)) for a, b in zip(image.shape[:2], HW))
    image = image[y : y + HW[0], x : x + HW[1]]
    image = (image[:, ::-1] if rng.random() < 0.5 else image).astype(np.float32)
    return image / np.float32(255)


def _with_objects(image: Image, texture: Image, rng: np.random.Generator) -> Image:
    """One to three things of another photograph's texture in front, their outlines smooth."""
    out: NDArray = image.copy()
    for _ in range(rng.integers(1, 4)):
        middle = rng.uniform(0, 1, 2) * HW
        angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
        radius = rng.uniform(15, 80) * np.ones(64)
        for k in range(2, 6):
            radius *= 1 + rng.uniform(0, 0.7 / k) * np.sin(k * angles + rng.uniform(0, 6))
        stretch = rng.uniform(0.4, 1.6)
        outline = np.stack(
            [middle[1] + radius * np.cos(angles) * stretch, middle[0] + radius * np.sin(angles)], 1
        )
        mask = np.zeros(HW, np.uint8)
        cv2.fillPoly(mask, [np.round(outline * 16).astype(np.int32)], (255,), cv2.LINE_AA, 4)
        share = cv2.GaussianBlur(mask, (3, 3), 0.6)[..., None] / np.float32(255)
        out = out * (1 - share) + np.roll(texture, rng.integers(0, 300, 2), (0, 1)) * share
    return out


def _planes(regions: NDArray, rng: np.random.Generator) -> NDArray:
    """(n, 3): disparity of each region's middle, and its slopes; the lower in the image, the nearer."""
    n = int(regions.max()) + 1
    ground, far = rng.uniform(0, 25), rng.uniform(6, 35)
    y, x = np.indices(regions.shape)
    count = np.bincount(regions.ravel(), minlength=n)
    middle_y, middle_x = (
        np.bincount(regions.ravel(), coordinate.ravel(), n) / count for coordinate in (y, x)
    )
    apart = np.where(rng.random(n) < 0.5, rng.normal(0, 1.5, n), rng.uniform(-12, 40, n))
    slopes = rng.normal(0, 0.02, (n, 2)) * (rng.random((n, 1)) < 0.5)
    disparity = np.clip(far + ground * middle_y / HW[0] + apart, 2, MOST)
    return np.stack([disparity - slopes[:, 0] * middle_x - slopes[:, 1] * middle_y, *slopes.T, disparity], 1)


def _seen_from_right(left: Image, other: Image, regions: NDArray, planes: NDArray) -> Image:
    """Right: each region moved by its plane, from far to near."""
    out: NDArray = other
    for i in np.argsort(planes[:, 3]):
        base, sx, sy, _ = planes[i]
        mask = cv2.dilate((regions == i).astype(np.uint8), np.ones((3, 3), np.uint8))
        mask = cv2.GaussianBlur(mask.astype(np.float32), (3, 3), 0.5)
        # right's x is left's less its disparity, base + sx x + sy y
        there = np.array([[1 - sx, -sy, -base], [0, 1, 0]], np.float64)
        share = cv2.warpAffine(mask, there, HW[::-1])[..., None]
        out = out * (1 - share) + cv2.warpAffine(left, there, HW[::-1], flags=cv2.INTER_CUBIC) * share
    return np.clip(out, 0, 1).astype(np.float32)
