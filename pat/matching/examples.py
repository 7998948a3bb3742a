"""Colour of unseen pixels by example: that of the seen pixels most similar in brightness, texture and place.

Nearest neighbours among alpha's own seen pixels (Welsh et al. 2002 colour a grey image so, by another one).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from ..support.neighbours import nearest_points
from ..support.settings import size, tuned

Plane = NDArray[np.float32]


@dataclass(frozen=True)
class ExampleSettings:
    """Settings of the nearest-neighbour search that fills in colours; lengths are pixels of alpha.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    neighbours: int = size(5, "Examples of a pixel; half or twice as many do as well")
    radii: tuple[int, int] = size((2, 6), "Radii of the windows of means and deviations")
    place: tuple[float, float] = tuned(
        (1200.0, 1800.0),
        "Middlebury, tune half: pixels whose distance counts as much as black beside white, across "
        "the searched segments and along them: what is occluded is long across",
    )
    seen: float = size(0.5, "Weight above which a pixel counts as seen")
    sources: int = size(60_000, "Seen pixels searched at most")
    error: float = size(0.5, "Relative error of the approximate nearest-neighbour search")


SETTINGS = ExampleSettings()
EVERY = (slice(None, None, 2),) * 2
"""Size: every second pixel is searched for."""


def by_examples(
    colour: Float[NDArray, "c h w"],
    alpha: Float[NDArray, "h w"],
    weight: Float[NDArray, "h w"],
    directions: Float[NDArray, "2 2"],
) -> Float[NDArray, "c h w"]:
    """Replace the colour of pixels of low weight by a weighted mean of the seen pixels most similar to them.

    Every second pixel in each direction is compared with such pixels, and pixels between them are
    interpolated.

    Args:
        colour: bands of each pixel.
        alpha: brightness, in which pixels are compared together with their positions.
        weight: weight of each pixel's colour, 0 to 1; a pixel counts as seen above a half.
        directions: mean outer product of the unit vectors (x, y) along the segments that were searched;
            examples count as nearer along these.

    Returns:
        Colour at all pixels; seen ones keep theirs. The array `colour` itself if all are seen, or fewer of
        every second pixel than a mean takes.
    """
    seen = weight > SETTINGS.seen
    near = cv2.dilate((~seen).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    asked, seen_there = near[EVERY], seen[EVERY]
    step = max(1, int(np.ceil(np.sqrt(np.count_nonzero(seen_there) / SETTINGS.sources))))
    sources = np.zeros_like(seen_there)
    sources[::step, ::step] = seen_there[::step, ::step]
    if np.count_nonzero(sources) < SETTINGS.neighbours or not asked.any():
        return colour
    features = [(plane[sources], plane[asked]) for plane in _features(alpha, directions)]
    known, wanted = (np.stack(planes, 1) for planes in zip(*features))
    index, _ = nearest_points(known, wanted, SETTINGS.neighbours, SETTINGS.error)
    share = weight[EVERY][sources][index]
    share = (share / share.sum(1, keepdims=True)).astype(np.float32)
    out = np.empty_like(colour)
    for own, filled in zip(colour, out):
        plane = np.where(seen, own, 0)[EVERY]
        plane[asked] = np.einsum("nk,nk->n", plane[sources][index], share)
        filled[:] = np.where(seen, own, _between(plane, (alpha.shape[0], alpha.shape[1])))
    return out


def _between(plane: Plane, hw: tuple[int, int]) -> Plane:
    """Enlarge a plane of every second pixel, from the first, to all pixels, by linear interpolation."""
    back = np.array([[0.5, 0, 0], [0, 0.5, 0]], np.float32)
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    between: Plane = cv2.warpAffine(plane, back, (hw[1], hw[0]), flags=how, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[assignment]
    return between


def _features(alpha: Plane, directions: Float[NDArray, "2 2"]) -> Iterator[Plane]:
    """Yield brightness, its means and standard deviations in windows, and place, of every second pixel.

    They are scaled so that distances compare.
    """
    alpha = np.ascontiguousarray(alpha, np.float32)
    yield alpha[EVERY]
    for radius in SETTINGS.radii:
        side = (2 * radius + 1,) * 2
        mean, square = cv2.boxFilter(alpha, -1, side), cv2.boxFilter(alpha * alpha, -1, side)
        yield mean[EVERY]
        yield np.sqrt(np.maximum(square - mean * mean, 0))[EVERY]
    across, along = (1 / pixels**2 for pixels in SETTINGS.place)
    metric = across * np.eye(2) + (along - across) * directions
    rows, columns = 2 * np.indices(alpha[EVERY].shape, dtype=np.float32)
    for x, y in np.linalg.cholesky(metric).T.astype(np.float32):
        yield x * columns + y * rows
