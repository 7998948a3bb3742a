"""Six cameras as a reader of docs/rigs.md writes them: no model of the package is used."""

import math
from dataclasses import dataclass

import torch

from arraygeom.lenses import CameraModel, beside_points

WIDE = 1.9
"""Radians off axis that the fisheyes see."""


@dataclass(frozen=True, eq=False, repr=False)
class OwnEquidistant(CameraModel, name="own-equidistant"):
    def project(self, X):
        rho = X[..., :2].norm(dim=-1)
        theta = torch.atan2(rho, X[..., 2])
        scale = torch.where(rho > 0, theta / rho.clamp(min=1e-12), 1 / X[..., 2].abs().clamp(min=1e-12))
        return X[..., :2] * scale[..., None], (theta <= WIDE) & (X != 0).any(-1)

    def unproject(self, xy):
        theta = xy.norm(dim=-1, keepdim=True)
        return torch.cat([xy * torch.sinc(theta / math.pi), theta.cos()], -1), theta[..., 0] <= WIDE


@dataclass(frozen=True, eq=False, repr=False)
class OwnPolynomial(CameraModel, name="own-polynomial"):
    k2: torch.Tensor
    k3: torch.Tensor

    def radius(self, theta):
        return theta * (1 + theta * (beside_points(self.k2, theta) + theta * beside_points(self.k3, theta)))

    def project(self, X):
        rho = X[..., :2].norm(dim=-1)
        theta = torch.atan2(rho, X[..., 2])
        return X[..., :2] * (self.radius(theta) / rho.clamp(min=1e-12))[..., None], theta <= WIDE

    def unproject(self, xy):
        theta = r = xy.norm(dim=-1)
        for _ in range(30):
            theta = theta + r - self.radius(theta)
        scale = theta.sin() / r.clamp(min=1e-12)
        return torch.cat([xy * scale[..., None], theta.cos()[..., None]], -1), theta <= WIDE


@dataclass(frozen=True, eq=False, repr=False)
class OwnSphere(CameraModel, name="own-sphere"):
    period = 2 * math.pi

    def project(self, X):
        x, y, z = X.unbind(-1)
        return torch.stack([torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))], -1), (X != 0).any(-1)

    def unproject(self, xy):
        lon, lat = xy.unbind(-1)
        on = (lon.abs() <= math.pi) & (lat.abs() <= math.pi / 2)
        return torch.stack([lat.cos() * lon.sin(), lat.sin(), lat.cos() * lon.cos()], -1), on


@dataclass(frozen=True, eq=False, repr=False)
class OwnTelecentric(CameraModel, name="own-telecentric"):
    central, even = False, "distance"

    def project(self, X):
        return X[..., :2], X[..., 2] > 0

    def unproject(self, xy):
        return torch.zeros_like(xy[..., :1]) + xy.new_tensor([0.0, 0.0, 1.0]), xy.isfinite().all(-1)

    def origins(self, xy):
        return torch.nn.functional.pad(xy, (0, 1))


@dataclass(frozen=True, eq=False, repr=False)
class OwnShutter(CameraModel, name="own-shutter"):
    central = False
    item_axes = {"step": 1}  # noqa: RUF012
    step: torch.Tensor  # metres that the camera moves while as many rows as a focal length are read

    def project(self, X):  # the row y at which (X - y step) is seen is the root of a quadratic equation
        step = beside_points(self.step, X, 1)
        b = X[..., 2] + step[..., 1]
        root = b.square() - 4 * step[..., 2] * X[..., 1]
        y = 2 * X[..., 1] / (b + root.clamp(min=1e-12).sqrt())
        there = X - y[..., None] * step
        return there[..., :2] / there[..., 2:], (there[..., 2] > 0) & (root > 0) & (b > 0)

    def unproject(self, xy):
        return torch.cat([xy, torch.ones_like(xy[..., :1])], -1), xy.isfinite().all(-1)

    def origins(self, xy):
        return xy[..., 1:] * beside_points(self.step, xy, 1)


@dataclass(frozen=True, eq=False, repr=False)
class OwnPort(CameraModel, name="own-port"):
    central = False
    distance: torch.Tensor  # metres to a thin pane
    index: torch.Tensor  # of refraction behind it

    def bent(self, xy):
        """Tangent in water over tangent in air (Snell)."""
        n = beside_points(self.index, xy).square()[..., None]
        return 1 / (n + (n - 1) * xy.square().sum(-1, keepdim=True)).sqrt()

    def project(self, X):
        d = beside_points(self.distance, X)[..., None]
        xy = X[..., :2] / X[..., 2:]
        for _ in range(60):
            xy = X[..., :2] / (d + (X[..., 2:] - d) * self.bent(xy))
        return xy, X[..., 2] > d[..., 0]

    def unproject(self, xy):
        return torch.cat([xy * self.bent(xy), torch.ones_like(xy[..., :1])], -1), xy.isfinite().all(-1)

    def origins(self, xy):
        return torch.cat([xy, torch.ones_like(xy[..., :1])], -1) * beside_points(self.distance, xy)[..., None]
