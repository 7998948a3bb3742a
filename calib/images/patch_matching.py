"""Matched points moved to where small patches around them fit best: least-squares matching (Gruen 1985).

A patch of alpha is laid over beta by an affine map, brightness and contrast free, and moved by Gauss-Newton until what
is left is least. Features are good to half a pixel and worse where they are large; patches to about a tenth.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

HALF = 7
"""Patches are 15 x 15 pixels, of the coarser image."""
STEPS = 12
SETTLED = 0.01
"""Steps below this, in pixels, end the search for nine points in ten."""
ALIKE = 0.85
"""Correlation that patches must reach to be believed."""
NEAR = 2.0
"""Patches that end farther away than this, in pixels, have found something else."""

Array = np.ndarray


class Sharpened(NamedTuple):
    """Places in beta, and their deviation along the worse axis, pixels; inf where nothing fitted."""

    y: Float[np.ndarray, "n 2"]
    deviation: Float[np.ndarray, " n"]


class Patches(NamedTuple):
    """Patches of alpha and their values there; places in beta; maps (pixels of beta a step in the patch)."""

    values: Float[np.ndarray, "n p"]
    y: Float[np.ndarray, "n 2"]
    A: Float[np.ndarray, "n 2 2"]


def sharpened(
    alpha: UInt8[np.ndarray, "h w"],
    beta: UInt8[np.ndarray, "hb wb"],
    x: Float[np.ndarray, "n 2"],
    y: Float[np.ndarray, "n 2"],
    beta_from_alpha: Float[np.ndarray, "n 2 2"],
) -> Sharpened:
    """Better `y` for points `x` of alpha, from rough maps between their neighbourhoods; as it is where none fits."""
    if not len(x):
        return Sharpened(y, np.zeros(0))
    step = np.maximum(1.0, 1 / np.sqrt(np.abs(np.linalg.det(beta_from_alpha))))[:, None, None]
    row = np.arange(-HALF, HALF + 1.0)
    around = np.stack(np.meshgrid(row, row), -1).reshape(-1, 2)
    weight = np.exp(-(around**2).sum(1) / (2 * (HALF / 1.6) ** 2))
    image = beta.astype(np.float32)
    slopes = [cv2.Sobel(image, cv2.CV_32F, 1 - k, k, ksize=3) / 8 for k in (0, 1)]
    found = Patches(_sampled(alpha.astype(np.float32), x[:, None] + step * around), y, step * beta_from_alpha)
    for _ in range(STEPS):
        found, alike, moved, deviation = _moved(found, [image, *slopes], around, weight)
        if np.quantile(moved, 0.9) < SETTLED:
            break
    good = (alike > ALIKE) & (np.linalg.norm(found.y - y, axis=1) < NEAR)
    return Sharpened(np.where(good[:, None], found.y, y), np.where(good, deviation, np.inf))


def _sampled(image: Array, x: Array) -> Array:
    x = x.astype(np.float32)
    return cv2.remap(image, x[..., 0], x[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT).astype(np.float64)


def _moved(found: Patches, images: list[Array], around: Array, weights: Array) -> tuple[Patches, Array, Array, Array]:
    """The patches after a step, how alike they were before it (correlation), how far they moved; and how well their
    places are known, by what is left (the worse axis's deviation, pixels)."""
    weight = weights / weights.sum()
    at = found.y[:, None] + around @ found.A.swapaxes(1, 2)
    seen, across, down = (_sampled(p, at) for p in images)
    seen, wanted = (v - (v @ weight)[:, None] for v in (seen, found.values))
    both, power, own = ((a * b) @ weight for a, b in ((seen, wanted), (seen, seen), (wanted, wanted)))
    gain = (both / (power + 1e-6))[:, None]
    J = np.stack([across, down, *(slope * part for slope in (across, down) for part in around.T)], -1)
    J = gain[..., None] * (J - np.einsum("p,npi->ni", weight, J)[:, None])
    turned = (weight[:, None] * J).swapaxes(1, 2)
    H = turned @ J
    H += np.eye(6) * (1e-3 * np.trace(H, axis1=1, axis2=2)[:, None, None] / 6 + 1e-9)
    step = np.linalg.solve(H, turned @ (wanted - gain * seen)[..., None])[..., 0]
    shift, turn = step[:, :2].clip(-0.5, 0.5), step[:, 2:].reshape(-1, 2, 2).clip(-0.1, 0.1)
    alike = both / np.sqrt(power * own + 1e-9)
    left = ((wanted - gain * seen) ** 2) @ weight
    known = np.linalg.inv(H)[:, :2, :2] * (left / weights.sum())[:, None, None]
    deviation = np.sqrt(np.linalg.eigvalsh(known)[:, 1])
    return found._replace(y=found.y + shift, A=found.A + turn), alike, np.linalg.norm(shift, axis=1), deviation
