"""How frames disagree about the parameters: the jackknife over blocks, to first order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .bundle import BundleProblem, Free, linearised, normal_equations

Array = np.ndarray


class Jackknife(NamedTuple):
    """By how the blocks disagree: covariances of the cameras' parameters and of the shapes.

    left_out: of the cameras' parameters by leaving out each block in turn. step: the shapes after a Gauss-Newton step.
    """

    covariance: Float[np.ndarray, "c c"]
    left_out: Float[np.ndarray, "c c"]
    shapes: Float[np.ndarray, "s s"]
    step: Float[np.ndarray, " s"]


def jackknife(problem: BundleProblem, free: Free, sigma: Mapping[str, float]) -> Jackknife:
    """The covariance of the free parameters by how the blocks (frames) disagree, to first order.

    It contains what blocks have in common beyond their points' noise: a bent board, blur, wrong exposure times. A plain
    jackknife's deviations are too large by 15 to 40 % with a dozen boards that determine all parameters between them;
    Bell and McCaffrey's (2002) correction removes that.
    """
    equations = normal_equations(problem, free, sigma)
    (b, c), shapes = equations.W.shape[:2], equations.shapes
    H, g, at = np.zeros((b, c, c)), np.zeros((b, c)), 0
    for name in problem.cameras:
        mine = np.array([*range(at, at := at + int(free[name].sum())), *range(c - shapes, c)], dtype=int)
        part = linearised(problem, name, sigma[name], free[name])
        own, slope = np.zeros((b, len(mine), len(mine))), np.zeros((b, len(mine)))
        np.add.at(own, part.block, np.einsum("nip,niq->npq", part.by_shared, part.by_shared))
        np.add.at(slope, part.block, np.einsum("nip,ni->np", part.by_shared, part.r))
        H[:, mine[:, None], mine] += own
        g[:, mine] += slope
    Y = equations.W @ np.linalg.inv(equations.B + 1e-12 * np.eye(equations.B.shape[-1]))
    H -= Y @ equations.W.swapaxes(-1, -2)
    g -= np.einsum("bcd,bd->bc", Y, equations.h)
    total = equations.information_with_shapes()
    whole = equations.g - np.einsum("bcd,bd->c", Y, equations.h)
    step = np.linalg.lstsq(total, whole, rcond=1e-14)[0]
    covariance = _clustered(total, H, g - H @ step)
    each = np.stack([np.linalg.lstsq(total - P, whole - slope, rcond=1e-14)[0] for P, slope in zip(H, g)])
    each -= each.mean(0)
    after = np.zeros(0) if problem.shape is None else problem.shape.values.ravel() + step[c - shapes :]
    cameras, boards = slice(c - shapes), slice(c - shapes, c)
    left_out = (b - 1) / b * (each.T @ each)[cameras, cameras]
    return Jackknife(covariance[cameras, cameras], left_out, covariance[boards, boards], after)


def _clustered(total: Array, H: Array, g: Array) -> Array:
    """The covariance by the slopes g (b, c) of blocks, each scaled by (1 - its share H of the information)^(-1/2)."""
    scale = 1 / np.sqrt(total.diagonal())
    whiten = np.linalg.inv(np.linalg.cholesky(total * scale * scale[:, None])) * scale
    share, axes = np.linalg.eigh(whiten @ H @ whiten.T)
    slopes = np.einsum("bji,bj->bi", axes, g @ whiten.T) / np.sqrt(np.maximum(1 - share, 1e-6))
    changes = np.einsum("bij,bj->bi", axes, slopes) @ whiten
    return np.asarray(changes.T @ changes)
