"""Further wide-angle models: radial maps of the direction, two of them followed by Brown-Conrady's
polynomials.

Directions are limited to the cone that the model reaches; those outside count as on its border, and are not
valid.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from typing import NamedTuple

import torch
from torch import Tensor

from ..pixels import safe_sqrt
from ..roots import first_root, invert_increasing
from ..runtime.tracing import traced
from .brown import brown_distort, brown_undistort
from .common import MARGIN, TINY, WIDEST, angle_over_radius, cosine_and_sinc, unit, within_limit

DOUBLE_SPHERE = "double-sphere"
EXTENDED_UNIFIED = "extended-unified"
UNIFIED = "unified"
FOV = "fov"
SCARAMUZZA = "scaramuzza"
THIN_PRISM_FISHEYE = "thin-prism-fisheye"


class _Model(NamedTuple):
    """Radial map, and its inverse in closed form or by iteration.

    Attributes:
        project: from coefficients and directions within the cone to points.
        unproject: from coefficients and points to directions of any length.
        limit: squared radius that is reached.
        bounds: bounds of the first coefficients of any lens.
        harmless: coefficients that replace invalid ones.
        planar: Brown-Conrady's coefficients of the second stage; None for none.
    """

    project: Callable[[Tensor, Tensor], Tensor]
    unproject: Callable[[Tensor, Tensor], Tensor]
    limit: Callable[[Tensor], Tensor]
    bounds: tuple[tuple[float, float], ...]
    harmless: tuple[float, ...]
    planar: Callable[[Tensor], Tensor | None] = lambda _: None


def central_project(model: str, c: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    """Project directions (*n, 3) of any length in the camera's frame.

    Args:
        model: name of a model in `MODELS`, such as "double-sphere"; another one raises KeyError.
        c: coefficients (*b, 1.., k) of the model, in its order.

    Returns:
        Distorted normalised points (*n, 2), and True (*n) within the cone and the range that the model sees
        and for coefficients within its bounds; for others points mean nothing. Other directions give the
        nearest point of the cone's border, zero and straight behind (0, 0). NaN is not looked for.
    """
    kind = MODELS[model]
    c, sound = _sound(kind, c)
    _, sine, cosine = (v.to(X) for v in _border(kind, c))
    xy, z = X[..., :2], X[..., 2]
    u = xy.square().sum(-1)
    off_axis = u > 0
    rho = torch.where(off_axis, u, 1.0).sqrt()
    inside = (off_axis | (z > 0)) & (
        z > cosine * torch.where(off_axis, u + z.square(), z.square()).clamp(min=TINY).sqrt()
    )
    border = torch.cat([xy * (sine / rho)[..., None], cosine.expand_as(z)[..., None]], -1)
    border = torch.where(off_axis[..., None], border, X.new_tensor([0.0, 0.0, 1.0]))
    point, valid = kind.project(c, torch.where(inside[..., None], X, border)), inside & sound
    planar = kind.planar(c)
    if planar is None:
        return point, valid
    point, within = brown_distort(planar, point)
    return point, valid & within


def central_unproject(model: str, c: Tensor, xy_d: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the unit directions of distorted normalised points (*n, 2): the inverse of `central_project`.

    Args:
        model: name of a model in `MODELS`; another one raises KeyError.
        c: coefficients (*b, 1.., k) of the model.

    Returns:
        Directions (*n, 3) in the camera's frame, and True (*n) for points within the model's image and for
        coefficients within its bounds; further out the direction at the border. NaN is not looked for.
    """
    kind = MODELS[model]
    c, valid = _sound(kind, c)
    planar = kind.planar(c)
    if planar is not None:
        xy_d, within = brown_undistort(planar, xy_d)
        valid = valid & within
    limit, _, _ = (v.to(xy_d) for v in _border(kind, c))
    inside, pull = within_limit(xy_d.square().sum(-1), limit)
    return unit(kind.unproject(c, xy_d * pull[..., None])), valid & inside


def within_bounds(kind: _Model, c: Tensor) -> Tensor:
    """Clamp coefficients to the bounds of a model."""
    free = ((-torch.inf, torch.inf),) * (c.shape[-1] - len(kind.bounds))
    low, high = c.new_tensor([*kind.bounds, *free]).T
    return c.clamp(low, high)


def _sound(kind: _Model, c: Tensor) -> tuple[Tensor, Tensor]:
    sound = (within_bounds(kind, c.detach()) == c.detach()).all(-1) & c.detach().isfinite().all(-1)
    if not traced() and bool(sound.all()):
        return c, sound
    return torch.where(sound[..., None], c, c.new_tensor(kind.harmless)), sound


