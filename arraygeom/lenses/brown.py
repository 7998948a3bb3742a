"""Brown-Conrady model: radial, tangential and thin-prism polynomials and a tilted sensor, and
their inverse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..pixels import broadcast_shapes, product, to_homogeneous
from ..roots import first_root, invert_increasing, keeps_orientation, newton_step, solve_in_plane
from ..runtime.tracing import traced
from .common import BEYOND, MARGIN, POLE, SOLVED, TINY, WIDEST, norm, once, polynomial_product, within_limit


@dataclass(frozen=True)
class Brown:
    """Coefficients of Brown-Conrady's model by name, each of shape (*b, 1..).

    Attributes:
        k: radial coefficients k1 to k3; of more than 5 coefficients (a rational lens) k1 to k6.
        p: tangential coefficients p1 and p2.
        s: thin-prism coefficients s1 to s4; empty for up to 8 coefficients.
        tilt: angles of the sensor about x and y, radians; None unless there are 14 coefficients.
        eighth: factor of r^8 in the numerator; None unless there are 15.
    """

    k: tuple[Tensor, ...]
    p: tuple[Tensor, Tensor]
    s: tuple[Tensor, ...]
    tilt: tuple[Tensor, Tensor] | None
    eighth: Tensor | None

    @staticmethod
    def named(c: Tensor) -> Brown:
        """Name 4 to 14 coefficients in OpenCV's order, optionally with a 15th (factor of r^8)."""
        n, eighth = c.shape[-1], c[..., 14] if c.shape[-1] == 15 else None
        c = c[..., :14]
        padded = torch.cat([c, c.new_zeros((*c.shape[:-1], 14 - c.shape[-1]))], -1).unbind(-1)
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty = padded
        rational, prism = (k4, k5, k6) if n > 5 else (), (s1, s2, s3, s4) if n > 8 else ()
        return Brown((k1, k2, k3, *rational), (p1, p2), prism, (tx, ty) if n == 14 else None, eighth)


