"""Pairs of real shapes in other textures: left is photographs, cut where a true disparity has its edges.

The shapes are those of stereo pairs of known disparity, at other sizes, depths and slopes; what they show is
of photographs, some of it hardly textured. Right is what is seen of them from there, each surface to a part
of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from pat.lab.data.pairs import Disparity, StereoPair

from .pairs import HW, MARGIN, MOST, Image, recoloured, window_of

STEP = 1.2
"""Neighbours whose disparities differ by more, pixels of the pair, are of two surfaces."""
SMALLEST, MOST_SURFACES = 60, 60
"""Pixels of the pair that a surface has; of more surfaces than these the largest are kept."""
SAMPLES, GRID = 12, 8
"""Samples of a pixel of left, and those of right that they are put into."""


def shape_pair(pair: StereoPair, photos: Sequence[Path], seed: int) -> StereoPair:
    """A pair of the shapes of one with true disparity; all that is drawn depends on the seed alone.

    Raises ValueError for a photograph that is no image, and for a pair without disparity.
    """
    if pair.disparity is None:
        raise ValueError(f"{pair.name}: its disparity is not known")
    rng = np.random.default_rng(seed)
    which, disparity = _window(*_surfaces(pair.disparity), rng)
    disparity = _moved(disparity, which, rng)
    pictures = [window_of(photos[int(rng.integers(len(photos)))], rng) for _ in range(rng.integers(1, 5))]
    textures = np.stack([_texture(pictures[rng.integers(len(pictures))], rng) for _ in disparity])
    hidden = window_of(photos[int(rng.integers(len(photos)))], rng)
    shares = np.stack(
        [cv2.GaussianBlur((which == i).astype(np.float32), (3, 3), 0.55) for i in range(len(disparity))]
    )
    left = np.einsum("nyx,nyxc->yxc", shares / shares.sum(0), textures)
    right = seen_from_right(which, disparity, textures, hidden)
    one, two = (torch.from_numpy(x.clip(0, 1).astype(np.float32)).movedim(-1, 0) for x in (left, right))
    if rng.random() < 0.5:
        one, two = recoloured([one, two], rng)
    truth = torch.from_numpy(np.take_along_axis(disparity, which[None], 0)[0])
    true_disparity = Disparity(truth, torch.ones_like(truth, dtype=torch.bool))
    return StereoPair(f"{pair.name} in other textures {seed}", one, two, MOST + MARGIN, true_disparity)


def _surfaces(disparity: Disparity) -> tuple[NDArray, NDArray]:
    """Which surface each pixel is of, and its disparity; what is not known is as the farther of its row."""
    value = np.where(disparity.valid, disparity.value, np.nan).astype(np.float32)
    before, after = (_last_known(value[:, ::way])[:, ::way] for way in (1, -1))
    value = np.where(np.isnan(value), np.fmin(before, after), value)
    value = ndimage.median_filter(np.where(np.isnan(value), np.nanmedian(value), value), 5)
    edge = np.zeros(value.shape, bool)
    edge[:, 1:] |= np.abs(np.diff(value, axis=1)) > STEP
    edge[1:] |= np.abs(np.diff(value, axis=0)) > STEP
    labels, n = ndimage.label(~edge)
    count = np.bincount(labels.ravel(), minlength=n + 1)
    count[0] = 0
    least = max(SMALLEST, np.sort(count)[-MOST_SURFACES] if n > MOST_SURFACES else 0)
    return _nearest(labels, count[labels] >= least), value


def _last_known(x: NDArray) -> NDArray:
    """Each pixel's last value that is not NaN in its row."""
    last = np.maximum.accumulate(np.where(np.isnan(x), -1, np.arange(x.shape[1])), 1)
    return np.where(last >= 0, np.take_along_axis(x, last.clip(0), 1), np.nan)


def _nearest(x: NDArray, kept: NDArray) -> NDArray:
    """Each pixel's value, or that of the nearest one that is kept."""
    there = ndimage.distance_transform_edt(~kept, return_distances=False, return_indices=True)
    nearest: NDArray = x[tuple(there)]
    return nearest


