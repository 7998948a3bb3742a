"""Colour of unseen pixels by example: that of the seen pixels most alike in brightness, texture and place.

Nearest neighbours among alpha's own seen pixels (Welsh et al. 2002 colour a grey image so, by another one).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..support.settings import size, tuned

Plane = NDArray[np.float32]


@dataclass(frozen=True)
class ExampleSettings:
    """Settings of the search for examples. Lengths are pixels of alpha."""

    neighbours: int = tuned(16, "Middlebury, tune half, and plain scenes: examples of a pixel")
    scales: tuple[float, ...] = tuned(
        (12.0, 10.0, 5.0, 12.0, 8.0),
        "Strong classical line, nine tune pairs: weights of brightness, its means and its deviations",
    )
    radii: tuple[int, int] = size((2, 6), "Radii of the windows of means and deviations")
    place: tuple[float, float] = tuned(
        (140.0, 90.0), "Strong classical line, nine tune pairs: distances across and down that count as one"
    )
    soft: float = tuned(0.15, "Strong classical line: distance added to the nearest in the weights' width")
    seen: float = size(0.5, "Weight from which a pixel counts as seen")
    sources: int = size(60_000, "Seen pixels searched at most")
    error: float = size(0.5, "Relative error of the approximate nearest-neighbour search")


SETTINGS = ExampleSettings()


def by_examples(
    colour: Float[NDArray, "c h w"], alpha: Float[NDArray, "h w"], weight: Float[NDArray, "h w"]
) -> Float[NDArray, "c h w"]:
    """Colour with the pixels of low weight replaced by the mean of their nearest seen pixels.

    `weight` (0 to 1) is the probability that a pixel's colour is its own. Every second pixel in each
    direction is looked up, and the mean is interpolated between them. Where fewer pixels are seen than a mean
    takes, colour is returned as it is.
    """
    seen = weight > SETTINGS.seen
    sources = np.zeros_like(seen)
    step = max(2, int(np.ceil(np.sqrt(seen.sum() / SETTINGS.sources))))
    sources[::step, ::step] = seen[::step, ::step]
    asked = np.zeros_like(seen)
    asked[::2, ::2] = cv2.dilate((~seen).astype(np.uint8), np.ones((3, 3), np.uint8))[::2, ::2] > 0
    if np.count_nonzero(sources) < SETTINGS.neighbours or not asked.any():
        return colour
    features = _features(alpha)
    tree = cKDTree(features[:, sources].T, compact_nodes=False, balanced_tree=False)
    distance, index = tree.query(features[:, asked].T, k=SETTINGS.neighbours, eps=SETTINGS.error)
    share = np.exp(-np.square(distance / (distance[:, :1] + SETTINGS.soft))) * weight[sources][index]
    share = (share / share.sum(1, keepdims=True)).astype(np.float32)
    found = np.zeros((len(colour) + 1, *seen.shape), np.float32)
    found[:-1, asked] = np.einsum("cnk,nk->cn", colour[:, sources][:, index], share)
    found[-1, asked] = 1
    *sums, total = (cv2.GaussianBlur(plane, (0, 0), 1.0) for plane in found)
    return np.where(seen, colour, np.stack(sums) / np.maximum(total, 1e-6))


def _features(alpha: Plane) -> Float[NDArray, "7 h w"]:
    """Brightness, its mean and standard deviation in windows, and place, scaled so that distances compare."""
    alpha = np.ascontiguousarray(alpha, np.float32)
    means = [cv2.boxFilter(alpha, -1, (2 * r + 1,) * 2) for r in SETTINGS.radii]
    squares = [cv2.boxFilter(alpha * alpha, -1, (2 * r + 1,) * 2) for r in SETTINGS.radii]
    deviations = [np.sqrt(np.maximum(s - m * m, 0)) for s, m in zip(squares, means)]
    y, x = np.indices(alpha.shape, dtype=np.float32)
    planes = [scale * plane for scale, plane in zip(SETTINGS.scales, (alpha, *means, *deviations))]
    return np.stack([*planes, x / SETTINGS.place[0], y / SETTINGS.place[1]])
