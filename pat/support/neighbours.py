"""Nearest neighbours among points of a few dimensions."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

KD_TREE = 4
"""OpenCV's number of a single k-d tree, whose search is exact up to its `eps`."""


def nearest_points(
    points: Float[NDArray, "n d"], queries: Float[NDArray, "m d"], count: int, error: float = 0.0
) -> tuple[Int[NDArray, "m count"], Float[NDArray, "m count"]]:
    """Find the nearest points of each query by a k-d tree (OpenCV's FLANN).

    Args:
        points: points to search, finite, and rounded to float32, as are `queries`.
        queries: points whose neighbours are wanted.
        count: number of neighbours of each, from one to as many as there are points.
        error: share by which a neighbour may be farther away than the one it stands for; 0 searches exactly.

    Returns:
        For each query (m, count), nearest first: row numbers of `points`, int32, and Euclidean distances,
        float32.

    Raises:
        ValueError: for another `count`, points of other lengths, NaN and infinity.
    """
    points, queries = (np.ascontiguousarray(x, np.float32) for x in (points, queries))
    finite = all(np.isfinite(x).all() for x in (points, queries))
    if not (1 <= count <= len(points) and points.shape[1:] == queries.shape[1:] and finite):
        got = f"{count} neighbours of points {queries.shape} among {points.shape}"
        raise ValueError(f"{got}: give finite points of one length, and ask for one to as many as there are")
    if not len(queries):
        return np.zeros((0, count), np.int32), np.zeros((0, count), np.float32)
    tree = cv2.flann.Index(points, {"algorithm": KD_TREE, "leaf_max_size": 10})
    index, squared = tree.knnSearch(queries, count, params={"eps": error})
    return index, np.sqrt(squared)
