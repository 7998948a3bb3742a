"""Lens models: undistorted to distorted points, and back.

All points here are *normalised*: for a pinhole (x, y) = (X / Z, Y / Z) in the camera's frame (x right, y down,
z forward), before the focal length and the principal point. Distorted points are what K multiplies to give
pixels.

Two models, with their coefficients in OpenCV's order:

- ``brown-conrady``: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]], 4, 5, 8, 12 or 14 numbers: rational
  radial, tangential, thin-prism and tilted-sensor terms (OpenCV's ``projectPoints``; Brown 1966, Conrady 1919).
- ``kannala-brandt``: k1 k2 k3 k4, the angle theta from the optical axis goes to the radius
  theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (Kannala and Brandt 2006; OpenCV's ``fisheye``,
  Kalibr's ``equidistant``, COLMAP's ``OPENCV_FISHEYE``).

Both are polynomials that follow the lens up to some radius and turn back beyond it. Points past the turn are
not valid; their values stay finite and bounded (the point is moved in to the turn first).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .batching import Batched
from .pixels import floating, product
from .roots import first_root, invert_increasing
from .text import distortion_text
from .tracing import traced

BROWN_CONRADY = "brown-conrady"
KANNALA_BRANDT = "kannala-brandt"
COEFFICIENT_COUNTS = {BROWN_CONRADY: (4, 5, 8, 12, 14), KANNALA_BRANDT: (4,)}

# The range of validity ends this fraction (of the squared radius) inside the turn, where the inverse is still
# good to 1e-6 px in float64.
MARGIN = 1e-6
# Nothing past this normalised radius is valid under Brown-Conrady: 89.94 degrees off axis.
WIDEST = 1e3
# A denominator of the rational model this close (in squared radius) to its zero gives radii that mean nothing.
POLE = 0.9
# How far beyond the limit the search for an inverse may pass (in squared radius); short of a pole.
BEYOND = 1.1
# Squared radii are at least this in divisions, for lenses that are valid nowhere.
TINY = 1e-30
# An inverse counts as found from this residual on, in units of rounding.
SOLVED = 64


@dataclass(frozen=True, eq=False, repr=False)
class Distortion(Batched):
    """One lens, or a batch of lenses of one model.

    The batch axes of `coefficients` meet the *leading* axes of the points: coefficients (5, 8) go with points
    (5, 2), (5, 100, 2), (5, 20, 30, 2). Points are independent of each other; all maps are differentiable, twice,
    in the points and the coefficients.

    Raises ValueError for an unknown model or a number of coefficients that the model does not have.
    """

    item_axes: ClassVar = {"coefficients": 1}
    model: str
    coefficients: Float[Tensor, "*b n"]

    def __post_init__(self) -> None:
        if self.model not in COEFFICIENT_COUNTS:
            raise ValueError(f"unknown lens model {self.model!r}: use one of {', '.join(COEFFICIENT_COUNTS)}")
        counts = COEFFICIENT_COUNTS[self.model]
        if self.coefficients.shape[-1] not in counts:
            given, wanted = self.coefficients.shape[-1], " or ".join(map(str, counts))
            raise ValueError(f"{self.model} takes {wanted} coefficients, got {given}: pad with zeros")

    @property
    def is_identity(self) -> bool:
        """Whether this lens distorts nothing: Brown-Conrady with all coefficients 0."""
        return self.model == BROWN_CONRADY and not bool(self.coefficients.any())

    def distort(self, xy: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Normalised pinhole points to distorted ones, and which are inside the model's range."""
        xy, finite = _finite(xy)
        if self.model == KANNALA_BRANDT:
            xy_d, valid = _fisheye_project(self._lifted(xy), _homogeneous(xy))
        else:
            xy_d, valid = _brown_distort(self._lifted(xy), xy)
        return xy_d, valid & finite

    def undistort(self, xy_d: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Distorted points to normalised pinhole ones: the inverse of `distort`, iterated to convergence.

        A fisheye ray at 90 degrees or more has no pinhole point and is not valid: see `unproject`.
        """
        xy_d, finite = _finite(xy_d)
        if self.model == KANNALA_BRANDT:
            ray, valid = _fisheye_unproject(self._lifted(xy_d), xy_d)
            ahead = ray[..., 2] > 1 / WIDEST
            xy, valid = ray[..., :2] / torch.where(ahead, ray[..., 2], 1 / WIDEST)[..., None], valid & ahead
        else:
            xy, valid = _brown_undistort(self._lifted(xy_d), xy_d)
        return xy, valid & finite

    def project(self, X: Real[Tensor, "*n 3"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Points in the camera's frame (any unit) to distorted normalised points.

        Brown-Conrady: only points ahead (z > 0) are valid. Kannala-Brandt: any direction that the polynomial
        reaches is, also at and beyond 90 degrees off axis; the point (0, 0, 0) is not.
        """
        X, finite = _finite(X)
        if self.model == KANNALA_BRANDT:
            xy_d, valid = _fisheye_project(self._lifted(X), X)
            return xy_d, valid & finite
        ahead = X[..., 2] > 0
        xy_d, valid = self.distort(X[..., :2] / torch.where(ahead, X[..., 2], 1)[..., None])
        return xy_d, valid & ahead & finite

    def unproject(self, xy_d: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 3"], Bool[Tensor, "*n"]]:
        """Distorted normalised points to unit directions in the camera's frame: the inverse of `project`."""
        if self.model == KANNALA_BRANDT:
            xy_d, finite = _finite(xy_d)
            ray, valid = _fisheye_unproject(self._lifted(xy_d), xy_d)
            return ray, valid & finite
        xy, valid = self.undistort(xy_d)
        return _unit(_homogeneous(xy)), valid

    def _text(self) -> str:
        return distortion_text(self)

    @property
    def squared_limit(self) -> float:
        """Up to where one lens is valid: a squared normalised radius, or a squared angle (Kannala-Brandt)."""
        c = self.coefficients.detach()
        return float(_fisheye_limit(c) if self.model == KANNALA_BRANDT else _brown_limit(_Brown.named(c)))

    def _lifted(self, points: Tensor) -> Tensor:
        """Coefficients (*b, 1.., n): the batch axes in front, one axis of length 1 for each further axis."""
        c = self.coefficients
        return c.reshape(*c.shape[:-1], *[1] * (points.ndim - c.ndim), c.shape[-1])


# Brown-Conrady ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Brown:
    """The 14 coefficients by name (absent ones 0), each of shape (*b, 1..)."""

    k: tuple[Tensor, ...]
    p: tuple[Tensor, Tensor]
    s: tuple[Tensor, ...]
    tilt: tuple[Tensor, Tensor] | None

    @staticmethod
    def named(c: Tensor) -> _Brown:
        n = c.shape[-1]
        padded = list(torch.cat([c, c.new_zeros((*c.shape[:-1], 14 - n))], -1).unbind(-1))
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty = padded
        return _Brown((k1, k2, k3, k4, k5, k6), (p1, p2), (s1, s2, s3, s4), (tx, ty) if n == 14 else None)


def _brown_distort(c: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
    lens = _Brown.named(c)
    limit = _brown_limit(lens).to(xy)
    squared = xy.square().sum(-1)
    inside = squared < limit
    pull = torch.where(inside, 1.0, (limit / torch.where(inside, 1.0, squared.clamp(min=TINY))).sqrt())
    planar, jacobian = _brown_planar(lens, xy * pull[..., None])
    tilted, ahead = _tilt(lens, planar)
    return tilted, inside & _orients(jacobian) & ahead


def _brown_undistort(c: Tensor, xy_d: Tensor) -> tuple[Tensor, Tensor]:
    """Undo the tilt exactly, solve for the radius in a bracket, then for (x, y) by Newton.

    The last two Newton steps are differentiable: from a solution that is a constant, one step propagates the
    first derivatives and the next one the second (the error of a Newton step is the square of the one before).
    """
    lens = _Brown.named(c)
    target, ahead = _untilt(lens, xy_d)
    with torch.no_grad():
        inverse = _traced_brown_inverse if torch.compiler.is_compiling() else _brown_inverse_of
        solved, valid = inverse(c.detach(), target.detach())
    safe_target = torch.where(valid[..., None], target, 0.0)
    xy = torch.where(valid[..., None], solved, 0.0)
    for _ in range(2):
        xy = xy - _newton_step(*_brown_planar(lens, xy), safe_target)
    return torch.where(valid[..., None], xy, solved), valid & ahead


def _brown_planar(lens: _Brown, xy: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Everything but the tilt, and its Jacobian (dx'/dx, dx'/dy, dy'/dx, dy'/dy)."""
    x, y = xy.unbind(-1)
    (p1, p2), (s1, s2, s3, s4) = lens.p, lens.s
    u = x * x + y * y
    g, dg = _radial_factor(lens, u)
    x_d = x * g + 2 * p1 * x * y + p2 * (u + 2 * x * x) + u * (s1 + s2 * u)
    y_d = y * g + p1 * (u + 2 * y * y) + 2 * p2 * x * y + u * (s3 + s4 * u)
    cross, prism_x, prism_y = 2 * (x * y * dg + p1 * x + p2 * y), 2 * (s1 + 2 * s2 * u), 2 * (s3 + 2 * s4 * u)
    xx = g + 2 * x * x * dg + 2 * p1 * y + 6 * p2 * x + prism_x * x
    yy = g + 2 * y * y * dg + 6 * p1 * y + 2 * p2 * x + prism_y * y
    return torch.stack([x_d, y_d], -1), (xx, cross + prism_x * y, cross + prism_y * x, yy)


def _radial_factor(lens: _Brown, u: Tensor) -> tuple[Tensor, Tensor]:
    """g = (1 + k1 u + k2 u^2 + k3 u^3) / (1 + k4 u + k5 u^2 + k6 u^3) of the squared radius u, and dg/du."""
    k1, k2, k3, k4, k5, k6 = lens.k
    top, bottom = 1 + u * (k1 + u * (k2 + u * k3)), 1 + u * (k4 + u * (k5 + u * k6))
    d_top, d_bottom = k1 + u * (2 * k2 + 3 * u * k3), k4 + u * (2 * k5 + 3 * u * k6)
    g = top / bottom
    return g, (d_top - g * d_bottom) / bottom


@torch.no_grad()
def _brown_limit(lens: _Brown) -> Tensor:
    """The squared radius up to which the radial part r g(r^2) rises: float64 on the CPU, shape (*b, 1..).

    With g = N / D the slope is P / D^2, P(u) = (N + 2 u N') D - 2 u N D', of degree 6 with P(0) = 1.
    """
    k1, k2, k3, k4, k5, k6 = (k.detach().to("cpu", torch.float64) for k in lens.k)
    one = torch.ones_like(k1)
    rising = _product((one, 3 * k1, 5 * k2, 7 * k3), (one, k4, k5, k6))
    falling = _product((one, k1, k2, k3), (0 * one, 2 * k4, 4 * k5, 6 * k6))
    turn = first_root(torch.stack([a - b for a, b in zip(rising, falling)], -1))
    pole = first_root(torch.stack([one, k4, k5, k6], -1))
    return torch.minimum(torch.minimum(turn * (1 - MARGIN), pole * POLE), one * WIDEST**2)


def _brown_start(lens: _Brown, target: Tensor, limit: Tensor) -> Tensor:
    """The solution if there were only the radial terms."""

    def radius(r: Tensor) -> tuple[Tensor, Tensor]:
        g, dg = _radial_factor(lens, r * r)
        return r * g, g + 2 * r * r * dg

    wanted = _norm(target)
    r = invert_increasing(radius, wanted, limit.sqrt().expand_as(wanted).to(wanted))
    return target * (r / torch.where(wanted > 0, wanted, 1.0))[..., None]


def _brown_inverse_of(c: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    lens = _Brown.named(c)
    return _brown_inverse(lens, target, _brown_limit(lens).to(target))


@torch.library.custom_op(
    "arraygeom::brown_inverse", mutates_args=(), schema="(Tensor c, Tensor target) -> (Tensor, Tensor)"
)
def _traced_brown_inverse(c: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """The same for torch.compile, which cannot follow iterations that numbers end."""
    solved, valid = _brown_inverse_of(c, target)
    return solved.contiguous(), valid.contiguous()


@_traced_brown_inverse.register_fake
def _(c: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    shape = torch.broadcast_shapes(target.shape[:-1], c.shape[:-1])
    return target.new_empty((*shape, 2)), target.new_empty(shape, dtype=torch.bool)


def _brown_inverse(lens: _Brown, target: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    """The solution and whether there is one; where not, the solution of the radial terms alone.

    Close to the turn the slope is nearly 0 and leads nowhere, hence two more attempts from further in.
    """
    start = solved = _brown_start(lens, target, limit)
    valid = torch.zeros_like(target[..., 0], dtype=torch.bool)
    for begin in (start, _pulled_in(start, 0.9 * limit), _pulled_in(target, 0.5 * limit)):
        attempt = _brown_solve(lens, torch.where(valid[..., None], solved, begin), target, limit)
        planar, jacobian = _brown_planar(lens, attempt)
        tolerance = SOLVED * torch.finfo(target.dtype).eps * (1 + _norm(target))
        valid = (_norm(planar - target) < tolerance) & (attempt.square().sum(-1) < limit) & _orients(jacobian)
        solved = torch.where(valid[..., None], attempt, start)
        if not traced() and bool(valid.all()):
            break
    return solved, valid


def _pulled_in(xy: Tensor, squared_radius: Tensor) -> Tensor:
    factor = (squared_radius / xy.square().sum(-1).clamp_min(1e-30)).sqrt()
    return xy * factor.clamp_max(1.0)[..., None]


def _brown_solve(lens: _Brown, xy: Tensor, target: Tensor, limit: Tensor, iterations: int = 30) -> Tensor:
    """Newton, with halved steps where a whole one goes too far or does not help."""
    planar, jacobian = _brown_planar(lens, xy)
    error, scale = _norm(planar - target), torch.ones_like(target[..., 0])
    enough = 2 * torch.finfo(target.dtype).eps * (1 + _norm(target))
    for _ in range(iterations):
        if not traced() and bool(((error <= enough) | (scale < 1e-3)).all()):
            break
        trial = xy - scale[..., None] * _newton_step(planar, jacobian, target)
        planar_trial, jacobian_trial = _brown_planar(lens, trial)
        error_trial = _norm(planar_trial - target)
        better = (error_trial < error) & (trial.square().sum(-1) < BEYOND * limit)
        xy, planar = (torch.where(better[..., None], a, b) for a, b in ((trial, xy), (planar_trial, planar)))
        jacobian = tuple(torch.where(better, a, b) for a, b in zip(jacobian_trial, jacobian))  # type: ignore[assignment]
        error, scale = torch.where(better, error_trial, error), torch.where(better, 1.0, scale / 2)
    return xy


def _newton_step(value: Tensor, jacobian: tuple[Tensor, Tensor, Tensor, Tensor], target: Tensor) -> Tensor:
    xx, xy, yx, yy = jacobian
    ex, ey = (value - target).unbind(-1)
    determinant = xx * yy - xy * yx
    determinant = torch.where(determinant.abs() < 1e-12, 1e-12, determinant)
    return torch.stack([(yy * ex - xy * ey) / determinant, (xx * ey - yx * ex) / determinant], -1)


def _orients(jacobian: tuple[Tensor, Tensor, Tensor, Tensor]) -> Tensor:
    """Whether the map keeps orientation here: past a fold it mirrors, past two it rotates by 180 degrees."""
    xx, xy, yx, yy = jacobian
    return (xx * yy - xy * yx > 0) & (xx + yy > 0)


def _tilt_matrix(lens: _Brown) -> Tensor | None:
    """The homography (*b, 1.., 3, 3) of a sensor tilted by tx, ty about x, then y (OpenCV's)."""
    if lens.tilt is None:
        return None
    from kornia.geometry.calibration.distort import tilt_projection

    tx, ty = (angle.double()[..., None] for angle in lens.tilt)  # in float64, which autocast leaves alone
    return tilt_projection(tx, ty)


def _tilt(lens: _Brown, xy: Tensor) -> tuple[Tensor, Tensor]:
    H = _tilt_matrix(lens)
    return _apply(H, xy)


def _untilt(lens: _Brown, xy: Tensor) -> tuple[Tensor, Tensor]:
    H = _tilt_matrix(lens)
    return _apply(H if H is None else torch.linalg.inv(H), xy)


def _apply(H: Tensor | None, xy: Tensor) -> tuple[Tensor, Tensor]:
    """The homography H of points, and which lie on this side of the line it sends to infinity."""
    if H is None:
        return xy, torch.ones_like(xy[..., 0], dtype=torch.bool)
    p = product(H.to(xy), _homogeneous(xy)[..., None])[..., 0]
    ahead = p[..., 2] > 1 / WIDEST
    return p[..., :2] / torch.where(ahead, p[..., 2], 1.0)[..., None], ahead


# Kannala-Brandt ---------------------------------------------------------------------------------------------


def _fisheye_project(c: Tensor, X: Tensor) -> tuple[Tensor, Tensor]:
    xy, z = X[..., :2], X[..., 2]
    u = xy.square().sum(-1)
    ratio = _angle_over_radius(u, z)
    v = u * ratio.square()
    limit = _fisheye_limit(c).to(v)
    inside = v < limit
    pull = torch.where(inside, 1.0, (limit / torch.where(inside, 1.0, v.clamp(min=TINY))).sqrt())
    p, _ = _fisheye_factor(c, torch.where(inside, v, limit))
    return xy * (ratio * pull * p)[..., None], inside & ((u > 0) | (z > 0))


def _fisheye_unproject(c: Tensor, xy_d: Tensor) -> tuple[Tensor, Tensor]:
    """Solve v p(v)^2 = |xy_d|^2 for the squared angle v: smooth on the axis too, where the angle is not."""
    limit = _fisheye_limit(c).to(xy_d)
    u_d = xy_d.square().sum(-1)
    outermost = limit * _fisheye_factor(c, limit)[0].square()
    inside = u_d < outermost
    pull = torch.where(inside, 1.0, (outermost / torch.where(inside, 1.0, u_d.clamp(min=TINY))).sqrt())
    xy_d = xy_d * pull[..., None]
    u_d = torch.where(inside, u_d, outermost)
    start = _traced_fisheye_start if torch.compiler.is_compiling() else _fisheye_start
    v = start(c.detach(), u_d.detach(), limit)
    for _ in range(2):
        p, slope = _fisheye_factor(c, v)
        v = v - (v * p.square() - u_d) / (p * slope)
    p, _ = _fisheye_factor(c, v)
    inside = inside & ((v * p.square() - u_d).abs() <= SOLVED * torch.finfo(u_d.dtype).eps * (1 + u_d))
    cosine, sinc = _cosine_and_sinc(v)
    return _unit(torch.cat([xy_d * (sinc / p)[..., None], cosine[..., None]], -1)), inside


@torch.no_grad()
def _fisheye_start(c: Tensor, u_d: Tensor, limit: Tensor) -> Tensor:
    def radius(theta: Tensor) -> tuple[Tensor, Tensor]:
        p, slope = _fisheye_factor(c, theta.square())
        return theta * p, slope

    return invert_increasing(radius, u_d.sqrt(), limit.sqrt().expand_as(u_d)).square()


@torch.library.custom_op(
    "arraygeom::fisheye_start", mutates_args=(), schema="(Tensor c, Tensor u_d, Tensor limit) -> Tensor"
)
def _traced_fisheye_start(c: Tensor, u_d: Tensor, limit: Tensor) -> Tensor:
    """The same for torch.compile, which cannot follow iterations that numbers end."""
    return _fisheye_start(c, u_d, limit).contiguous()


@_traced_fisheye_start.register_fake
def _(c: Tensor, u_d: Tensor, limit: Tensor) -> Tensor:
    return torch.empty_like(u_d, memory_format=torch.contiguous_format)


def _fisheye_factor(c: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """p = theta_d / theta and slope = d theta_d / d theta of the squared angle v."""
    k1, k2, k3, k4 = c.unbind(-1)
    p = 1 + v * (k1 + v * (k2 + v * (k3 + v * k4)))
    return p, 1 + v * (3 * k1 + v * (5 * k2 + v * (7 * k3 + v * 9 * k4)))


@torch.no_grad()
def _fisheye_limit(c: Tensor) -> Tensor:
    """The squared angle up to which the radius rises, at most pi^2: float64 on the CPU, shape (*b, 1..)."""
    odd = torch.tensor([3.0, 5.0, 7.0, 9.0], dtype=torch.float64)
    slope = torch.cat([torch.ones_like(c[..., :1]).to(odd), c.detach().to(odd) * odd], -1)
    return first_root(slope).clamp_max(pi**2) * (1 - MARGIN)


def _angle_over_radius(u: Tensor, z: Tensor) -> Tensor:
    """theta / r of the squared radius u and the depth z, by its series near the axis."""
    near = (z > 0) & (u < 1e-3 * z.square())
    z_near = torch.where(near, z, 1.0)
    t = torch.where(near, u, 0.0) / z_near.square()
    series = (1 - t * (1 / 3 - t * (1 / 5 - t * (1 / 7 - t * (1 / 9 - t / 11))))) / z_near
    plain = ~near & (u > 0)
    r = torch.where(plain, u, 1.0).sqrt()
    return torch.where(near, series, torch.atan2(r, torch.where(plain, z, 1.0)) / r)


def _cosine_and_sinc(v: Tensor) -> tuple[Tensor, Tensor]:
    """cos(theta) and sin(theta) / theta of the squared angle v, by their series near 0."""
    near = v < 1e-3
    s, theta = torch.where(near, v, 0.0), torch.where(near, 1.0, v).sqrt()
    cosine = 1 - s * (1 / 2 - s * (1 / 24 - s * (1 / 720 - s / 40320)))
    sinc = 1 - s * (1 / 6 - s * (1 / 120 - s * (1 / 5040 - s / 362880)))
    return torch.where(near, cosine, theta.cos()), torch.where(near, sinc, theta.sin() / theta)


# Shared -----------------------------------------------------------------------------------------------------


def _product(a: tuple[Tensor, ...], b: tuple[Tensor, ...]) -> list[Tensor]:
    """The coefficients of the product of two polynomials."""
    terms: list[Tensor] = [torch.zeros_like(a[0])] * (len(a) + len(b) - 1)
    for i, a_i in enumerate(a):
        for j, b_j in enumerate(b):
            terms[i + j] = terms[i + j] + a_i * b_j
    return terms


def _homogeneous(xy: Tensor) -> Tensor:
    return torch.cat([xy, torch.ones_like(xy[..., :1])], -1)


def _unit(ray: Tensor) -> Tensor:
    return ray / _norm(ray)[..., None]


def _norm(xy: Tensor) -> Tensor:
    return xy.square().sum(-1).sqrt()


def _finite(points: Tensor) -> tuple[Tensor, Tensor]:
    """Points with those that hold a NaN or an infinity at the origin, and which did not."""
    points = floating(points)
    finite = points.isfinite().all(-1)
    return torch.where(finite[..., None], points, 0.0), finite
