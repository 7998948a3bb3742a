"""Homographies: maps between two images of one plane (Hartley & Zisserman, chapter 13).

Points are (x, y) in pixels, the centre of the first pixel being (0, 0). The pose is beta from alpha: X_beta =
R X_alpha + t.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .checks import check_numbers, check_tensors
from .pixels import map_homogeneous, product, to_homogeneous
from .robust import LocalModel, levenberg_marquardt
from .runtime.tracing import needs_numbers, traced


class TransformedPoints(NamedTuple):
    """Points after a homography.

    Attributes:
        x: pixels of the second image; zero where not valid.
        valid: True where x is finite and the homogeneous scale positive.
    """

    x: Float[Tensor, "*n 2"]
    valid: Bool[Tensor, "*n"]


def plane_homography(
    K_alpha: Float[Tensor, "*#b 3 3"],
    K_beta: Float[Tensor, "*#b 3 3"],
    R: Float[Tensor, "*#b 3 3"],
    t: Float[Tensor, "*#b 3"],
    *,
    normal: Float[Tensor, "*#b 3"],
    d: Float[Tensor, "*#b"],
) -> Float[Tensor, "*b 3 3"]:
    """Compute H with x_beta ~ H x_alpha for points of the plane normal^T X + d = 0 in alpha's frame.

    H = K_beta (R - t normal^T / d) K_alpha^-1 (Hartley & Zisserman, equation 13.2); normals have any length.
    The plane Z = 2 m is normal = (0, 0, 1), d = -2. H (x_alpha, 1) equals (Z_beta / Z_alpha) (x_beta, 1), so
    its third entry is positive for points in front of both cameras.

    Returns:
        H; not finite for a plane through alpha's centre (d = 0), which has no homography.

    Raises:
        RuntimeError: for a singular K_alpha, or batch axes that do not broadcast.
    """
    plane = R - t[..., :, None] * (normal / d[..., None])[..., None, :]
    return product(product(K_beta, plane), torch.linalg.inv(K_alpha))


def infinite_homography(
    K_alpha: Float[Tensor, "*#b 3 3"], K_beta: Float[Tensor, "*#b 3 3"], R: Float[Tensor, "*#b 3 3"]
) -> Float[Tensor, "*b 3 3"]:
    """Compute H = K_beta R K_alpha^-1, which maps points at infinite depth (H & Z, section 13.4)."""
    return product(product(K_beta, R), torch.linalg.inv(K_alpha))


def apply_homography(H: Float[Tensor, "*b 3 3"], x: Real[Tensor, "*n 2"]) -> TransformedPoints:
    """Map points (*n, 2); with batched H (*b), points are (*b, ..., 2).

    The sign of H matters: this module's functions give it such that the scale (third coordinate) is positive
    in front of both cameras, or at the points of the fit; an H from elsewhere has to be oriented first.

    Returns:
        Points, valid where finite and of a scale above `SMALLEST_SCALE`; elsewhere zero, with zero gradient.

    Raises:
        ValueError: for points without the axes of a batched H.
    """
    X, Y, scale = map_homogeneous(H, x).unbind(-1)
    valid = (scale > SMALLEST_SCALE) & X.isfinite() & Y.isfinite()
    scale = torch.where(valid, scale, 1.0)
    transformed = [torch.where(valid, c, 0.0) / scale for c in (X, Y)]
    return TransformedPoints(torch.stack(transformed, -1), valid)


SMALLEST_SCALE = 1e-9
"""Homogeneous scale above which a point is valid: for a plane's homography, the ratio of depths."""


def fit_similarity(x: Float[Tensor, "n 2"], y: Float[Tensor, "n 2"]) -> Float[Tensor, "3 3"]:
    """Fit the similarity (rotation, scale, shift) from x to y, in least squares; n >= 2.

    Umeyama 1991 in two dimensions, in closed form: as complex numbers y = a x + b.

    Returns:
        Matrix (3, 3) of the points' wider type, differentiable; NaN if y is not finite.

    Raises:
        ValueError: for unequal numbers of points, and, unless torch compiles, if all of x coincide or some
            are not finite.
    """
    if x.shape != y.shape:
        raise ValueError(f"wanted pairs of points, (n, 2) each, got {tuple(x.shape)}, {tuple(y.shape)}")
    dtype = torch.promote_types(x.dtype, y.dtype)
    x, y = x.double(), y.double()
    x_mean, y_mean = x.mean(0), y.mean(0)
    u, v = x - x_mean, y - y_mean
    squared = u.square().sum()
    if not traced() and not bool(squared > 0):
        raise ValueError("a similarity needs two points that differ: all of x are one")
    a = (u * v).sum() / squared
    b = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / squared
    linear = torch.stack([torch.stack([a, -b]), torch.stack([b, a])])
    return _affine(linear, y_mean - linear @ x_mean).to(dtype)


