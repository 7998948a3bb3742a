"""Roots of polynomials, and inverses of increasing functions and of maps of the plane, many at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .runtime.tracing import followed, traced


def first_root(coefficients: Tensor) -> Tensor:
    """Find the smallest positive root of 1 + a_1 u + ... + a_n u^n.

    The roots are the inverse eigenvalues of the reversed polynomial's companion matrix: leading coefficients
    may be 0. Huge coefficients, with which LAPACK crashes, are scaled down first.

    Args:
        coefficients: (*b, n + 1), starting with the 1.

    Returns:
        Roots (*b); infinity if there is none, 0 if a coefficient is not finite. A double root may count as
        none, as rounding makes it a complex pair.
    """
    a = coefficients[..., 1:]
    n = a.shape[-1]
    if a.numel() > n and not traced() and bool((a == a.reshape(-1, n)[0]).all()):
        return first_root(coefficients.reshape(-1, n + 1)[0]).expand(a.shape[:-1])  # copies of one lens
    if not followed() and not bool(a.any()):
        return a.new_full(a.shape[:-1], torch.inf)
    finite = a.isfinite().all(-1)
    a = torch.where(finite[..., None], a, 0.0)
    powers = torch.arange(1, n + 1).to(a)
    size = (a.abs() ** (1 / powers)).amax(-1)
    scale = torch.where(size > HUGE, torch.exp2(-size.clamp(min=1.0).log2().ceil()), 1.0)
    a = a * scale[..., None] ** powers
    companion = torch.diag_embed(torch.ones_like(a[..., 1:]), offset=-1)
    companion = companion - torch.cat([a[..., None, :], a.new_zeros((*a.shape[:-1], n - 1, n))], -2)
    inverse_roots = torch.linalg.eigvals(companion)
    positive = (inverse_roots.imag == 0) & (inverse_roots.real > 0)
    root = scale / torch.where(positive, inverse_roots.real, 0.0).amax(-1)
    return torch.where(finite, root, 0.0)


HUGE = 1e4
"""Base of the powers above which coefficients are scaled first; no lens has such."""


def invert_increasing(
    f: Callable[[Tensor], tuple[Tensor, Tensor]], y: Tensor, high: Tensor, iterations: int = 100
) -> Tensor:
    """Find r in [0, high] with f(r) = y, by Newton's method inside a bracket.

    Args:
        f: function that returns its value and its slope; f(0) = 0, rising on the bracket.
        y: values (*n), at least 0.
        high: ends of the brackets, which broadcast to y.
        iterations: largest number of iterations.

    Returns:
        r (*n), as exact as `iterations` make it; `high` where f never exceeds y, and for NaN.
    """
    reached = f(high)[0] > y
    y = torch.where(reached, y, 0.0)
    low, top = torch.zeros_like(y), high
    r = torch.minimum(y, high)
    step = high.expand_as(r)
    for i in range(iterations):
        value, slope = f(r)
        low, top = torch.where(value < y, r, low), torch.where(value > y, r, top)
        newton = r - (value - y) / slope
        enough = 4 * torch.finfo(y.dtype).eps * r
        taken = (newton >= low) & (newton <= top)
        if i >= PATIENCE:
            # Newton's steps can cycle within the bracket: now either they halve or the bracket does.
            taken = taken & ~((newton - r).abs() > torch.maximum(step / 2, enough))
        following = torch.where(taken, newton, (low + top) / 2)
        step = (following - r).abs()
        moved = step > enough
        r = following
        if not traced() and not bool(moved.any()):
            break
    return torch.where(reached, r, high)


PATIENCE = 12
"""Iterations after which a Newton step that is not half the one before is replaced by halving the bracket."""


PlaneMap = Callable[[Tensor], tuple[Tensor, Sequence[Tensor]]]
"""Function from points (*n, 2) to images and Jacobian (dx'/dx, dx'/dy, dy'/dx, dy'/dy), each (*n)."""


def solve_in_plane(
    f: PlaneMap,
    start: Tensor,
    target: Tensor,
    within: Callable[[Tensor], Tensor],
    *,
    rounding: float = 2.0,
    steps: int = 30,
) -> Tensor:
    """Find the points (*n, 2) whose images are `target` (*n, 2), by Newton's method.

    Steps are halved where a whole one leaves the allowed region or comes no nearer.

    Args:
        f: function from points to their images, and its Jacobian.
        start: points (*n, 2) to start from.
        within: function that returns True (*n) for allowed points.
        rounding: rounding of f's values, in units of the last place.
        steps: largest number of steps.

    Returns:
        The points (*n, 2); where there is no solution, those with the nearest images that were found.
    """
    xy = start
    value, jacobian = f(xy)
    error, scale = _distance(value, target), torch.ones_like(target[..., 0])
    enough = rounding * torch.finfo(target.dtype).eps * (1 + target.square().sum(-1).sqrt())
    for _ in range(steps):
        if not traced() and bool(((error <= enough) | (scale < 1e-3)).all()):
            break
        trial = xy - scale[..., None] * newton_step(value, jacobian, target)
        value_there, jacobian_there = f(trial)
        error_there = _distance(value_there, target)
        better = (error_there < error) & within(trial)
        xy, value = (torch.where(better[..., None], a, b) for a, b in ((trial, xy), (value_there, value)))
        jacobian = [torch.where(better, a, b) for a, b in zip(jacobian_there, jacobian)]
        error, scale = torch.where(better, error_there, error), torch.where(better, 1.0, scale / 2)
    return xy


def newton_step(value: Tensor, jacobian: Sequence[Tensor], target: Tensor) -> Tensor:
    """Compute the Newton step towards points of the plane whose images are `target`.

    Args:
        value: images (*n, 2) of the present points.
        jacobian: Jacobian of a `PlaneMap` there: dx'/dx, dx'/dy, dy'/dx, dy'/dy, each (*n).
        target: wanted images (*n, 2).

    Returns:
        Steps (*n, 2) to subtract from the points, finite: small determinants count as 1e-12.
    """
    xx, xy, yx, yy = jacobian
    ex, ey = (value - target).unbind(-1)
    determinant = xx * yy - xy * yx
    determinant = torch.where(determinant.abs() < 1e-12, 1e-12, determinant)
    return torch.stack([(yy * ex - xy * ey) / determinant, (xx * ey - yx * ex) / determinant], -1)


def keeps_orientation(jacobian: Sequence[Tensor]) -> Tensor:
    """Return True (*n) where a `PlaneMap` keeps orientation: a fold mirrors it, two turn it by half."""
    xx, xy, yx, yy = jacobian
    return (xx * yy - xy * yx > 0) & (xx + yy > 0)


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).square().sum(-1).sqrt()