@torch.no_grad()
def _border(kind: _Model, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Squared radius at the end of the range, and its angle's sine and cosine (*b, 1..): float64, CPU."""
    c = c.detach().to("cpu", torch.float64)
    limit = kind.limit(c).clamp(max=WIDEST**2) * (1 - MARGIN)
    ray = unit(kind.unproject(c, torch.stack([limit.sqrt(), torch.zeros_like(limit)], -1)))
    return limit, ray[..., 0], ray[..., 2]


def _reciprocal(x: Tensor) -> Tensor:
    """1 / x where x is positive, else infinity."""
    return torch.where(x > 0, 1 / torch.where(x > 0, x, 1.0), torch.inf)


# Spheres ----------------------------------------------------------------------------------------------------


def _double_sphere(c: Tensor, X: Tensor) -> Tensor:
    xi, alpha = c.unbind(-1)
    u, z = X[..., :2].square().sum(-1), X[..., 2]
    z = xi * (u + z.square()).sqrt() + z
    return X[..., :2] / (alpha * (u + z.square()).sqrt() + (1 - alpha) * z)[..., None]


def _double_sphere_inverse(c: Tensor, xy: Tensor) -> Tensor:
    xi, alpha = c.unbind(-1)
    u = xy.square().sum(-1)
    z = (1 - alpha.square() * u) / (alpha * (1 - (2 * alpha - 1) * u).sqrt() + 1 - alpha)
    length = (z * xi + (z.square() + (1 - xi.square()) * u).sqrt()) / (z.square() + u)
    return torch.cat([length[..., None] * xy, (length * z - xi)[..., None]], -1)


def _extended_unified(c: Tensor, X: Tensor) -> Tensor:
    alpha, beta = c.unbind(-1)
    u, z = X[..., :2].square().sum(-1), X[..., 2]
    return X[..., :2] / (alpha * (beta * u + z.square()).sqrt() + (1 - alpha) * z)[..., None]


def _extended_unified_inverse(c: Tensor, xy: Tensor) -> Tensor:
    alpha, beta = c.unbind(-1)
    u = beta * xy.square().sum(-1)
    z = (1 - alpha.square() * u) / (alpha * (1 - (2 * alpha - 1) * u).sqrt() + 1 - alpha)
    return torch.cat([xy, z[..., None]], -1)


def _unified(c: Tensor, X: Tensor) -> Tensor:
    return X[..., :2] / (X[..., 2] + c[..., 0] * X.square().sum(-1).sqrt())[..., None]


def _unified_inverse(c: Tensor, xy: Tensor) -> Tensor:
    xi, u = c[..., 0], xy.square().sum(-1)
    length = (xi + (1 + (1 - xi.square()) * u).sqrt()) / (1 + u)
    return torch.cat([length[..., None] * xy, (length - xi)[..., None]], -1)


# Angles -----------------------------------------------------------------------------------------------------


def _fov(c: Tensor, X: Tensor) -> Tensor:
    omega = c[..., 0]
    double = 2 * (omega / 2).tan()
    angle = angle_over_radius(double.square() * X[..., :2].square().sum(-1), X[..., 2])
    return X[..., :2] * (angle * double / omega)[..., None]


def _fov_inverse(c: Tensor, xy: Tensor) -> Tensor:
    omega = c[..., 0]
    cosine, sinc = cosine_and_sinc(omega.square() * xy.square().sum(-1))
    return torch.cat([xy * (sinc * omega / (2 * (omega / 2).tan()))[..., None], cosine[..., None]], -1)


def _equidistant(_: Tensor, X: Tensor) -> Tensor:
    return X[..., :2] * angle_over_radius(X[..., :2].square().sum(-1), X[..., 2])[..., None]


def _equidistant_inverse(_: Tensor, xy: Tensor) -> Tensor:
    cosine, sinc = cosine_and_sinc(xy.square().sum(-1))
    return torch.cat([xy * sinc[..., None], cosine[..., None]], -1)


def _prism_coefficients(c: Tensor) -> Tensor:
    """Coefficients k1 k2 p1 p2 k3 k4 sx1 sy1 as Brown-Conrady's 14 and the factor of r^8."""
    k1, k2, p1, p2, k3, k4, sx, sy = c.unbind(-1)
    none = torch.zeros_like(k1)
    return torch.stack([k1, k2, p1, p2, k3, none, none, none, sx, none, sy, none, none, none, k4], -1)


# Scaramuzza -------------------------------------------------------------------------------------------------


def _along(c: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
    """Depth of a point at radius r, 1 + b2 r^2 + b3 r^3 + b4 r^4, and its slope."""
    b2, b3, b4 = c.unbind(-1)
    return 1 + r * r * (b2 + r * (b3 + r * b4)), r * (2 * b2 + r * (3 * b3 + r * 4 * b4))


def _scaramuzza_inverse(c: Tensor, xy: Tensor) -> Tensor:
    r = safe_sqrt(xy.square().sum(-1))
    return torch.cat([xy, _along(c, r)[0][..., None]], -1)


def _scaramuzza(c: Tensor, X: Tensor) -> Tensor:
    """Solve s z = 1 + b2 (s R)^2 + ... for s, the radius over R = |(X, Y)|: smooth on the axis too."""
    R, z = safe_sqrt(X[..., :2].square().sum(-1)), X[..., 2]
    angle = torch.atan2(R, z).detach()
    start = _traced_scaramuzza_radius if torch.compiler.is_compiling() else _scaramuzza_radius
    r = start(c.detach(), angle)
    s = torch.where(R > 0, r / torch.where(R > 0, R, 1.0), 1 / torch.where(R > 0, 1.0, z)).detach()
    for _ in range(2):
        depth, slope = _along(c, s * R)
        turn = z - R * slope
        step = (s * z - depth) / torch.where(turn != 0, turn, 1.0)
        # at the end of the range the slope is rounding
        s = s - torch.where(step.abs() < 0.1 * s.abs(), step, 0.0)
    return X[..., :2] * s[..., None]


@torch.no_grad()
def _scaramuzza_radius(c: Tensor, angle: Tensor) -> Tensor:
    def seen_at(r: Tensor) -> tuple[Tensor, Tensor]:
        depth, slope = _along(c, r)
        return torch.atan2(r, depth), (depth - r * slope) / (r.square() + depth.square())

    high = _scaramuzza_limit(c).clamp(max=WIDEST**2).sqrt().to(angle)
    return invert_increasing(seen_at, angle, high.expand_as(angle))


@torch.library.custom_op(
    "arraygeom::scaramuzza_radius", mutates_args=(), schema="(Tensor c, Tensor angle) -> Tensor"
)
def _traced_scaramuzza_radius(c: Tensor, angle: Tensor) -> Tensor:
    """Radius for torch.compile, which cannot follow iterations whose number depends on values."""
    return _scaramuzza_radius(c, angle).contiguous()


@_traced_scaramuzza_radius.register_fake
def _(c: Tensor, angle: Tensor) -> Tensor:
    return torch.empty_like(angle, memory_format=torch.contiguous_format)


def _scaramuzza_limit(c: Tensor) -> Tensor:
    """Squared radius up to which the angle rises: depth - r depth' = 1 - b2 r^2 - 2 b3 r^3 - 3 b4 r^4 > 0."""
    b = c.detach().to("cpu", torch.float64)
    one, none = torch.ones_like(b[..., :1]), torch.zeros_like(b[..., :1])
    return first_root(torch.cat([one, none, -b * b.new_tensor([1.0, 2.0, 3.0])], -1)).square()


SMALLEST = 1e-6
MODELS: dict[str, _Model] = {
    DOUBLE_SPHERE: _Model(
        _double_sphere,
        _double_sphere_inverse,
        lambda c: _reciprocal(2 * c[..., 1] - 1),
        ((SMALLEST - 1, 1 - SMALLEST), (0, 1)),
        (0.0, 0.5),
    ),
    EXTENDED_UNIFIED: _Model(
        _extended_unified,
        _extended_unified_inverse,
        lambda c: _reciprocal(c[..., 1] * (2 * c[..., 0] - 1)),
        ((0, 1), (SMALLEST, torch.inf)),
        (0.5, 1.0),
    ),
    UNIFIED: _Model(
        _unified,
        _unified_inverse,
        lambda c: _reciprocal(c[..., 0].square() - 1),
        ((0, torch.inf),),
        (0.5, 0.0, 0.0, 0.0, 0.0),
        lambda c: c[..., 1:],
    ),
    FOV: _Model(
        _fov,
        _fov_inverse,
        lambda c: ((2 * WIDEST * (c[..., 0] / 2).tan()).atan() / c[..., 0]).square(),
        ((SMALLEST, pi - SMALLEST),),
        (1.0,),
    ),
    SCARAMUZZA: _Model(_scaramuzza, _scaramuzza_inverse, _scaramuzza_limit, (), (0.0,) * 3),
    THIN_PRISM_FISHEYE: _Model(
        _equidistant,
        _equidistant_inverse,
        lambda c: torch.full_like(c[..., 0], pi**2),
        (),
        (0.0,) * 8,
        _prism_coefficients,
    ),
}