def fit_homography(x: Float[Tensor, "n 2"], y: Float[Tensor, "n 2"]) -> Float[Tensor, "3 3"]:
    """Fit the homography from points x to points y, four or more, in least squares of y's pixels.

    Levenberg-Marquardt steps from the better of the affine and the linear fit (Hartley & Zisserman, algorithm
    4.2), on points centred and scaled (section 4.4), in float64. Outliers are not down-weighted.

    Returns:
        Matrix (3, 3) of the points' wider type, oriented so that the scale is positive at the points;
        differentiable, through ten Gauss-Newton steps at the end.

    Raises:
        ValueError: for fewer points, unequal numbers, NaN or infinity, and if there is no such homography, as
            some points would be behind. Points on a line are not told: any of many comes back.
        TypeError: for points that are no floating-point tensors.
        NotImplementedError: within `torch.func.vmap`.
    """
    check_tensors((2,), x=x, y=y)
    if x.shape != y.shape or x.ndim != 2 or len(x) < 4:
        raise ValueError(
            f"wanted four pairs of points or more, (n, 2) each, got {tuple(x.shape)}, {tuple(y.shape)}"
        )
    needs_numbers("the number of steps of fit_homography", x, y)
    check_numbers(x, (2,), "x")
    check_numbers(y, (2,), "y")
    dtype = torch.promote_types(x.dtype, y.dtype)
    x, y = x.double(), y.double()
    A, B = _normalising(x), _normalising(y)
    u, v = x @ A[:2, :2].T + A[:2, 2], y @ B[:2, :2].T + B[:2, 2]
    u1 = to_homogeneous(u)
    H = _damped_fit(u1.detach(), v.detach())
    for _ in range(10):
        trial = _stepped(H, u1, v, 1e-12)
        with torch.no_grad():
            kept = _cost(trial, u1, v) <= _cost(H, u1, v) * (1 + 1e-9) + 1e-24
        H = torch.where(kept, trial, H)
    if not bool(_cost(H.detach(), u1, v).isfinite()):
        raise ValueError("no homography takes these points to those, all of them in front: check the matches")
    return (torch.linalg.inv(B) @ H @ A).to(dtype)


@torch.no_grad()
def _damped_fit(u1: Tensor, v: Tensor) -> Tensor:
    """Least squares homography of normalised points, H[2, 2] = 1 where possible."""
    affine = torch.cat([torch.linalg.lstsq(u1, v).solution.T, u1.new_tensor([[0.0, 0.0, 1.0]])])
    linear = _linear_fit(u1, v)
    linear = linear / torch.where(linear[2, 2] > 0, linear[2, 2], 1.0)
    H = min((affine, linear), key=lambda start: float(_cost(start, u1, v)))

    def model(H: Tensor) -> LocalModel[Tensor]:
        return LocalModel(
            float(_cost(H, u1, v)),
            lambda H: float(_cost(H, u1, v)),
            lambda damping: _stepped(H, u1, v, damping),
        )

    def is_converged(_: Tensor, __: Tensor, before: float, after: float) -> bool:
        return before - after <= 1e-15 * before

    return levenberg_marquardt(H, model, is_converged, steps=50, damping=1e-6)[0]


def _linear_fit(u1: Tensor, v: Tensor) -> Tensor:
    """Homography of least algebraic error (algorithm 4.1), oriented by the points."""
    zero = torch.zeros_like(u1)
    rows = torch.cat([torch.cat([u1, zero, -v[:, :1] * u1], 1), torch.cat([zero, u1, -v[:, 1:] * u1], 1)])
    H = torch.linalg.eigh(rows.T @ rows).eigenvectors[:, 0].reshape(3, 3)
    return H / torch.where((u1 @ H[2]).mean() > 0, 1.0, -1.0) / H.norm()


def _cost(H: Tensor, u1: Tensor, v: Tensor) -> Tensor:
    """Sum of squared distances; infinite if a point is not in front."""
    w = u1 @ H[2]
    squared = ((u1 @ H[:2].T) / w[:, None] - v).square().sum()
    return torch.where((w > 0).all() & squared.isfinite(), squared, torch.inf)


def _stepped(H: Tensor, u1: Tensor, v: Tensor, damping: float) -> Tensor:
    """H after one Gauss-Newton step in all of its entries but the scale."""
    w = u1 @ H[2]
    transformed = (u1 @ H[:2].T) / w[:, None]
    p = u1 / w[:, None]
    zero = torch.zeros_like(p)
    slopes = [
        torch.cat([*block, -m * p[:, :2]], -1)
        for block, m in (([p, zero], transformed[:, :1]), ([zero, p], transformed[:, 1:]))
    ]
    J, residual = torch.cat(slopes), (v - transformed).T.reshape(-1)
    step = torch.linalg.solve(J.T @ J + damping * torch.eye(8).to(J), J.T @ residual)
    return H + torch.nn.functional.pad(step, (0, 1)).reshape(3, 3)


def _normalising(x: Tensor) -> Tensor:
    """Similarity that centres points and scales them to unit deviation; a constant of the fit."""
    mean = x.detach().mean(0)
    deviation = (x.detach() - mean).square().mean().sqrt().clamp(min=1e-6)
    return _affine(torch.eye(2).to(x) / deviation, -mean / deviation)


def _affine(linear: Tensor, shift: Tensor) -> Tensor:
    top = torch.cat([linear, shift[:, None]], 1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 1.0]])])
