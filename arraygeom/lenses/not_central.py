"""Camera models whose rays do not meet in a point: parallel rays, a rolling shutter, a flat port."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ..pixels import to_homogeneous
from ..tracing import followed
from .angular import BISECTIONS, NEWTON
from .common import finite_points, unit
from .model import CameraModel, LensModel, beside_points

ITERATIONS = 16
"""Of the row at which a point is seen; each takes its error times the motion while a row's height is read."""


@dataclass(frozen=True, eq=False, repr=False)
class Orthographic(CameraModel, name="orthographic"):
    """Parallel rays along the axis, as of a telecentric lens: (x, y) are metres, the focal length pixels a metre."""

    central: ClassVar[bool] = False
    even: ClassVar[Literal["pixels", "distance"]] = "distance"

    @property
    def sees_behind(self) -> bool:
        """Points ahead alone are seen."""
        return False

    def project(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Points ahead, z > 0."""
        X, finite = finite_points(X)
        return X[..., :2], finite & (X[..., 2] > 0)

    def unproject(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """The axis, for each."""
        xy, finite = finite_points(xy)
        return torch.zeros_like(to_homogeneous(xy)) + xy.new_tensor([0.0, 0.0, 1.0]), finite

    def origins(self, xy: Tensor) -> Tensor:
        """The points themselves, in the plane z = 0."""
        return torch.nn.functional.pad(finite_points(xy)[0], (0, 1))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class BehindModel(CameraModel):
    """A pinhole, or a camera with a central lens, behind something else."""

    lens: LensModel | None = None

    def __post_init__(self) -> None:
        if self.lens is not None and not self.lens.central:
            raise ValueError(f"the lens has to be central, and {self.lens.model} is not")

    @property
    def sees_behind(self) -> bool:
        """Whether its lens does."""
        return self.lens is not None and self.lens.sees_behind

    def _through(self, X: Tensor) -> tuple[Tensor, Tensor]:
        if self.lens is not None:
            return self.lens.project(X)
        ahead = X[..., 2] > 0
        return X[..., :2] / torch.where(ahead, X[..., 2], 1.0)[..., None], ahead

    def _ray(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        if self.lens is not None:
            ray, valid = self.lens.unproject(xy)
            return unit(ray), valid
        xy, finite = finite_points(xy)
        return unit(to_homogeneous(xy)), finite


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class RollingShutter(BehindModel, name="rolling-shutter"):
    """A camera that moves while its rows are read, one after the other.

    velocity: of the camera, metres a second along its axes.
    rotation: its angular velocity about its axes, radians a second.
    readout: seconds that as many rows take as are one focal length, `row_time * fy`; the row of the principal point is
        read at time 0, for which the pose is. Both motions are constant while the image is read.

    K is upright: images that are rotated by a quarter turn have columns for rows.
    """

    item_axes: ClassVar = {"velocity": 1, "rotation": 1}
    central: ClassVar[bool] = False
    velocity: Float[Tensor, "*b 3"]
    rotation: Float[Tensor, "*b 3"]
    readout: Float[Tensor, "*b"]

    def project(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Where the row that sees a point is read, iterated; not valid where that does not converge."""
        X, finite = finite_points(X)
        xy, valid = self._through(X)
        for _ in range(ITERATIONS):
            before = xy
            xy, valid = self._through(self._at_rest(X, xy[..., 1]))
            settled = (xy - before).abs().amax(-1) <= 64 * torch.finfo(xy.dtype).eps * (1 + xy.abs().amax(-1))
            if not followed() and bool(settled.all()):
                break
        return xy, valid & finite & settled

    def unproject(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions, in the frame of time 0."""
        ray, valid = self._ray(xy)
        return _rotated(ray, self._turn(ray, xy[..., 1])), valid

    def origins(self, xy: Tensor) -> Tensor:
        """Where the camera is when the row is read."""
        xy = finite_points(xy)[0]
        return self._time(xy, xy[..., 1])[..., None] * beside_points(self.velocity, xy, 1)

    def _time(self, points: Tensor, row: Tensor) -> Tensor:
        return beside_points(self.readout, points) * row

    def _turn(self, points: Tensor, row: Tensor) -> Tensor:
        return self._time(points, row)[..., None] * beside_points(self.rotation, points, 1)

    def _at_rest(self, X: Tensor, row: Tensor) -> Tensor:
        """Points in the frame of the camera when it reads a row."""
        moved = X - self._time(X, row)[..., None] * beside_points(self.velocity, X, 1)
        return _rotated(moved, -self._turn(X, row))


def _rotated(v: Tensor, w: Tensor) -> Tensor:
    """Vectors rotated by rotation vectors (Rodrigues), smooth at angle 0."""
    squared = w.square().sum(-1, keepdim=True)
    small = squared < 1e-6
    angle = torch.where(small, 1.0, squared).sqrt()
    sinc = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    versed = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / angle.square())
    once = torch.linalg.cross(w, v)
    return v + sinc * once + versed * torch.linalg.cross(w, once)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class FlatPort(BehindModel, name="flat-port"):
    """A camera in air that looks into water through a flat pane of glass, which is at right angles to its axis.

    distance: from the camera's centre to the pane, metres. thickness: of the pane, metres. glass, water: their
    refractive indices (Treibitz, Schechner, Kunz and Singh 2012).
    """

    central: ClassVar[bool] = False
    distance: Float[Tensor, "*b"]
    thickness: Float[Tensor, "*b"]
    glass: Float[Tensor, "*b"]
    water: Float[Tensor, "*b"]

    def project(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Points in the water, by the angle in air whose ray reaches them: bisection, and steps of Newton's."""
        X, finite = finite_points(X)
        layers = self._layers(X)
        squared = X[..., :2].square().sum(-1)
        off = squared > 0
        radius = torch.where(off, torch.where(off, squared, 1.0).sqrt(), 0.0)
        valid = finite & (X[..., 2] > layers[0] + layers[1])
        depths = layers[0], layers[1], torch.where(valid, X[..., 2] - layers[0] - layers[1], 1.0)
        with torch.no_grad():
            low, high = torch.zeros_like(radius), torch.ones_like(radius)
            for _ in range(BISECTIONS):
                middle = 0.5 * (low + high)
                beyond = self._reached(middle, depths)[0] > radius
                low, high = torch.where(beyond, low, middle), torch.where(beyond, middle, high)
            sine = low
        for _ in range(NEWTON):
            found, slope = self._reached(sine, depths)
            sine = (sine - (found - radius) / slope).clamp(0, 1)
        share = torch.where(off, sine / torch.where(off, radius, 1.0), 1 / self._reached(0 * sine, depths)[1])
        cosine = (1 - sine.square()).clamp(min=1e-12).sqrt()
        xy, seen = self._through(torch.cat([X[..., :2] * share[..., None], cosine[..., None]], -1))
        return xy, valid & seen

    def unproject(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions in the water, by Snell's law."""
        ray, valid = self._ray(xy)
        across = ray[..., :2] / beside_points(self.water, ray)[..., None]
        ahead = (1 - across.square().sum(-1)).clamp(min=0).sqrt()
        return torch.cat([across, ahead[..., None]], -1), valid & (ray[..., 2] > 0)

    def origins(self, xy: Tensor) -> Tensor:
        """Where the rays leave the pane."""
        ray, _ = self._ray(xy)
        distance, thickness = self._layers(ray)
        ahead = ray[..., 2].clamp(min=1e-6)
        squared = ray[..., :2].square().sum(-1)
        within = (beside_points(self.glass, ray).square() - squared).sqrt()
        across = ray[..., :2] * (distance / ahead + thickness / within)[..., None]
        return torch.cat([across, (distance + thickness).expand_as(ahead)[..., None]], -1)

    def _layers(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return beside_points(self.distance, points), beside_points(self.thickness, points)

    def _reached(self, sine: Tensor, depths: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """How far off axis the ray of a sine in air gets through layers of air, glass and water; the derivative."""
        indices = (torch.ones_like(sine), *(beside_points(n, sine[..., None]) for n in (self.glass, self.water)))
        radius, slope = torch.zeros_like(sine), torch.zeros_like(sine)
        for depth, index in zip(depths, indices):
            squared = (index.square() - sine.square()).clamp(min=1e-12)
            radius = radius + depth * sine / squared.sqrt()
            slope = slope + depth * index.square() / squared**1.5
        return radius, slope
