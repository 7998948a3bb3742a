"""Roots of polynomials, and inverses of increasing functions and of maps of the plane, for many at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .runtime.tracing import followed, traced


def first_root(coefficients: Tensor) -> Tensor:
    """Smallest positive root of 1 + a_1 u + ... + a_n u^n; infinity if none, 0 if an a is not finite.

    `coefficients` (*b, n + 1) starts with the 1. The roots are the inverses of those of the reversed
    polynomial, which is monic, so a leading coefficient of 0 needs no care: eigenvalues of its companion.
    Huge coefficients, with which LAPACK crashes, are scaled down first (u = s w, with s a power of 2).
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
"""Coefficients from the n-th power of this on are scaled before their roots are sought; no lens has such."""


def invert_increasing(
    f: Callable[[Tensor], tuple[Tensor, Tensor]], y: Tensor, high: Tensor, iterations: int = 100
) -> Tensor:
    """r in [0, high] with f(r) = y, by Newton inside a bracket; `high` where f never gets to y.

    f gives its value and its slope, f(0) = 0, and rises on the bracket.
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
"""Iterations after which a Newton step not half the one before is replaced by halving the bracket."""


PlaneMap = Callable[[Tensor], tuple[Tensor, Sequence[Tensor]]]
"""Points (*n, 2) to their images and the Jacobian (dx'/dx, dx'/dy, dy'/dx, dy'/dy), each (*n)."""


def solve_in_plane(
    f: PlaneMap,
    start: Tensor,
    target: Tensor,
    within: Callable[[Tensor], Tensor],
    *,
    rounding: float = 2.0,
    steps: int = 30,
) -> Tensor:
    """Points (*n, 2) whose images are `target` (*n, 2), by Newton from `start` on, with halved steps where a
    whole one leaves where points may be (`within`, (*n)) or does not help; the nearest that is found where
    there is none. `rounding`: of f's values, in units of the last place.
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
    """What to take from points whose images are `value` for `target`, each (*n, 2); `PlaneMap`'s Jacobian."""
    xx, xy, yx, yy = jacobian
    ex, ey = (value - target).unbind(-1)
    determinant = xx * yy - xy * yx
    determinant = torch.where(determinant.abs() < 1e-12, 1e-12, determinant)
    return torch.stack([(yy * ex - xy * ey) / determinant, (xx * ey - yx * ex) / determinant], -1)


def keeps_orientation(jacobian: Sequence[Tensor]) -> Tensor:
    """Whether (*n) a `PlaneMap` keeps orientation: past a fold it mirrors, past two it is half turned."""
    xx, xy, yx, yy = jacobian
    return (xx * yy - xy * yx > 0) & (xx + yy > 0)


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).square().sum(-1).sqrt()
