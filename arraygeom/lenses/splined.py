"""Splined lenses: a smooth surface of B-splines in place of a formula, for any lens and a sensor's
unevenness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import checking
from ..pixels import broadcast_shapes
from ..roots import keeps_orientation, newton_step, solve_in_plane
from ..runtime.tracing import traced
from .common import SOLVED, finite_points, norm
from .model import CameraModel, beside_points

STEREOGRAPHIC, PINHOLE = "stereographic", "pinhole"
SUPPORT = {2: 3, 3: 4}
"""Knots on a side that a point depends on, by the order of the splines."""
STEPS, MOST = 6, 30
"""Newton steps for all points, and for those that need more."""
NEARLY = 1e-6
"""Margin at the border: of a knot's spacing to the last whole one, and of the squared sine to 90 degrees."""


@dataclass(frozen=True, eq=False, repr=False)
class Splined(CameraModel, name="splined"):
    """Camera model of a simple projection plus a displacement, given by a surface of B-splines.

    The surface is over the stereographic projection of directions, points u of length 2 tan(theta / 2).
    Valid are directions at least half a spacing (cubic: a whole one) within the outermost knots, and before
    any fold.

    Attributes:
        knots: displacements (*b, ny, nx, 2) along x and y of the image plane, the middle knot at u = 0.
        spacing: distance (*b, 2) of the knots in u along x and y.
        order: 2 (quadratic) or 3 (cubic).
        base: displaced projection: "stereographic" (mrcal's LENSMODEL_SPLINED_STEREOGRAPHIC), or "pinhole" (x
            / z, y / z) (lensboy's pinhole_splined), which has no directions at 90 degrees or more off axis.

    Raises:
        ValueError: for another base or order, knots or a spacing of another shape, fewer than 3 (cubic: 4)
            knots to a side, and a spacing that is not positive.
    """

    item_axes: ClassVar = {"knots": 3, "spacing": 1}
    knots: Float[Tensor, "*b ny nx 2"]
    spacing: Float[Tensor, "*b 2"]
    order: int = 3
    base: str = STEREOGRAPHIC

    def __post_init__(self) -> None:
        if self.base not in (STEREOGRAPHIC, PINHOLE):
            raise ValueError(f"base is {self.base!r}: use {STEREOGRAPHIC!r} or {PINHOLE!r}")
        if self.order not in SUPPORT:
            raise ValueError(f"order is {self.order!r}: splines of order 2 and 3 are known")
        if (
            self.knots.ndim < 3
            or self.knots.shape[-1] != 2
            or min(self.knots.shape[-3:-1]) < SUPPORT[self.order]
        ):
            least = SUPPORT[self.order]
            raise ValueError(
                f"knots are {tuple(self.knots.shape)}: wanted (ny, nx, 2), {least} or more to a side"
            )
        if self.spacing.shape[-1:] != (2,) or (checking() and not bool((self.spacing > 0).all())):
            raise ValueError("spacing is that of knots along x and y: two positive numbers")

    @property
    def sees_behind(self) -> bool:
        """True if the base has directions at 90 degrees or more off axis."""
        return self.base == STEREOGRAPHIC

    def project(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Project directions (*n, 3) of any length in the camera's frame.

        Returns:
            Points of the image plane (*n, 2), and True (*n) within the valid part of the knots and before any
            fold; NaN, infinity, (0, 0, 0) and straight behind are not valid. Others mean nothing.
        """
        X, finite = finite_points(X)
        length = _length(X)
        away = length + X[..., 2]  # 0 straight behind
        some = (away > NEARLY * length) & (X != 0).any(-1)
        u, inside = self._within(2 * X[..., :2] / torch.where(some, away, 1.0)[..., None])
        xy, jacobian = self._displaced(u)
        return xy, finite & some & inside & keeps_orientation(jacobian)

    def unproject(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the unit directions of points of the image plane (*n, 2): the inverse of `project`.

        They are found by Newton's method, whose last two steps carry first and second derivatives.

        Returns:
            Directions (*n, 3) in the camera's frame, and True (*n) where there is one that `project` takes as
            valid; elsewhere the direction means nothing.
        """
        xy, finite = finite_points(xy)
        with torch.no_grad():
            wanted = xy.detach()
            start, _ = self._within(self._undisplaced(wanted))
            few = STEPS if not self.batch_shape and not traced() else MOST
            solved = self._solved(start, wanted, few)
            off, reached, jacobian = self._off(solved, wanted)
            if few < MOST and bool(off.any()):  # the few that take longer, or have no solution
                solved[off] = self._solved(solved[off], wanted[off], MOST)
                off, reached, jacobian = self._off(solved, wanted)
            valid = finite & ~off & self._within(solved)[1] & keeps_orientation(jacobian)
        u, target = solved, torch.where(valid[..., None], xy, reached)
        for _ in range(2):
            u = u - newton_step(*self._displaced(u), target)
        u = torch.where(valid[..., None], u, solved)
        squared = u.square().sum(-1, keepdim=True)
        return torch.cat([4 * u, 4 - squared], -1) / (4 + squared), valid

    def _solved(self, start: Tensor, xy: Tensor, steps: int) -> Tensor:
        """Stereographic points of points of the image plane, by at most `steps` Newton steps."""

        def within(u: Tensor) -> Tensor:
            return self._within(u)[1]

        return solve_in_plane(self._displaced, start, xy, within, rounding=SOLVED / 8, steps=steps)

    def _off(self, u: Tensor, xy: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """True for stereographic points that do not solve for `xy`, their projections, and the Jacobian."""
        reached, jacobian = self._displaced(u)
        return norm(reached - xy) >= SOLVED * torch.finfo(xy.dtype).eps * (1 + norm(xy)), reached, jacobian

    def _within(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Clamp stereographic points to the border of knots and base; also True for points inside."""
        spacing = beside_points(self.spacing, u, 1).detach()
        ny, nx = self.knots.shape[-3:-1]
        margin = 0.5 * (self.order - 1) + NEARLY
        most = spacing * (0.5 * (spacing.new_tensor([nx, ny]) - 1) - margin)
        inside = (u.abs() <= most).all(-1)
        u = torch.minimum(torch.maximum(u, -most), most)
        if self.base == STEREOGRAPHIC:
            return u, inside
        squared, limit = u.square().sum(-1), 4 * (1 - NEARLY)
        ahead = squared <= limit
        return u * torch.where(ahead, 1.0, (limit / torch.where(ahead, 1.0, squared)).sqrt())[
            ..., None
        ], inside & ahead

    def _undisplaced(self, xy: Tensor) -> Tensor:
        """Stereographic points of points of the base."""
        if self.base == STEREOGRAPHIC:
            return xy
        return 2 * xy / (1 + (1 + xy.square().sum(-1, keepdim=True)).sqrt())

    def _displaced(self, u: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Points of the image plane of stereographic points within the knots, and the Jacobian."""
        moved, along_x, along_y = self._surface(u)
        if self.base == STEREOGRAPHIC:
            return u + moved, (1 + along_x[..., 0], along_y[..., 0], along_x[..., 1], 1 + along_y[..., 1])
        x, y = u.unbind(-1)
        g = 1 / (1 - (x * x + y * y) / 4)
        bent = g * g / 2
        jacobian = (
            g + bent * x * x + along_x[..., 0],
            bent * x * y + along_y[..., 0],
            bent * x * y + along_x[..., 1],
            g + bent * y * y + along_y[..., 1],
        )
        return u * g[..., None] + moved, jacobian

    def _surface(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Displacements (*n, 2) and their derivatives by u's x and y."""
        ny, nx = self.knots.shape[-3:-1]
        spacing, knots = beside_points(self.spacing, u, 1), beside_points(self.knots, u, 3)
        position = u / spacing + 0.5 * (u.new_tensor([nx, ny]) - 1)
        side = SUPPORT[self.order]
        with torch.no_grad():  # the first of the knots that a point depends on
            first = (position.round() if self.order == 2 else position.floor()) - 1
            last = first.new_tensor([nx - side, ny - side])
            first = torch.minimum(first.clamp(min=0), last)
        weights, slopes = _basis(position - first, self.order)
        shape = broadcast_shapes(u.shape[:-1], knots.shape[:-3])
        batches = knots.shape[: self.knots.ndim - 3].numel()
        flat = knots.reshape(-1, 2)
        batch = torch.arange(batches, device=u.device).reshape(knots.shape[:-3]) * (nx * ny)
        column, row = first.long().unbind(-1)
        corner = (row * nx + column + batch).expand(shape)[..., None] + torch.arange(side, device=u.device)
        (across, down), (across_slope, down_slope) = weights.unbind(-2), slopes.unbind(-2)
        moved, along_x, along_y = (u.new_zeros((*shape, 2)) for _ in range(3))
        for j in range(side):  # a row of knots at a time: its splines along x, then along y
            knot = flat.index_select(0, (corner + j * nx).reshape(-1)).reshape(*shape, side, 2)
            value, slope = ((w[..., None] * knot).sum(-2) for w in (across, across_slope))
            moved = moved + down[..., j, None] * value
            along_x = along_x + down[..., j, None] * slope
            along_y = along_y + down_slope[..., j, None] * value
        return moved, along_x / spacing[..., :1], along_y / spacing[..., 1:]


def _length(X: Tensor) -> Tensor:
    """Lengths of vectors; 1 for zero vectors, without gradient."""
    squared = X.square().sum(-1)
    return torch.where(squared > 0, squared, 1.0).sqrt()


def _basis(t: Tensor, order: int) -> tuple[Tensor, Tensor]:
    """Uniform B-splines (*n, side) and their slopes, for knots 0, 1, ...; t counts from the first of them."""
    s = t - 1
    if order == 2:
        weights = [(0.5 - s) ** 2 / 2, 0.75 - s**2, (0.5 + s) ** 2 / 2]
        return torch.stack(weights, -1), torch.stack([s - 0.5, -2 * s, s + 0.5], -1)
    weights = [
        (1 - s) ** 3 / 6,
        (3 * s**3 - 6 * s**2 + 4) / 6,
        (1 + 3 * s + 3 * s**2 - 3 * s**3) / 6,
        s**3 / 6,
    ]
    slopes = [-((1 - s) ** 2) / 2, (3 * s**2 - 4 * s) / 2, (1 + 2 * s - 3 * s**2) / 2, s**2 / 2]
    return torch.stack(weights, -1), torch.stack(slopes, -1)
