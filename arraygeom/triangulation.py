"""Depth from images: of two views along a field, of N views by triangulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .camera import Camera
from .checks import check_above
from .epipolar import Depth, beside, depth_from_track, track
from .lenses.common import on_plane
from .multiview import world_rays
from .pair import Pair
from .pixels import floating, product
from .pose import matvec
from .reprojection import projection_slopes


class Triangulated(NamedTuple):
    """Triangulated points.

    Attributes:
        X: world points (*n, 3), metres; 0 where not valid.
        covariance: covariance (*n, 3, 3) of the points, m²; without meaning where not valid.
        valid: True for usable points, as `triangulate` says.
        residual: largest distance between a match and the point's image over the views that count, pixels;
            without meaning where fewer than two do.
    """

    X: Float[Tensor, "*n 3"]
    covariance: Float[Tensor, "*n 3 3"]
    valid: Bool[Tensor, "*n"]
    residual: Float[Tensor, "*n"]


def triangulate(
    cameras: Sequence[Camera],
    x: Real[Tensor, "v *n 2"],
    *,
    seen: Bool[Tensor, " v *n"] | None = None,
    deviation: float = 1.0,
    residual: float | None = None,
) -> Triangulated:
    """Triangulate points from their pixels in two views or more, of least reprojection error, through any
    lens.

    Gauss-Newton in float64 on direction and inverse distance from the first view that sees the point (Civera,
    Davison and Montiel 2008), from where rays meet in least squares.

    Args:
        cameras: two cameras or more; batched cameras (*b) take pixels (views, *b, ..., 2).
        x: pixels of the points in each camera; NaN where unknown.
        seen: True where a camera sees a point; None for all.
        deviation: standard deviation of pixel coordinates.
        residual: largest accepted residual, pixels; None for five deviations.

    Returns:
        Points with exact derivatives. The covariance is to first order across the ray; along it, three
        deviations extend to where the inverse distance is three deviations less: the error stays within them
        as often as a normal distribution's. Valid where that is still finite, two views or more see the
        point, all that do have it in front, and no residual is too large.

    Raises:
        ValueError: for fewer than two cameras, another number of views in `x`, a deviation that is not above
            0 and finite, `seen` of another shape, or pixels without the axes of batched cameras.
        TypeError: for pixels that are no tensor.
    """
    if len(cameras) != len(x) or len(cameras) < 2:
        raise ValueError(
            f"wanted pixels (views, ..., 2) of {len(cameras)} >= 2 cameras, got {tuple(x.shape)}"
        )
    check_above(0, itself=False, deviation=deviation)
    if seen is not None and (seen.shape != x.shape[:-1] or seen.dtype != torch.bool):
        raise ValueError(f"seen is {seen.dtype} {tuple(seen.shape)}; wanted bools {tuple(x.shape[:-1])}")
    dtype = torch.promote_types(floating(x).dtype, cameras[0].t.dtype)
    sights, chart, p = _sighted([c.to(torch.float64) for c in cameras], x.double(), seen)
    for i in range(STEPS):
        p = p.detach() if i == STEPS - FOLLOWED else p
        step = _normal_equations(sights, chart, p)
        p = p + torch.cholesky_solve(step.target[..., None], torch.linalg.cholesky(step.matrix))[..., 0]
        p = torch.cat([p[..., :2], p[..., 2:].clamp(min=SMALLEST_PARALLAX)], -1)
    last = _normal_equations(sights, chart, p)
    of_chart = deviation**2 * torch.linalg.inv(last.matrix)
    margin = 1 - 3 * of_chart[..., 2, 2].sqrt() / p[..., 2]
    slopes = chart.slopes(p)
    slopes = torch.cat([slopes[..., :2], slopes[..., 2:] / margin.clamp(min=0.1)[..., None, None]], -1)
    within = last.residual <= (5 * deviation if residual is None else residual)
    valid = last.solvable & last.in_front & within & (margin > 0)
    X = torch.where(valid[..., None], chart.point(p), 0.0)
    covariance = product(product(slopes, of_chart), slopes.mT)
    return Triangulated(X.to(dtype), covariance.to(dtype), valid, last.residual.to(dtype))


STEPS = 5
"""Number of Gauss-Newton steps."""
FOLLOWED = 3
"""Steps that derivatives go through: each reduces their error by about residual / disparity."""
SMALLEST_PARALLAX = 1e-9
"""Least angle between two rays, radians: float64 pixels do not show less."""


def depth_of(
    pair: Pair,
    x: Real[Tensor, "*n 2"],
    x_beta: Real[Tensor, "*n 2"],
    deviation: Float[Tensor, "*n"] | None = None,
) -> Depth:
    """Compute the depth in alpha of matches x (alpha) and `x_beta` (beta); through central lenses too.

    Args:
        deviation: standard deviation of x_beta along the segment, pixels; None for 0. It is propagated to
            first order.

    Returns:
        Depth z in metres, its deviation, and validity: as `depth_from_track`, and within both lenses' ranges
        and less than 90 degrees off axis.

    Raises:
        ValueError: for lenses whose rays do not meet in a point, pixels without the axes of a batch, and as
            `Pair.beta_from_alpha`.
    """
    alpha, beta = pair.cameras
    x, x_beta = floating(x), floating(x_beta)
    if not pair.has_lens:
        return depth_from_track(track(alpha.K, beta.K, pair.beta_from_alpha, x), x_beta, deviation)
    if not (alpha.central and beta.central):
        raise ValueError(
            "rays of one of these cameras do not meet in a point: use arraygeom.fields.ray_depth"
        )
    pose = pair.beta_from_alpha
    rays, has_ray = zip(*(c.to(x.dtype).rays(p) for c, p in ((alpha, x), (beta, x_beta))))
    (normalised, ahead), (normalised_beta, ahead_beta) = map(on_plane, rays)
    eye = torch.eye(3).to(pose.R).expand_as(pose.R)
    of_track = depth_from_track(track(eye, eye, pose, normalised), normalised_beta)
    valid = of_track.valid & has_ray[0] & has_ray[1] & ahead & ahead_beta
    depth = torch.where(valid, of_track.depth, 0.0)
    sigma = torch.zeros_like(depth) if deviation is None else deviation
    return Depth(depth, torch.where(valid, sigma * _metres_per_pixel(pair, x, depth, valid), 0.0), valid)


def _metres_per_pixel(pair: Pair, x: Tensor, depth: Tensor, valid: Tensor) -> Tensor:
    """Metres of depth for each pixel of beta, by central differences of a thousandth of the depth."""
    alpha, beta = pair.cameras
    safe = torch.where(valid, depth, 1.0).to(alpha.K.dtype)
    ends = [beta.project(alpha.unproject(x.to(safe), safe * (1 + s))).x for s in (5e-4, -5e-4)]
    pixels = (ends[0] - ends[1]).square().sum(-1).clamp(min=1e-24).sqrt()
    return torch.where(valid, 1e-3 * safe / pixels, 0.0).to(depth)


class _Sight(NamedTuple):
    """Camera, pixels (*n, 2) of the points in it, which of them count, and its centre (*n or 1, 3)."""

    camera: Camera
    x: Tensor
    usable: Tensor
    centre: Tensor


class _Chart(NamedTuple):
    """Chart of points p = (a, b, w): `origin` + `scale` (a u + b v + d) / w; `axes` are columns u, v, d."""

    origin: Tensor
    axes: Tensor
    scale: Tensor

    def direction(self, p: Tensor) -> Tensor:
        return matvec(self.axes, torch.nn.functional.pad(p[..., :2], (0, 1), value=1.0))

    def point(self, p: Tensor) -> Tensor:
        return self.origin + (self.scale / p[..., 2])[..., None] * self.direction(p)

    def slopes(self, p: Tensor) -> Tensor:
        """Derivatives dX / dp (*n, 3, 3)."""
        along = -self.direction(p) / p[..., 2:]
        columns = torch.cat([self.axes[..., :2], along[..., None]], -1)
        return (self.scale / p[..., 2])[..., None, None] * columns


class _NormalEquations(NamedTuple):
    """Gauss-Newton equations, the identity where not `solvable`, and visibility and residual of the point."""

    matrix: Tensor
    target: Tensor
    solvable: Tensor
    in_front: Tensor
    residual: Tensor


def _sighted(
    cameras: Sequence[Camera], x: Tensor, seen: Tensor | None
) -> tuple[list[_Sight], _Chart, Tensor]:
    """Sights of each point, its first view's chart, and the point where rays meet in least squares."""
    finite = x.isfinite().all(-1)
    x = torch.where(finite[..., None], x, 0.0)
    centres, directions, usable = (
        torch.stack(tensors) for tensors in zip(*(world_rays(c, p) for c, p in zip(cameras, x)))
    )
    usable = usable & finite if seen is None else usable & finite & seen
    focal = [beside(c.K[..., :2, :2].det().abs(), x.ndim - 2).expand_as(u) for c, u in zip(cameras, usable)]
    first = usable.to(torch.uint8).argmax(0)[None, ..., None].expand(1, *x.shape[1:-1], 3)
    origin, d = (t.gather(0, first)[0] for t in (centres, directions))
    baselines = origin - centres
    longest = torch.where(usable, baselines.square().sum(-1), 0.0).amax(0)
    scale = torch.where(longest > 0, torch.where(longest > 0, longest, 1.0).sqrt(), 1.0)
    a = torch.linalg.cross(d.expand_as(directions), directions)
    b = torch.linalg.cross(baselines / scale[..., None], directions)
    weight = torch.where(usable, torch.stack(focal), 0.0)[..., None]
    across = (weight * b.square()).sum((0, -1))
    w = -(weight * a * b).sum((0, -1)) / torch.where(across > 0, across, 1.0)
    axes = torch.stack([*_perpendicular(d), d], -1)
    w = torch.where(across > 0, w, 1.0).clamp(min=SMALLEST_PARALLAX)
    sights = [_Sight(*sight) for sight in zip(cameras, x, usable, centres)]
    return sights, _Chart(origin, axes, scale), torch.nn.functional.pad(w[..., None], (2, 0))


