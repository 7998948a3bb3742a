"""Fundamental matrices through lenses: what F alone cannot fit where lenses bend lines.

Two radial terms for each camera straighten pixels about the picture's middle, x' = x (1 + k1 r^2 + k2 r^4) with r in
halves of the longer side, and F relates what is straight (Fitzgibbon 2001 has one term, as a quotient). Seven and four
numbers, fitted together to matched points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from arraygeom import epipolar_distance
from arraygeom.pixels import HW

from .matches import Matches, fit_fundamental
from .refine import LEAST_NOISE

ROUNDS = 3
"""The noise of points is estimated anew so often."""

Array = np.ndarray


@dataclass(frozen=True)
class BentLink:
    """F between straightened pixels, and what straightens those of alpha and of beta (k1, k2)."""

    F: Float[Tensor, "3 3"]
    terms: tuple[tuple[float, float], tuple[float, float]]
    sizes: tuple[HW, HW]

    def straight(self, matches: Matches) -> Matches:
        """The points as cameras without lenses would see them, pixels."""
        parts = zip(matches, self.sizes, self.terms)
        return Matches(*(torch.from_numpy(_straight(x.numpy(), hw, k)) for x, hw, k in parts))

    def line_distance(self, matches: Matches) -> Float[Tensor, " n"]:
        """How far points are from their lines, in beta's straightened pixels."""
        return epipolar_distance(self.F, *self.straight(matches)).abs()


def fit_bent(matches: Matches, alpha_hw: HW, beta_hw: HW) -> BentLink:
    """F and lenses of points matched in two pictures; wrong ones have little say (Cauchy's loss, Sampson distances).

    Raises ValueError if no F fits at all.
    """
    sizes = alpha_hw, beta_hw
    x, y = (_unit(p.numpy(), hw) for p, hw in zip(matches, sizes))
    A, B = (_from_unit(hw) for hw in sizes)
    U, S, Vh = np.linalg.svd(B.T @ fit_fundamental(matches).numpy() @ A)

    def unpacked(z: Array) -> tuple[Array, Array, Array]:
        left, right = (Rotation.from_rotvec(v).as_matrix() for v in (z[:3], z[3:6]))
        F = U @ left @ np.diag([1, S[1] / S[0] * (1 + z[6]), 0]) @ right @ Vh
        return F, _bent(x, z[7:9]), _bent(y, z[9:11])

    def residuals(z: Array) -> Array:
        return _sampson(*unpacked(z)) * max(beta_hw) / 2

    z = np.zeros(11)
    for _ in range(ROUNDS):
        scale = max(1.4826 * float(np.median(np.abs(residuals(z)))), LEAST_NOISE)
        z = least_squares(residuals, z, loss="cauchy", f_scale=scale).x
    F = np.linalg.inv(B).T @ unpacked(z)[0] @ np.linalg.inv(A)
    return BentLink(torch.from_numpy(F), ((float(z[7]), float(z[8])), (float(z[9]), float(z[10]))), sizes)


def _from_unit(hw: HW) -> Array:
    """Pixels from coordinates about the middle in halves of the longer side."""
    half = max(hw) / 2
    return np.array([[half, 0, (hw[1] - 1) / 2], [0, half, (hw[0] - 1) / 2], [0, 0, 1]])


def _unit(x: Array, hw: HW) -> Array:
    return (x - _from_unit(hw)[:2, 2]) / (max(hw) / 2)


def _bent(q: Array, k: Array) -> Array:
    square = (q**2).sum(1, keepdims=True)
    return q * (1 + k[0] * square + k[1] * square**2)


def _straight(x: Array, hw: HW, k: tuple[float, float]) -> Array:
    return _bent(_unit(x, hw), np.array(k)) * (max(hw) / 2) + _from_unit(hw)[:2, 2]


def _sampson(F: Array, x: Array, y: Array) -> Array:
    x, y = (np.c_[p, np.ones(len(p))] for p in (x, y))
    there, back = x @ F.T, y @ F
    return (y * there).sum(1) / np.sqrt((there[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