def brown_distort(c: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
    """Distort normalised points (*n, 2), which lie in the plane z = 1 of the camera's frame.

    Args:
        c: coefficients (*b, 1.., k), k from 4 to 15 as `Brown.named` takes them, with an axis of length 1 for
            each further one of the points.
        xy: points (*b, ..., 2).

    Returns:
        Distorted points (*n, 2), and True (*n) within the model's range: up to `brown_limit`, without a fold,
        and ahead of a tilted sensor. Points beyond the limit are moved back to it first; NaN stays NaN.
    """
    lens, limit = Brown.named(c), once(brown_limit, c).to(xy)
    inside, pull = within_limit(xy.square().sum(-1), limit)
    planar, jacobian = _brown_planar(lens, xy * pull[..., None])
    tilted, ahead = _apply(_tilt_matrix(lens), planar)
    return tilted, inside & keeps_orientation(jacobian) & ahead


def brown_derivatives(c: Tensor, xy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distort normalised points (n, 2), with derivatives in closed form; validity is not checked.

    Args:
        c: coefficients (k,) in OpenCV's order, up to the prism's 12.
        xy: points; those beyond `brown_limit` are moved back to it.

    Returns:
        Distorted points (n, 2), their derivatives by the points (n, 2, 2) and by the coefficients (n, 2, k).

    Raises:
        ValueError: for coefficients of a tilt.
    """
    if len(c) > 12:
        raise ValueError(f"{len(c)} coefficients: a tilt has no derivatives in closed form")
    lens, limit = Brown.named(c[None]), once(brown_limit, c[None]).to(xy)
    squared = xy.square().sum(-1)
    inside, pull = within_limit(squared, limit)
    pulled = xy * pull[:, None]
    planar, jacobian = _brown_planar(lens, pulled)
    along = torch.where(inside[:, None], 0.0, xy)
    moved = pull[:, None, None] * (
        torch.eye(2).to(xy) - along[:, :, None] * (along / squared.clamp(min=TINY)[:, None])[:, None]
    )
    by_point = torch.stack(jacobian, -1).reshape(-1, 2, 2) @ moved
    x, y = pulled.unbind(-1)
    u = x * x + y * y
    g = _radial_factor(lens, u)[0]
    powers = torch.stack([u, u * u, u**3], -1)
    if len(lens.k) > 3:
        k4, k5, k6 = lens.k[3:]
        powers = powers / (1 + u * (k4 + u * (k5 + u * k6)))[:, None]
    radial, rational = (pulled[:, :, None] * f[:, None] for f in (powers, -g[:, None] * powers))
    cross, none = 2 * x * y, torch.zeros_like(u)
    tangential = torch.stack([cross, u + 2 * x * x, u + 2 * y * y, cross], -1).reshape(-1, 2, 2)
    prism = torch.stack([u, u * u, none, none, none, none, u, u * u], -1).reshape(-1, 2, 4)
    by_lens = torch.cat([radial[..., :2], tangential, radial[..., 2:], rational, prism], -1)
    return planar, by_point, by_lens[..., : len(c)]


def brown_undistort(c: Tensor, xy_d: Tensor) -> tuple[Tensor, Tensor]:
    """Undistort points, the inverse of `brown_distort`: undo the tilt exactly, solve for the radius in a
    bracket, then for (x, y) by Newton's method.

    The last two Newton steps carry first and second derivatives.

    Args:
        c: coefficients (*b, 1.., k), as `brown_distort` takes them.
        xy_d: distorted normalised points (*b, ..., 2).

    Returns:
        Undistorted normalised points (*n, 2), and True (*n) within the model's range; elsewhere the solution
        of the radial terms alone, at most at the limit, and for NaN NaN.
    """
    lens = Brown.named(c)
    H = _tilt_matrix(lens)
    target, ahead = _apply(H if H is None else torch.linalg.inv(H), xy_d)
    with torch.no_grad():
        inverse = _traced_brown_inverse if torch.compiler.is_compiling() else _brown_inverse
        solved, valid = inverse(c.detach(), target.detach())
    safe_target = torch.where(valid[..., None], target, 0.0)
    xy = torch.where(valid[..., None], solved, 0.0)
    for _ in range(2):
        xy = xy - newton_step(*_brown_planar(lens, xy), safe_target)
    return torch.where(valid[..., None], xy, solved), valid & ahead


def _brown_planar(lens: Brown, xy: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Distorted points without the tilt, and the Jacobian (dx'/dx, dx'/dy, dy'/dx, dy'/dy)."""
    x, y = xy.unbind(-1)
    p1, p2 = lens.p
    u = x * x + y * y
    g, dg = _radial_factor(lens, u)
    x_d = x * g + 2 * p1 * x * y + p2 * (u + 2 * x * x)
    y_d = y * g + p1 * (u + 2 * y * y) + 2 * p2 * x * y
    xx = g + 2 * x * x * dg + 2 * p1 * y + 6 * p2 * x
    yy = g + 2 * y * y * dg + 6 * p1 * y + 2 * p2 * x
    xy = yx = 2 * (x * y * dg + p1 * x + p2 * y)
    if lens.s:
        s1, s2, s3, s4 = lens.s
        prism_x, prism_y = 2 * (s1 + 2 * s2 * u), 2 * (s3 + 2 * s4 * u)
        x_d, y_d = x_d + u * (s1 + s2 * u), y_d + u * (s3 + s4 * u)
        xx, xy, yx, yy = xx + prism_x * x, xy + prism_x * y, yx + prism_y * x, yy + prism_y * y
    return torch.stack([x_d, y_d], -1), (xx, xy, yx, yy)


def _radial_factor(lens: Brown, u: Tensor) -> tuple[Tensor, Tensor]:
    """Radial factor g = (1 + k1 u + k2 u^2 + k3 u^3) / (1 + k4 u + k5 u^2 + k6 u^3) of the squared radius u,
    and dg/du."""
    k1, k2, k3, *rational = lens.k
    top, d_top = 1 + u * (k1 + u * (k2 + u * k3)), k1 + u * (2 * k2 + 3 * u * k3)
    if lens.eighth is not None:
        top, d_top = top + u**4 * lens.eighth, d_top + 4 * u**3 * lens.eighth
    if not rational:
        return top, d_top
    k4, k5, k6 = rational
    bottom, d_bottom = 1 + u * (k4 + u * (k5 + u * k6)), k4 + u * (2 * k5 + 3 * u * k6)
    g = top / bottom
    return g, (d_top - g * d_bottom) / bottom


@torch.no_grad()
def brown_limit(c: Tensor) -> Tensor:
    """Compute the squared radius up to which the model is used: where its radial part r g(r^2) stops rising.

    It ends earlier short of a pole, where other terms may fold the image, and at `WIDEST` squared.

    With g = N / D the slope is P / D^2, P(u) = (N + 2 u N') D - 2 u N D', of degree 6 (or 7) with P(0) = 1.

    Args:
        c: coefficients (*b, 1.., k), as `brown_distort` takes them.

    Returns:
        Squared radii (*b, 1..) of undistorted normalised points, float64 on the CPU, without gradient; 0 for
        radial coefficients that are not finite.
    """
    lens = Brown.named(c)
    k1, k2, k3, *rational = (k.detach().to("cpu", torch.float64) for k in lens.k)
    one = torch.ones_like(k1)
    k7 = () if lens.eighth is None else (lens.eighth.detach().to("cpu", torch.float64),)
    rising = polynomial_product((one, 3 * k1, 5 * k2, 7 * k3, *(9 * k for k in k7)), (one, *rational))
    below = (0 * one, *(n * k for n, k in zip((2, 4, 6), rational)))
    falling = polynomial_product((one, k1, k2, k3, *k7), below)
    turn = first_root(torch.stack([a - b for a, b in zip(rising, falling)], -1))
    limit = torch.minimum(turn * (1 - MARGIN), one * WIDEST**2)
    if rational:
        limit = torch.minimum(limit, first_root(torch.stack([one, *rational], -1)) * POLE)
    if not traced() and not any(bool(v.any()) for v in (*lens.p, *lens.s)):
        return limit
    return _before_dip(lens, limit)


def _before_dip(lens: Brown, limit: Tensor) -> Tensor:
    """Limit the squared radius to where the radial slope is least, if other terms may fold the image there.

    Past such a fold, after which the slope rises again, points look right, and are another's. The Jacobian of
    the tangential and prism terms is at most 7 |p| r and 2 |s| r (4 |s| r^3): where the slope is larger there
    is no fold.
    """
    lens = _each(lens, lambda v: v.detach().to("cpu", torch.float64)[..., None])
    angles = torch.linspace(1 / RADII, 1, RADII, dtype=torch.float64)
    r = (limit.sqrt().atan()[..., None] * angles).tan()
    g, dg = _radial_factor(lens, r.square())
    slope = g + 2 * r.square() * dg
    constant, squared = _prism_sizes(lens)
    bound = r * (7 * torch.hypot(*lens.p) + 2 * constant) + 4 * r**3 * squared
    folds = slope <= bound
    ends = folds & ((~folds).flip(-1).cumsum(-1).flip(-1) > 0)  # the slope is larger again further out
    first = ends & ((ends.cumsum(-1) > 0) & ~folds).cumsum(-1).eq(0)
    least = torch.where(first, slope, torch.inf).argmin(-1, keepdim=True)
    return torch.where(first.any(-1), r.gather(-1, least)[..., 0].square(), limit)


RADII = 256
"""Number of radii, evenly spaced in angle, at which a dip of the slope is sought."""


def _brown_start(lens: Brown, target: Tensor, limit: Tensor) -> Tensor:
    """Solution for the radial terms alone."""

    def radius(r: Tensor) -> tuple[Tensor, Tensor]:
        g, dg = _radial_factor(lens, r * r)
        return r * g, g + 2 * r * r * dg

    wanted = norm(target)
    r = invert_increasing(radius, wanted, limit.sqrt().expand_as(wanted).to(wanted))
    return target * (r / torch.where(wanted > 0, wanted, 1.0))[..., None]


@torch.library.custom_op(
    "arraygeom::brown_inverse", mutates_args=(), schema="(Tensor c, Tensor target) -> (Tensor, Tensor)"
)
def _traced_brown_inverse(c: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse for torch.compile, which cannot follow iterations whose number depends on values."""
    solved, valid = _brown_inverse(c, target)
    return solved.contiguous(), valid.contiguous()


@_traced_brown_inverse.register_fake
def _(c: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    shape = broadcast_shapes(target.shape[:-1], c.shape[:-1])
    return target.new_empty((*shape, 2)), target.new_empty(shape, dtype=torch.bool)


def _brown_inverse(c: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Solution, and True where there is one; elsewhere the solution of the radial terms alone.

    Most points need a few steps. The rest are begun again by themselves, unless they are out of reach.
    """
    lens = Brown.named(c)
    limit = once(brown_limit, c).to(target)
    start = _brown_start(lens, target, limit)
    if traced():
        return _attempts(lens, limit, start, target)
    solved, valid = _attempt(lens, limit, start, start, target, steps=FEW)
    rest = ~valid & (norm(target) <= _reach(lens, limit))
    if not bool(rest.any()):
        return solved, valid

    def of_rest(v: Tensor) -> Tensor:
        return v.expand(rest.shape)[rest]

    rest_solved, valid_there = _attempts(_each(lens, of_rest), of_rest(limit), start[rest], target[rest])
    return solved.masked_scatter(rest[..., None], rest_solved), valid.masked_scatter(rest, valid_there)


def _reach(lens: Brown, limit: Tensor) -> Tensor:
    """Largest distorted radius of any point within the range: all terms at the limit."""
    radial = limit.sqrt() * _radial_factor(lens, limit)[0].abs()
    constant, squared = _prism_sizes(lens)
    tangential, prism = 3 * torch.hypot(*lens.p), constant + limit * squared
    return (radial + limit * (tangential + prism)) * (1 + MARGIN)


def _prism_sizes(lens: Brown) -> tuple[Tensor | float, Tensor | float]:
    """Sizes of the prism's terms in r^2 and in r^4."""
    if not lens.s:
        return 0.0, 0.0
    s1, s2, s3, s4 = lens.s
    return torch.hypot(s1, s3), torch.hypot(s2, s4)


FEW = 8
"""Newton steps that solve all points where none is near the turn."""


def _attempts(lens: Brown, limit: Tensor, start: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Solve with two further attempts from further in: near the turn a slope of nearly 0 leads nowhere."""
    solved, valid = start, torch.zeros_like(target[..., 0], dtype=torch.bool)
    for begin in (start, _pulled_in(start, 0.9 * limit), _pulled_in(target, 0.5 * limit)):
        begun = torch.where(valid[..., None], solved, begin)
        solved, valid = _attempt(lens, limit, start, begun, target, steps=MANY)
        if not traced() and bool(valid.all()):
            break
    return solved, valid


MANY = 30
"""Newton steps of an attempt near the turn."""


def _attempt(
    lens: Brown, limit: Tensor, start: Tensor, begun: Tensor, target: Tensor, *, steps: int
) -> tuple[Tensor, Tensor]:
    """Solutions by Newton's method from `begun`, and True where found; `start` elsewhere."""

    def distorted(xy: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        return _brown_planar(lens, xy)

    def within(xy: Tensor) -> Tensor:
        return xy.square().sum(-1) < BEYOND * limit

    attempt = solve_in_plane(distorted, begun, target, within, steps=steps)
    planar, jacobian = _brown_planar(lens, attempt)
    tolerance = SOLVED * torch.finfo(target.dtype).eps * (1 + norm(target))
    inside = attempt.square().sum(-1) < limit
    valid = (norm(planar - target) < tolerance) & inside & keeps_orientation(jacobian)
    return torch.where(valid[..., None], attempt, start), valid


def _each(lens: Brown, function: Callable[[Tensor], Tensor]) -> Brown:
    """Lens after a function of each of its coefficients, without its tilt."""
    (p1, p2), eighth = lens.p, lens.eighth
    return Brown(
        tuple(map(function, lens.k)),
        (function(p1), function(p2)),
        tuple(map(function, lens.s)),
        None,
        None if eighth is None else function(eighth),
    )


def _pulled_in(xy: Tensor, squared_radius: Tensor) -> Tensor:
    factor = (squared_radius / xy.square().sum(-1).clamp_min(1e-30)).sqrt()
    return xy * factor.clamp_max(1.0)[..., None]


def _tilt_matrix(lens: Brown) -> Tensor | None:
    """Homography (*b, 1.., 3, 3) of a sensor tilted by tx, ty about x, then y (OpenCV's)."""
    if lens.tilt is None:
        return None
    from kornia.geometry.calibration.distort import tilt_projection

    tx, ty = (angle.double()[..., None] for angle in lens.tilt)  # in float64, which autocast leaves alone
    return tilt_projection(tx, ty)


def _apply(H: Tensor | None, xy: Tensor) -> tuple[Tensor, Tensor]:
    """Homography H of points, and True for points on this side of the line that it sends to infinity."""
    if H is None:
        return xy, torch.ones_like(xy[..., 0], dtype=torch.bool)
    p = product(H.to(xy), to_homogeneous(xy)[..., None])[..., 0]
    ahead = p[..., 2] > 1 / WIDEST
    return p[..., :2] / torch.where(ahead, p[..., 2], 1.0)[..., None], ahead
