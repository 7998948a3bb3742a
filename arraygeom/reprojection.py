"""Reprojection: slopes and residuals of points' images, and bundle adjustment as a differentiable layer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .camera import Camera, Projected
from .pixels import product
from .rig import Rig
from .robust import LEAST_DAMPING

STEP = 1e-5
"""Step of central differences, in distances from the camera: good to 1e-9 in float64."""


def projection_slopes(
    camera: Camera, X: Float[Tensor, "*n 3"], distance: Float[Tensor, "*n"]
) -> tuple[Projected, Float[Tensor, "*n 2 3"]]:
    """Project world points by a float64 camera, with slopes dx / dX by central differences; any lens.

    Args:
        X: world points, metres, float64: in float32 differences are mostly rounding.
        distance: distance of the points from the camera, metres, above 0.

    Returns:
        The projection, and slopes (*n, 2, 3), pixels for each metre, without meaning where it or a point
        beside (`STEP`) is not valid. Differentiable as often as `Camera.project` is.
    """
    step = STEP * distance[..., None, None]
    offsets = torch.eye(3).to(X) * step
    around = torch.cat([X[..., None, :], X[..., None, :] + offsets, X[..., None, :] - offsets], -2)
    projected = camera.project(around)
    by_X = (projected.x[..., 1:4, :] - projected.x[..., 4:, :]) / (2 * step)
    return Projected(
        *(values[..., 0, :] if values is projected.x else values[..., 0] for values in projected)
    ), by_X.mT


def reprojection_residuals(
    cameras: Sequence[Camera],
    X: Float[Tensor, "*n 3"],
    x: Real[Tensor, "v *n 2"],
    *,
    seen: Bool[Tensor, " v *n"] | None = None,
) -> Float[Tensor, "v *n 2"]:
    """Compute measured pixels x minus the projections of world points X.

    Args:
        seen: True where a camera sees a point; None for all. Pixels that are not finite are not seen.

    Returns:
        Residuals (v, *n, 2), pixels; zero where a point is not seen, or not valid in the camera.

    Raises:
        ValueError: for no cameras, pixels or `seen` of another shape, and points without the axes of batched
            cameras.
    """
    projected = [camera.project(X) for camera in cameras]
    views = len(cameras), *(projected[0].valid.shape if projected else ())
    if not projected or x.shape != (*views, 2) or (seen is not None and seen.shape != views):
        got = tuple(x.shape) if seen is None else f"{tuple(x.shape)}, seen {tuple(seen.shape)}"
        raise ValueError(f"wanted pixels (views, *points, 2), here {(*views, 2)}, seen {views}, got {got}")
    used = _used(projected, x, seen)
    return torch.where(used[..., None], x - torch.stack([p.x for p in projected]), 0.0)


def _used(projected: Sequence[Projected], x: Tensor, seen: Tensor | None) -> Tensor:
    used = torch.stack([p.valid for p in projected]) & x.isfinite().all(-1)
    return used if seen is None else used & seen


class Bundle(NamedTuple):
    """Result of a bundle adjustment.

    Attributes:
        rig: the adjusted rig, float64; all but the free parameters is as given.
        X: the adjusted world points (n, 3), metres, float64.
        cost: sums of squared residuals (steps + 1): before the first and after each step, pixels².
    """

    rig: Rig
    X: Float[Tensor, "n 3"]
    cost: Float[Tensor, " s"]


def bundle_adjusted(
    rig: Rig,
    X: Float[Tensor, "n 3"],
    x: Real[Tensor, "v n 2"],
    *,
    free: Iterable[str],
    seen: Bool[Tensor, "v n"] | None = None,
    steps: int = 10,
    damping: float = 1e-3,
) -> Bundle:
    """Adjust a rig and points to least reprojection error: Levenberg-Marquardt in float64, points eliminated
    (Schur).

    A step that raises the cost, beyond rounding, is not made, and the next is damped tenfold. The damping
    holds what images do not determine, such as scale. Memory: points times free numbers.

    Args:
        X: world points to start from, metres.
        x: their pixels in the rig's cameras, in its order; NaN where not seen.
        free: patterns of free parameters, as for `Rig.parameters`; none adjusts the points alone.
        seen: True where a camera sees a point; None for all.
        steps: number of steps, all of which are tried.
        damping: factor of the information's diagonal that is added to it at the first step.

    Returns:
        Rig and points. Gradients, in everything given, follow the steps made: at the optimum they are the
        least error's.

    Raises:
        ValueError: for a batch, uncalibrated cameras, pixels or `seen` of another shape, and as
            `Rig.parameters`.
    """
    cameras = list(rig.cameras.values())
    if rig.batch_shape or not all(isinstance(camera, Camera) for camera in cameras):
        raise ValueError(
            "bundle adjustment needs one rig of calibrated cameras: take one of the batch, or calibrate"
        )
    rig, X, x = rig.to(torch.float64), X.double(), x.double()
    names = list(rig.parameters(free=free))
    costs = [_cost(rig, X, x, seen)]
    for _ in range(steps):
        trial, moved = _stepped(rig, X, x, seen, names, damping)
        cost = _cost(trial, moved, x, seen)
        better = bool(cost <= (1 + ROUNDED) * costs[-1] + x.numel() * ROUNDED**2)
        rig, X = (trial, moved) if better else (rig, X)
        costs.append(cost if better else costs[-1])
        damping = max(damping / 10, LEAST_DAMPING) if better else damping * 10
    return Bundle(rig, X, torch.stack(costs))


ROUNDED = 1e-9
"""Relative rise of the cost, or pixels for each number, up to which a step is made, for gradients."""


def _cost(rig: Rig, X: Tensor, x: Tensor, seen: Tensor | None) -> Tensor:
    return reprojection_residuals(list(rig.cameras.values()), X, x, seen=seen).square().sum()


def _stepped(
    rig: Rig, X: Tensor, x: Tensor, seen: Tensor | None, names: list[str], damping: float
) -> tuple[Rig, Tensor]:
    """Rig and points after one damped Gauss-Newton step."""
    cameras = list(rig.cameras.values())
    r = reprojection_residuals(cameras, X, x, seen=seen)
    used = _used([c.project(X) for c in cameras], x, seen)[..., None, None]
    slopes = [projection_slopes(c, X, (X - c.centre).norm(dim=-1))[1] for c in cameras]
    by_X = torch.where(used, torch.stack(slopes), 0.0)
    zeros = rig.parameters(free=names)
    sizes = [zero.numel() for zero in zeros.values()]

    def changed(change: Tensor) -> Rig:
        parts = (c.reshape(zeros[n].shape) for n, c in zip(names, change.split(sizes)))
        return rig.perturbed(dict(zip(names, parts)))

    def images(change: Tensor) -> Tensor:
        return torch.stack([c.project(X).x for c in changed(change).cameras.values()])

    by_rig = torch.func.jacfwd(images)(x.new_zeros(sum(sizes)))
    by_rig = torch.where(used, by_rig, 0.0)
    points = _damped(product(by_X.mT, by_X).sum(0), damping)
    both = torch.einsum("vnij,vnik->njk", by_rig, by_X)
    back = torch.linalg.solve(points, both.mT).mT
    whole = _damped(torch.einsum("vnij,vnik->jk", by_rig, by_rig), damping) - torch.einsum(
        "njk,nlk->jl", back, both
    )
    at_points = torch.einsum("vnij,vni->nj", by_X, r)
    target = torch.einsum("vnij,vni->j", by_rig, r) - torch.einsum("njk,nk->j", back, at_points)
    change = torch.linalg.solve(whole, target)
    at_points = at_points - torch.einsum("njk,j->nk", both, change)
    return changed(change), X + torch.linalg.solve(points, at_points[..., None])[..., 0]


def _damped(information: Tensor, damping: float) -> Tensor:
    """Information with its diagonal raised by Marquardt's factor; 1 where nothing depends on a parameter."""
    diagonal = information.diagonal(dim1=-2, dim2=-1)
    return information + torch.diag_embed(torch.where(diagonal > 0, damping * diagonal, 1.0))
