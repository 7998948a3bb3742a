"""Camera models whose rays do not meet in a point: parallel rays, rolling shutter, flat port."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ..checks import checking
from ..pixels import to_homogeneous
from ..runtime.tracing import followed
from .common import cosine_and_sinc, finite_points, on_plane, unit
from .model import CameraModel, LensModel, beside_points

ROWS, ANGLES = 12, 24
"""Largest number of steps to the row at which a point is seen, and to the angle at which a pane is passed."""
FOLLOWED = 2
"""Further steps, which carry first and second derivatives."""
SETTLED = 64
"""Size of a step, in units of rounding, below which a solution is accepted."""


@dataclass(frozen=True, eq=False, repr=False)
class Orthographic(CameraModel, name="orthographic"):
    """Camera model of parallel rays along the axis, as of a telecentric lens; it has no numbers.

    Points of the image plane are (x, y) in metres, and K's focal length is in pixels for each metre.
    """

    central: ClassVar[bool] = False
    lengths: ClassVar = ()
    even: ClassVar[Literal["pixels", "distance"]] = "distance"

    @property
    def sees_behind(self) -> bool:
        """False: only points ahead are seen."""
        return False

    def project(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Project points (*n, 3), metres, along the axis.

        Returns:
            (x, y) in metres (*n, 2), and True (*n) for z > 0; NaN and infinity are not valid.
        """
        X, finite = finite_points(X)
        return X[..., :2], finite & (X[..., 2] > 0)

    def unproject(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Return the axis for each point (*n, 2) of the image plane.

        Returns:
            Directions (0, 0, 1) (*n, 3) of rays that start at `origins`, and True (*n) for finite points.
        """
        xy, finite = finite_points(xy)
        return torch.zeros_like(to_homogeneous(xy)) + xy.new_tensor([0.0, 0.0, 1.0]), finite

    def origins(self, xy: Tensor) -> Tensor:
        """Return the points themselves, in the plane z = 0."""
        return torch.nn.functional.pad(finite_points(xy)[0], (0, 1))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class BehindModel(CameraModel):
    """Base of camera models that hold a central lens: a pinhole or other lens that moves, or looks through
    something. A subclass gives the rest of a `CameraModel` that is not central.

    Attributes:
        lens: central lens model; None for a pinhole.

    Raises:
        ValueError: for a lens that is not central.
    """

    lens: LensModel | None = None

    def __post_init__(self) -> None:
        if self.lens is not None and not self.lens.central:
            raise ValueError(f"the lens has to be central, and {self.lens.model} is not")

    @property
    def period(self) -> float:  # type: ignore[override]
        """Period of its lens."""
        return 0.0 if self.lens is None else self.lens.period

    def _through(self, X: Tensor) -> tuple[Tensor, Tensor]:
        return on_plane(X) if self.lens is None else self.lens.project(X)

    def _ray(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        if self.lens is not None:
            ray, valid = self.lens.unproject(xy)
            return unit(ray), valid
        xy, finite = finite_points(xy)
        return unit(to_homogeneous(xy)), finite


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class RollingShutter(BehindModel, name="rolling-shutter"):
    """Camera model of a camera that moves while its rows are read, one after the other, at constant
    velocities.

    The row of the principal point is read at time 0, to which the pose refers. K has to be upright (not
    checked): images rotated by a quarter turn have columns for rows.

    Attributes:
        lens: central lens model; None for a pinhole.
        velocity: velocity (*b, 3) of the camera along its axes, metres for each second.
        rotation: angular velocity (*b, 3) about its axes, radians for each second.
        readout: seconds (*b) in which as many rows are read as the focal length has pixels, `row_time * fy`.

    Raises:
        ValueError: for a lens that is not central.
    """

    item_axes: ClassVar = {"velocity": 1, "rotation": 1}
    central: ClassVar[bool] = False
    lengths: ClassVar = ("velocity",)
    velocity: Float[Tensor, "*b 3"]
    rotation: Float[Tensor, "*b 3"]
    readout: Float[Tensor, "*b"]

    def project(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Project points (*n, 3) of the frame of time 0, metres, with the secant method for the row that sees
        them.

        Returns:
            Points of the image plane (*n, 2), and True (*n) where a row is found and the lens sees the point;
            others mean nothing.
        """
        X, finite = finite_points(X)
        with torch.no_grad():
            row, slope = self._row(X)
        for _ in range(FOLLOWED if torch.is_grad_enabled() else 0):
            row = row + (self._through(self._at_rest(X, row))[0][..., 1] - row) / (1 - slope)
        xy, valid = self._through(self._at_rest(X, row))
        settled = (xy[..., 1] - row).abs() <= SETTLED * torch.finfo(xy.dtype).eps * (1 + xy.abs().amax(-1))
        return xy, valid & finite & settled

    def _row(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Row that sees a point while it is read, and the point's motion during a row, in rows."""
        before = self._through(X)[0][..., 1]
        row, slope = before, torch.zeros_like(before)
        last, rounding = torch.zeros_like(before), torch.finfo(before.dtype).eps
        for _ in range(ROWS):
            projected = self._through(self._at_rest(X, row))[0][..., 1]
            step = row - last
            moved = step.abs() > rounding**0.5
            slope = torch.where(moved, (projected - before) / torch.where(moved, step, 1.0), slope).clamp(
                max=STEEPEST
            )
            last, before = row, projected
            row = row + (projected - row) / (1 - slope)
            if not followed() and bool(((row - last).abs() <= SETTLED * rounding * (1 + row.abs())).all()):
                break
        return row, slope

    def unproject(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the unit directions of points of the image plane (*n, 2), in the frame of time 0.

        Returns:
            Directions (*n, 3) of rays that start at `origins`, and True (*n) where the lens has one.
        """
        ray, valid = self._ray(xy)
        return _rotated(ray, self.rotation, self._time(ray, xy[..., 1])), valid

    def origins(self, xy: Tensor) -> Tensor:
        """Return the position of the camera when the row is read, metres."""
        xy = finite_points(xy)[0]
        return self._time(xy, xy[..., 1])[..., None] * beside_points(self.velocity, xy, 1)

    def _time(self, points: Tensor, row: Tensor) -> Tensor:
        return beside_points(self.readout, points) * row

    def _at_rest(self, X: Tensor, row: Tensor) -> Tensor:
        """Points in the frame of the camera when it reads a row."""
        time = self._time(X, row)
        return _rotated(X - time[..., None] * beside_points(self.velocity, X, 1), self.rotation, -time)


STEEPEST = 0.9
"""Largest slope that a step is computed with."""


def _rotated(v: Tensor, rotation: Tensor, time: Tensor) -> Tensor:
    """Rotate vectors (*b, ..., 3) for a time at angular velocities (*b, 3) (Rodrigues), smooth at angle 0."""
    w = beside_points(rotation, v, 1)
    sinc, versed = _sinc_and_versed(time.square() * w.square().sum(-1))
    once = _cross(w, v)
    return v + (time * sinc)[..., None] * once + (time.square() * versed)[..., None] * _cross(w, once)


def _sinc_and_versed(squared: Tensor) -> tuple[Tensor, Tensor]:
    """sin(t) / t and (1 - cos(t)) / t^2 of squared angles t^2; by series alone if all are small."""
    if followed() or bool((squared > SMALL).any()):
        sinc, half = cosine_and_sinc(squared)[1], cosine_and_sinc(squared / 4)[1]
        return sinc, 0.5 * half.square()
    sinc, versed = torch.zeros_like(squared), torch.zeros_like(squared)
    for k in reversed(range(7)):
        sinc, versed = 1 / factorial(2 * k + 1) - squared * sinc, 1 / factorial(2 * k + 2) - squared * versed
    return sinc, versed


SMALL = 0.1
"""Squared angle up to which the eighth term of the series is below rounding."""


def _cross(w: Tensor, v: Tensor) -> Tensor:
    """Cross products by components: `torch.linalg.cross` of a broadcast vector takes three times as long."""
    (wx, wy, wz), (x, y, z) = w.unbind(-1), v.unbind(-1)
    return torch.stack([wy * z - wz * y, wz * x - wx * z, wx * y - wy * x], -1)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FlatPort(BehindModel, name="flat-port"):
    """Camera model of a camera in air (index 1) that looks into water through a flat pane of glass, at right
    angles to its axis (Treibitz, Schechner, Kunz and Singh 2012).

    Attributes:
        lens: central lens model; None for a pinhole.
        distance: distance (*b) from the camera's centre to the pane, metres.
        thickness: thickness (*b) of the pane, metres.
        glass: refractive index (*b) of the glass, at least 1.
        water: refractive index (*b) of the water, at least 1.

    Raises:
        ValueError: for refractive indices below 1, and a lens that is not central.
    """

    central: ClassVar[bool] = False
    lengths: ClassVar = ("distance", "thickness")
    distance: Float[Tensor, "*b"]
    thickness: Float[Tensor, "*b"]
    glass: Float[Tensor, "*b"]
    water: Float[Tensor, "*b"]

    def __post_init__(self) -> None:
        super().__post_init__()
        if checking() and not all(bool((n >= 1).all()) for n in (self.glass, self.water)):
            raise ValueError("glass and water are refractive indices, at least 1, as 1.52 and 1.333")

    @property
    def sees_behind(self) -> bool:
        """Points beyond the pane alone are seen."""
        return False

    def project(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Project points (*n, 3) in the water by the ray that reaches them, found by Newton's method.

        Returns:
            Points of the image plane (*n, 2), and True (*n) for points beyond the pane that a ray of the lens
            reaches; others mean nothing.
        """
        # The unknown is the ray's tangent in air over the radius, started from its value on the axis: how far
        # off axis a ray gets is concave in its tangent, so that no step goes too far.
        X, finite = finite_points(X)
        distance, thickness = self._layers(X)
        valid = finite & (X[..., 2] > distance + thickness)
        depths = thickness, torch.where(valid, X[..., 2] - distance - thickness, 1.0)
        squared = X[..., :2].square().sum(-1)
        with torch.no_grad():
            share, settled = torch.zeros_like(squared), valid
            for _ in range(ANGLES):
                step = self._step(share, squared, depths)
                share = share + step
                settled = step.abs() <= SETTLED * torch.finfo(share.dtype).eps * share
                if not followed() and bool((settled | ~valid).all()):
                    break
        share = torch.where(settled, share, 0.0)
        for _ in range(FOLLOWED if torch.is_grad_enabled() else 0):
            share = share + self._step(share, squared, depths)
        xy, lens_valid = self._through(to_homogeneous(X[..., :2] * share[..., None]))
        return xy, valid & settled & lens_valid

    def unproject(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the unit directions in the water of points of the image plane (*n, 2), by Snell's law.

        Returns:
            Directions (*n, 3) in the camera's frame of rays that start at `origins`, and True (*n) where the
            lens has a ray ahead; others mean nothing.
        """
        ray, valid = self._ray(xy)
        across = ray[..., :2] / beside_points(self.water, ray)[..., None]
        ahead = (1 - across.square().sum(-1)).clamp(min=0).sqrt()
        return torch.cat([across, ahead[..., None]], -1), valid & (ray[..., 2] > 0)

    def origins(self, xy: Tensor) -> Tensor:
        """Return the points where rays leave the pane, metres."""
        ray, _ = self._ray(xy)
        distance, thickness = self._layers(ray)
        ahead = ray[..., 2].clamp(min=1e-6)
        squared = ray[..., :2].square().sum(-1)
        within = (beside_points(self.glass, ray).square() - squared).sqrt()
        across = ray[..., :2] * (distance / ahead + thickness / within)[..., None]
        return torch.cat([across, (distance + thickness).expand_as(ahead)[..., None]], -1)

    def _layers(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return beside_points(self.distance, points), beside_points(self.thickness, points)

    def _step(self, share: Tensor, squared: Tensor, depths: tuple[Tensor, Tensor]) -> Tensor:
        """Newton step of the tangent in air over the radius, for the ray that reaches a squared radius."""
        across = squared * share.square()
        reached = slope = self._layers(share[..., None])[0]
        for depth, number in zip(depths, (self.glass, self.water)):
            index = beside_points(number, share[..., None]).square()
            bent = (index + (index - 1) * across).rsqrt()
            reached, slope = reached + depth * bent, slope + depth * index * bent**3
        return (1 - share * reached) / slope
