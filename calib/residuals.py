"""How far matched points are from what a rig says of them: across the lines, in front, at which depth.

Everything is measured in the pixels of the pictures as they are, through any lens, and is differentiable in the rig.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Pair, essential_matrix
from arraygeom.pixels import to_homogeneous

from .matches import Matches


class Residuals(NamedTuple):
    """Signed distances in pixels, one a match, and where they exist.

    sampson: from the nearest pair of points that would fit (Hartley & Zisserman 11.4.3), in both pictures together.
    line: from the epipolar line (the curve, through a lens), in beta.
    """

    sampson: Float[Tensor, " n"]
    line: Float[Tensor, " n"]
    valid: Bool[Tensor, " n"]


def epipolar_residuals(pair: Pair, matches: Matches) -> Residuals:
    """What x_beta^T F x_alpha = 0 leaves over, divided by its gradient in the pixels, which counts as constant.

    With cameras the rays of the pixels take the place of the pixels and E that of F, so that lenses are obeyed to
    first order in the distance. Raises ValueError if neither cameras nor F are known.
    """
    alpha, beta = (x.detach().requires_grad_() for x in matches)
    with torch.enable_grad():
        algebraic, valid = _constraint(pair, alpha, beta)
        at_alpha, at_beta = torch.autograd.grad(algebraic.sum(), (alpha, beta), retain_graph=True)
    across = at_beta.square().sum(-1)
    both = (across + at_alpha.square().sum(-1)).clamp(min=1e-300)
    return Residuals(algebraic / both.sqrt(), algebraic / across.clamp(min=1e-300).sqrt(), valid)


def _constraint(pair: Pair, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """y^T F x, or of the rays y^T E x; and where it exists."""
    rays, F, valid = _rays(pair, x, y)
    return ((rays[1] @ F) * rays[0]).sum(-1), valid


def _rays(pair: Pair, x: Tensor, y: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """Rays of the pixels and E; or the pixels themselves and F. And where the rays exist."""
    if pair.link is not None or not pair.calibrated:
        everywhere = torch.ones_like(x[:, 0], dtype=torch.bool)
        return (to_homogeneous(x), to_homogeneous(y)), pair.fundamental, everywhere
    (a, seen), (b, also) = (camera.rays(points) for camera, points in zip(pair.cameras, (x, y)))
    return (a, b), essential_matrix(pair.beta_from_alpha), seen & also


def lines_basis(pair: Pair, matches: Matches) -> Float[Tensor, "n 8"]:
    """How the distances from the lines change with the eight numbers of F (of E, for the rays) beside its scale."""
    alpha, beta = (x.detach().requires_grad_() for x in matches)
    with torch.enable_grad():
        rays, F, _ = _rays(pair, alpha, beta)
        at_beta = torch.autograd.grad(((rays[1] @ F) * rays[0]).sum(), beta)[0]
    products = (rays[1][:, :, None] * rays[0][:, None, :]).flatten(1).detach()
    columns = (products / at_beta.norm(dim=-1, keepdim=True).clamp(min=1e-150)).nan_to_num()
    size = columns.norm(dim=0).clamp(min=1e-150)
    beside = torch.linalg.svd((F.detach().flatten() * size)[None]).Vh[1:]
    return columns / size @ beside.T


class SeenDepths(NamedTuple):
    """Depth in alpha (metres) of matched points, which lie in front of both cameras, and whose depth can be told."""

    depth: Float[Tensor, " n"]
    front: Bool[Tensor, " n"]
    known: Bool[Tensor, " n"]


LEAST_PARALLAX = 2.0
"""Rays must cross at an angle worth this many pixels for their depth to be told."""


def depths(pair: Pair, matches: Matches) -> SeenDepths:
    """Where the rays of matched points pass each other most closely. Raises ValueError for uncalibrated pairs."""
    alpha, beta = pair.cameras
    (a, seen), (b, also) = alpha.rays(matches.alpha), beta.rays(matches.beta)
    pose = pair.beta_from_alpha
    turned = a @ pose.R.T
    aa, bb, ab = (turned * turned).sum(-1), (b * b).sum(-1), (turned * b).sum(-1)
    ta, tb = turned @ pose.t, b @ pose.t
    sine2 = aa * bb - ab.square()
    along_a, along_b = ((ab * tb - bb * ta) / sine2, (aa * tb - ab * ta) / sine2)
    pixel = 1 / beta.K[:2, :2].det().abs().sqrt()
    known = seen & also & (sine2 / (aa * bb) > (LEAST_PARALLAX * pixel).square())
    return SeenDepths(along_a * a[:, 2], (along_a > 0) & (along_b > 0), known)
