"""Refinement of matched points by least-squares matching of small patches (Gruen 1985).

A patch of alpha is mapped to beta by an affine map, with free brightness and contrast, that Gauss-Newton
refines. Features are accurate to half a pixel, less where they are large; patches to about a tenth.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

HALF_PATCH = 7
"""Patches are 15 x 15 pixels of the coarser image."""
STEPS = 12
CONVERGED = 0.01
"""Motion in pixels of nine points in ten below which the iteration ends."""
LEAST_CORRELATION = 0.85
"""Least correlation of patches that are accepted."""
LARGEST_SHIFT = 2.0
"""Largest shift of a patch, pixels; those that move farther are rejected as false matches."""
MOST_ROWS = 2**15 - 2
"""Largest number of rows that OpenCV resamples at once."""

Array = np.ndarray


class RefinedPoints(NamedTuple):
    """Refined positions in beta.

    Attributes:
        y: positions (x, y) in beta, pixels.
        deviation: standard deviation along the worse axis, pixels; inf where rejected.
    """

    y: Float[np.ndarray, "n 2"]
    deviation: Float[np.ndarray, " n"]


class PatchWarps(NamedTuple):
    """Patches of alpha with their affine maps into beta.

    Attributes:
        values: samples of alpha's patches, one row a patch.
        y: positions (x, y) of the patches' middles in beta, pixels.
        A: affine maps, pixels of beta per step in the patch.
    """

    values: Float[np.ndarray, "n p"]
    y: Float[np.ndarray, "n 2"]
    A: Float[np.ndarray, "n 2 2"]


def refine_points(
    alpha: UInt8[np.ndarray, "h w"],
    beta: UInt8[np.ndarray, "hb wb"],
    x: Float[np.ndarray, "n 2"],
    y: Float[np.ndarray, "n 2"],
    beta_from_alpha: Float[np.ndarray, "n 2 2"],
) -> RefinedPoints:
    """Refine positions in beta of points of alpha by least-squares matching of patches.

    A position is rejected whose patches correlate too little in the end (`LEAST_CORRELATION`), or that moved
    too far (`LARGEST_SHIFT`).

    Args:
        alpha: bytes (H, W).
        beta: bytes (H, W).
        x: points (x, y) of alpha, pixels, finite.
        y: rough positions in beta, pixels, finite.
        beta_from_alpha: rough affine maps between neighbourhoods of the points, invertible.

    Returns:
        The positions, unchanged where rejected, with their deviations, infinite where rejected.
    """
    if not len(x):
        return RefinedPoints(y, np.zeros(0))
    step = np.maximum(1.0, 1 / np.sqrt(np.abs(np.linalg.det(beta_from_alpha))))[:, None, None]
    row = np.arange(-HALF_PATCH, HALF_PATCH + 1.0)
    around = np.stack(np.meshgrid(row, row), -1).reshape(-1, 2)
    weight = np.exp(-(around**2).sum(1) / (2 * (HALF_PATCH / 1.6) ** 2))
    image = beta.astype(np.float32)
    slopes = [cv2.Sobel(image, cv2.CV_32F, 1 - k, k, ksize=3) / 8 for k in (0, 1)]
    warps = PatchWarps(
        _sampled(alpha.astype(np.float32), x[:, None] + step * around), y, step * beta_from_alpha
    )
    for _ in range(STEPS):
        warps, correlation, moved, deviation = _step(warps, [image, *slopes], around, weight)
        if np.quantile(moved, 0.9) < CONVERGED:
            break
    good = (correlation > LEAST_CORRELATION) & (np.linalg.norm(warps.y - y, axis=1) < LARGEST_SHIFT)
    return RefinedPoints(np.where(good[:, None], warps.y, y), np.where(good, deviation, np.inf))


def _sampled(image: Array, x: Array) -> Array:
    def of_rows(x: Array) -> Array:
        return cv2.remap(image, x[..., 0], x[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)

    parts = np.array_split(x.astype(np.float32), len(x) // MOST_ROWS + 1)
    return np.concatenate([of_rows(part) for part in parts]).astype(np.float64)


def _step(
    warps: PatchWarps, images: list[Array], around: Array, weights: Array
) -> tuple[PatchWarps, Array, Array, Array]:
    """Take one step of all patches.

    Returns:
        The patches after it, their correlation before it, how far they moved, and the standard deviation of
        their positions by the residuals (worse axis, pixels).
    """
    weight = weights / weights.sum()
    positions = warps.y[:, None] + around @ warps.A.swapaxes(1, 2)
    sampled, across, down = (_sampled(p, positions) for p in images)
    sampled, wanted = (v - (v @ weight)[:, None] for v in (sampled, warps.values))
    both, power, wanted_power = (
        (a * b) @ weight for a, b in ((sampled, wanted), (sampled, sampled), (wanted, wanted))
    )
    gain = (both / (power + 1e-6))[:, None]
    J = np.stack([across, down, *(slope * offset for slope in (across, down) for offset in around.T)], -1)
    J = gain[..., None] * (J - (weight @ J)[:, None])
    weighted = (weight[:, None] * J).swapaxes(1, 2)
    H = weighted @ J
    H += np.eye(6) * (1e-3 * np.trace(H, axis1=1, axis2=2)[:, None, None] / 6 + 1e-9)
    step = np.linalg.solve(H, weighted @ (wanted - gain * sampled)[..., None])[..., 0]
    shift, affine = step[:, :2].clip(-0.5, 0.5), step[:, 2:].reshape(-1, 2, 2).clip(-0.1, 0.1)
    correlation = both / np.sqrt(power * wanted_power + 1e-9)
    left = ((wanted - gain * sampled) ** 2) @ weight
    covariance = np.linalg.inv(H)[:, :2, :2] * (left / weights.sum())[:, None, None]
    deviation = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1])
    moved = warps._replace(y=warps.y + shift, A=warps.A + affine)
    return moved, correlation, np.linalg.norm(shift, axis=1), deviation