def _window(labels: NDArray, value: NDArray, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """A random window of surfaces, larger than they were: which one each pixel is of (h, w), its outlines
    smooth; and disparity of each (n, h, w), beyond its outlines too."""
    scale = max(n / m for n, m in zip(HW, labels.shape)) * rng.uniform(1, 1.6)
    rows, columns = (
        ((np.arange(n) + rng.integers(0, int(np.ceil(m * scale)) - n + 1) + 0.5) / scale)
        .astype(int)
        .clip(0, m - 1)
        for n, m in zip(HW, labels.shape)
    )
    window = np.ix_(rows, columns)
    names, which = np.unique(labels[window], return_inverse=True)
    which, value = which.reshape(HW), value[window] * scale
    softness, surfaces, soft = rng.uniform(0.6, 1.5), [], []
    for i in range(len(names)):
        mask = (which == i).astype(np.uint8)
        soft.append(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), softness))
        inner = cv2.erode(mask, np.ones((5, 5), np.uint8), borderValue=(1,))
        beyond = _nearest(value, (inner if inner.sum() > 20 else mask) > 0)
        surfaces.append(cv2.GaussianBlur(cv2.medianBlur(beyond, 5), (0, 0), 3))
    return np.argmax(soft, 0), np.stack(surfaces)


def _moved(disparity: NDArray, which: NDArray, rng: np.random.Generator) -> NDArray:
    """Surfaces at other depths and slopes, some not in their order, within what there may be."""
    if rng.random() < 0.5:
        disparity = disparity * rng.uniform(0.5, 1.5)
    if rng.random() < 0.35:
        disparity = disparity + rng.normal(0, 5, (len(disparity), 1, 1))
    y, x = np.indices(HW)
    slopes = rng.normal(0, 0.015, 2)
    disparity = disparity + slopes[0] * (x - HW[1] / 2) + slopes[1] * (y - HW[0] / 2)
    visible = np.take_along_axis(disparity, which[None], 0)
    least = rng.uniform(2, 20)
    size = min(1, (MOST - least) / float(np.ptp(visible)))
    return (least + (disparity - visible.min()) * size).astype(np.float32)


def _texture(picture: Image, rng: np.random.Generator) -> Image:
    """A photograph moved, mirrored, lighter or darker; a quarter of them hardly textured."""
    if rng.random() < 0.6:
        picture = np.roll(picture, rng.integers(0, 200, 2), (0, 1))[:, :: rng.choice([1, -1])]
    picture = picture * np.float32(rng.uniform(0.6, 1.25)) + rng.normal(0, 0.03, 3).astype(np.float32)
    if rng.random() < 0.25:
        mean = picture.mean((0, 1))
        smooth = cv2.GaussianBlur(picture, (0, 0), 8) - mean
        picture = mean + smooth * rng.uniform(0.1, 0.5) + rng.normal(0, 0.004, picture.shape)
    return picture.clip(0, 1).astype(np.float32)


def seen_from_right(which: NDArray, disparity: NDArray, textures: NDArray, hidden: Image) -> Image:
    """Right: the nearest of the samples of left that come to a place; `hidden` where none do."""
    (h, w), fine = HW, HW[1] * SAMPLES
    x = (np.arange(fine) + 0.5) / SAMPLES - 0.5
    first = np.floor(x).clip(0, w - 2).astype(int)
    fraction = (x - first).clip(0, 1).astype(np.float32)
    of, row = which[:, np.rint(x).clip(0, w - 1).astype(int)], np.arange(h)[:, None]

    def sampled(planes: NDArray) -> NDArray:
        one, two = planes[of, row, first], planes[of, row, first + 1]
        share = fraction if one.ndim == 2 else fraction[:, None]
        return one + share * (two - one)

    near, colours = sampled(disparity), sampled(textures)
    column = np.floor((x - near + 0.5) * GRID).astype(int)
    on = (column >= 0) & (column < w * GRID)
    order = np.argsort(near[on], kind="stable")
    drawn: NDArray[np.int64] = np.full(h * w * GRID, -1)
    drawn[(row * w * GRID + column)[on][order]] = np.flatnonzero(on)[order]
    drawn = drawn.reshape(h, w * GRID)
    last_drawn = np.maximum.accumulate(np.where(drawn >= 0, np.arange(w * GRID), -1), 1)
    close = (last_drawn >= 0) & (np.arange(w * GRID) - last_drawn <= 2)  # slopes stretch
    drawn = np.where(close, np.take_along_axis(drawn, last_drawn.clip(0), 1), -1)
    image = np.where(close[..., None], colours.reshape(-1, 3)[drawn], np.repeat(hidden, GRID, 1))
    return image.reshape(h, w, GRID, 3).mean(2).astype(np.float32)
