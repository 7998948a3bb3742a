"""Matches between different bands where each point's place is roughly known: patches with the same structure.

Descriptors of features hardly match where leaves are dark in red and bright in near infrared. A patch's
correlation, squared, does not depend on the sign of its contrast, and the search is confined to a window
around the expected place.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from .matches import PointMatches, contrast_equalised

POINTS = 1500
"""Largest number of corners of alpha."""
SPACING = 8
"""Least distance of corners, pixels."""
PATCH = 20
"""Pixels from a patch's middle to its edge."""
LEAST_SIMILARITY = 0.4
"""Least squared correlation of patches that match."""
DISTINCT = 0.9
"""Largest squared correlation of a second peak, as a share of the first one's, like Lowe's ratio
test (2004)."""
PEAK = 3
"""Pixels around a peak that are part of it."""


def guided_matches(
    alpha: Float[Tensor, "_ h w"],
    beta: Float[Tensor, "_ hb wb"],
    beta_from_alpha: Float[Tensor, "3 3"],
    *,
    window: int,
    shown: tuple[Bool[Tensor, "h w"], Bool[Tensor, "hb wb"]],
) -> PointMatches:
    """Match corners of alpha with the most similar patch within `window` pixels of a homography's place in
    beta.

    Images must have the same scale and orientation. Correlation is squared, so that contrast may be inverted.

    Args:
        alpha: image (C, H, W) in 0..1.
        beta: image (C, H, W) in 0..1.
        beta_from_alpha: homography of pixels.
        window: largest distance in x and in y, pixels of beta.
        shown: masks of the pixels that each camera recorded, of the images' sizes, on the CPU; patches with
            other pixels are not used.

    Returns:
        Whole pixels of alpha and positions in beta to a fraction of a pixel, float64; possibly none.
    """
    alpha_image, beta_image = (contrast_equalised(image) for image in (alpha, beta))
    solid = np.ones((2 * PATCH + 1, 2 * PATCH + 1), np.uint8)
    mask, valid = (
        np.asarray(
            cv2.erode(
                recorded.numpy().astype(np.uint8), solid, borderType=cv2.BORDER_CONSTANT, borderValue=(0,)
            )
        )
        for recorded in shown
    )
    corners = cv2.goodFeaturesToTrack(alpha_image, POINTS, 1e-3, SPACING, mask=mask)
    x = np.zeros((0, 2)) if corners is None else corners[:, 0].astype(np.float64)
    predicted = cv2.perspectiveTransform(x[:, None], beta_from_alpha.double().numpy())[:, 0] if len(x) else x
    positions = [_best_match(alpha_image, beta_image, valid, *points, window) for points in zip(x, predicted)]
    matched = [i for i, y in enumerate(positions) if y is not None]
    y = np.array([positions[i] for i in matched], np.float64).reshape(-1, 2)
    return PointMatches(torch.from_numpy(x[matched].round()), torch.from_numpy(y))


def _best_match(
    alpha: NDArray[np.uint8],
    beta: NDArray[np.uint8],
    valid: NDArray[Any],
    x: NDArray[np.float64],
    predicted: NDArray[np.float64],
    window: int,
) -> NDArray[np.float64] | None:
    """Find the position in beta of the patch most similar to that around a pixel; None if none clearly is."""
    (column, row), (left, top) = (np.rint(p).astype(int) for p in (x, predicted - window))
    patch = alpha[row - PATCH : row + PATCH + 1, column - PATCH : column + PATCH + 1]
    first, last = np.maximum([left, top], PATCH), np.array([left, top]) + 2 * window
    last = np.minimum(last, np.array(beta.shape[::-1]) - 1 - PATCH)
    if (last - first < 2 * PEAK).any() or patch.std() < 1:
        return None
    searched = beta[first[1] - PATCH : last[1] + PATCH + 1, first[0] - PATCH : last[0] + PATCH + 1]
    similarity = np.nan_to_num(cv2.matchTemplate(searched, patch, cv2.TM_CCOEFF_NORMED)) ** 2
    similarity = similarity.astype(np.float32) * (valid[first[1] : last[1] + 1, first[0] : last[0] + 1] > 0)
    v, u = np.unravel_index(similarity.argmax(), similarity.shape)
    best = similarity[v, u]
    if best < LEAST_SIMILARITY or not (0 < u < similarity.shape[1] - 1 and 0 < v < similarity.shape[0] - 1):
        return None
    elsewhere = similarity.copy()
    elsewhere[max(v - PEAK, 0) : v + PEAK + 1, max(u - PEAK, 0) : u + PEAK + 1] = 0
    if elsewhere.max() > DISTINCT * best:
        return None
    du, dv = _vertex(similarity[v, u - 1 : u + 2]), _vertex(similarity[v - 1 : v + 2, u])
    return first + np.array([u + du, v + dv])


def _vertex(values: NDArray[np.float32]) -> float:
    """Return the offset from the middle of three values to their parabola's vertex, within half a step."""
    before, middle, after = map(float, values)
    curvature = before - 2 * middle + after
    return float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)) if curvature < 0 else 0.0
