"""Camera models by angle: fisheye polynomials of any powers, and the whole sphere."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ..pixels import safe_sqrt
from ..roots import first_root, invert_increasing
from .common import MARGIN, angle_over_radius, cosine_and_sinc, finite_points
from .model import CameraModel, beside_points


@dataclass(frozen=True, eq=False, repr=False)
class PolynomialFisheye(CameraModel, name="polynomial-fisheye"):
    """Fisheye that maps the angle theta off axis to the radius theta + k2 theta^2 + k3 theta^3 + ... on the
    image plane, which K takes to pixels.

    Without coefficients it is the equidistant fisheye. It ends at `widest`, or earlier where the radius stops
    increasing.

    Attributes:
        k: coefficients (*b, n) k2, k3, ...
        widest: largest calibrated angle off axis, radians; above pi counts as pi.
    """

    item_axes: ClassVar = {"k": 1}
    k: Float[Tensor, "*b n"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    widest: Float[Tensor, "*b"] = field(default_factory=lambda: torch.tensor(math.pi, dtype=torch.float64))

    def project(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Project points or directions (*n, 3) in the camera's frame.

        Returns:
            Points of the image plane (*n, 2), and True (*n) up to the angle at which the lens ends; NaN,
            infinity, (0, 0, 0) and straight behind are not valid. Points that are not valid mean nothing.
        """
        X, finite = finite_points(X)
        squared = X[..., :2].square().sum(-1)
        ratio = angle_over_radius(squared, X[..., 2])
        off = squared > 0
        theta = torch.where(
            off, ratio * torch.where(off, squared, 1.0).sqrt(), torch.where(X[..., 2] < 0, math.pi, 0.0)
        )
        scale, _ = self._radius_over_angle(theta)
        valid = finite & (theta <= beside_points(self._limit(), X)) & (off | (X[..., 2] > 0))
        return X[..., :2] * (ratio * scale)[..., None], valid

    def unproject(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the unit directions of points of the image plane (*n, 2): the inverse of `project`.

        Returns:
            Directions (*n, 3) in the camera's frame, and True (*n) up to the radius at which the lens ends;
            further out the direction at its end, for NaN and infinity the axis.
        """
        xy, finite = finite_points(xy)
        squared = xy.square().sum(-1)
        off = squared > 0
        radius = safe_sqrt(squared)
        with torch.no_grad():
            limit = beside_points(self._limit(), xy)
            outermost = limit * self._radius_over_angle(limit)[0]
            valid = finite & (radius <= outermost)
            beyond = finite & (radius > outermost)
            pull = torch.where(beyond, outermost / torch.where(beyond, radius, 1.0), 1.0)
        xy, radius = xy * pull[..., None], radius * pull
        with torch.no_grad():
            theta = invert_increasing(self._radius, radius, limit.expand_as(radius), ITERATIONS)
        for _ in range(2):
            scale, slope = self._radius_over_angle(theta)
            theta = theta + (radius - theta * scale) / torch.where(valid & (slope > 0), slope, 1.0)
        cosine, sinc = cosine_and_sinc(theta.square())
        share = torch.where(off, theta / torch.where(off, radius, 1.0), 1.0)
        return torch.cat([xy * (sinc * share)[..., None], cosine[..., None]], -1), valid

    def _radius(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        ratio, slope = self._radius_over_angle(theta)
        return theta * ratio, slope

    def _radius_over_angle(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Radius / theta, and the derivative of the radius."""
        k = beside_points(self.k, theta[..., None], 1)
        ratio, slope = torch.ones_like(theta), torch.ones_like(theta)
        for i in range(k.shape[-1]):
            ratio = ratio + k[..., i] * theta ** (i + 1)
            slope = slope + (i + 2) * k[..., i] * theta ** (i + 1)
        return ratio, slope

    def _limit(self) -> Tensor:
        """Largest valid angle (*b): float64 on the CPU, without gradient."""
        k, widest = (t.detach().to("cpu", torch.float64) for t in (self.k, self.widest))
        widest = widest.clamp(max=math.pi)
        if not k.shape[-1]:
            return widest
        powers = torch.arange(2, k.shape[-1] + 2).to(k)
        slope = torch.cat([torch.ones_like(k[..., :1]), k * powers], -1)
        return torch.minimum(first_root(slope) * (1 - MARGIN), widest)


ITERATIONS = 40
"""Largest number of steps in the search for an angle; most take five."""


@dataclass(frozen=True, eq=False, repr=False)
class Equirectangular(CameraModel, name="equirectangular"):
    """Camera model whose image plane is longitude x (right of the axis, up to pi either way) and latitude y
    (down, up to pi / 2), radians; it has no numbers.

    The K of a whole sphere in W x H pixels has the focal length W / (2 pi) and the centre
    ((W - 1) / 2, (H - 1) / 2).
    """

    period: ClassVar[float] = 2 * math.pi

    def project(self, X: Tensor) -> tuple[Tensor, Tensor]:
        """Project directions (*n, 3) of any length in the camera's frame.

        Returns:
            Longitude (0 straight up and down) and latitude in radians (*n, 2), and True (*n) for every
            direction; NaN, infinity and (0, 0, 0) are not valid.
        """
        X, finite = finite_points(X)
        x, y, z = X.unbind(-1)
        squared = x.square() + z.square()
        off = squared > 0
        level = safe_sqrt(squared)
        longitude = torch.atan2(torch.where(off, x, 0.0), torch.where(off, z, 1.0))
        valid = finite & (off | (y != 0))
        return torch.stack([longitude, torch.atan2(y, torch.where(valid, level, 1.0))], -1), valid

    def unproject(self, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the unit directions of longitudes and latitudes (*n, 2): the inverse of `project`.

        Returns:
            Directions (*n, 3) in the camera's frame, and True (*n) for a longitude up to pi and a latitude up
            to pi / 2 either way; NaN and infinity are not valid.
        """
        xy, finite = finite_points(xy)
        longitude, latitude = xy.unbind(-1)
        level = latitude.cos()
        ray = torch.stack([level * longitude.sin(), latitude.sin(), level * longitude.cos()], -1)
        rounding = 1 + 8 * torch.finfo(xy.dtype).eps
        on = (longitude.abs() <= math.pi * rounding) & (latitude.abs() <= math.pi / 2 * rounding)
        return ray, finite & on