def _perpendicular(d: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors perpendicular to a unit vector and to each other."""
    x, z = d.new_tensor([1.0, 0, 0]), d.new_tensor([0.0, 0, 1])
    u = torch.linalg.cross(d, torch.where(d[..., :1].abs() < 0.7, x, z))
    u = u / u.norm(dim=-1, keepdim=True)
    return u, torch.linalg.cross(d, u)


def _normal_equations(sights: Sequence[_Sight], chart: _Chart, p: Tensor) -> _NormalEquations:
    """Normal equations of the reprojection error in pixels, at p."""
    X, slopes = chart.point(p), chart.slopes(p)
    matrix, target = torch.zeros_like(slopes), torch.zeros_like(p)
    in_front, worst = torch.ones_like(p[..., 0], dtype=torch.bool), torch.zeros_like(p[..., 0])
    for sight in sights:
        projected, by_X = projection_slopes(sight.camera, X, (X - sight.centre).norm(dim=-1))
        used = sight.usable & projected.valid
        J = torch.where(used[..., None, None], product(by_X, slopes), 0.0)
        r = torch.where(used[..., None], sight.x - projected.x, 0.0)
        matrix, target = matrix + product(J.mT, J), target + matvec(J.mT, r)
        in_front = in_front & (used | ~sight.usable)
        worst = torch.maximum(worst, r.detach().square().sum(-1))
    size = matrix.diagonal(dim1=-2, dim2=-1).amax(-1)
    ratio = torch.linalg.det(matrix / torch.where(size > 0, size, 1.0)[..., None, None])
    definite = torch.linalg.cholesky_ex(matrix.detach()).info == 0
    solvable = definite & (ratio > LEAST_DETERMINANT) & (torch.stack([s.usable for s in sights]).sum(0) >= 2)
    matrix = torch.where(solvable[..., None, None], matrix, torch.eye(3).to(matrix))
    return _NormalEquations(
        matrix, torch.where(solvable[..., None], target, 0.0), solvable, in_front, worst.sqrt()
    )


LEAST_DETERMINANT = 1e-18
"""Least determinant of normal equations scaled to a largest diagonal entry of 1: inverse distance is then
known 1e-9 as well as directions."""
