"""Lens models: undistorted to distorted points, and back.

All points here are *normalised*: for a pinhole (x, y) = (X / Z, Y / Z) in the camera's frame (x right, y
down, z forward), before the focal length and the principal point. Distorted points are what K multiplies to
give pixels.

Models, with their coefficients:

- ``brown-conrady``: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]], 4, 5, 8, 12 or 14 numbers in OpenCV's
  order: rational radial, tangential, thin-prism and tilted-sensor terms (Brown 1966, Conrady 1919).
- ``kannala-brandt``: k1 k2 k3 k4, the angle theta from the optical axis goes to the radius
  theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (Kannala and Brandt 2006; OpenCV's
  ``fisheye``, Kalibr's ``equidistant``, COLMAP's ``OPENCV_FISHEYE``).
- ``thin-prism-fisheye``: k1 k2 p1 p2 k3 k4 sx sy, the same angle, then Brown-Conrady's polynomials (COLMAP).
- ``double-sphere``: xi alpha (Usenko, Demmel and Cremers 2018; Kalibr's ``ds``).
- ``extended-unified``: alpha beta (Khomutenko, Garcia and Martinet 2016; Kalibr's ``eucm``).
- ``unified``: xi k1 k2 p1 p2 (Mei and Rives 2007; Kalibr's ``omni``, OpenCV's ``omnidir``).
- ``fov``: omega, the undistorted radius r goes to atan(2 r tan(omega / 2)) / omega (Devernay and Faugeras
  2001).
- ``scaramuzza``: b2 b3 b4, the point (x, y) is seen along (x, y, 1 + b2 r^2 + b3 r^3 + b4 r^4) (Scaramuzza
  2006; MATLAB's fisheye; with its a0 as the focal length, b2 = a2 a0, b3 = a3 a0^2, b4 = a4 a0^3).

Each follows its lens up to some radius or angle. Points past it are not valid; their values stay finite and
bounded (the point is moved in to the limit first).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .checks import check_numbers, checking
from .lenses.brown import brown_derivatives, brown_distort, brown_limit, brown_undistort
from .lenses.central import EXTENDED_UNIFIED, FOV, central_project, central_unproject
from .lenses.common import WIDEST, finite_points, on_plane, once, unit
from .lenses.fisheye import fisheye_limit, fisheye_project, fisheye_unproject
from .lenses.model import TAKEN, LensModel
from .pixels import to_homogeneous
from .runtime.tracing import traced

BROWN_CONRADY = "brown-conrady"
KANNALA_BRANDT = "kannala-brandt"
LENS_TERMS = {
    BROWN_CONRADY: {
        **{"k1": 1.0, "k2": 1.0, "p1": 0.02, "p2": 0.02, "k3": 1.0, "k4": 1.0, "k5": 1.0, "k6": 1.0},
        **{"s1": 0.02, "s2": 0.02, "s3": 0.02, "s4": 0.02, "tx": 0.1, "ty": 0.1},
    },
    KANNALA_BRANDT: {"k1": 0.3, "k2": 0.3, "k3": 0.3, "k4": 0.3},
    "double-sphere": {"xi": 0.3, "alpha": 0.3},
    "extended-unified": {"alpha": 0.3, "beta": 0.5},
    "unified": {"xi": 1.0, "k1": 1.0, "k2": 1.0, "p1": 0.02, "p2": 0.02},
    "fov": {"omega": 0.5},
    "scaramuzza": {"b2": 0.5, "b3": 0.5, "b4": 0.5},
    "thin-prism-fisheye": {
        **{"k1": 0.3, "k2": 0.3, "p1": 0.02, "p2": 0.02, "k3": 0.3, "k4": 0.3, "sx": 0.02, "sy": 0.02},
    },
}
"""Names of the coefficients, in order, with upper bounds of their usual sizes."""
COEFFICIENT_COUNTS: dict[str, tuple[int, ...]] = {
    name: (4, 5, 8, 12, 14) if name == BROWN_CONRADY else (len(terms),) for name, terms in LENS_TERMS.items()
}
TAKEN.update(COEFFICIENT_COUNTS)


@dataclass(frozen=True, eq=False, repr=False)
class Distortion(LensModel):
    """Lens with coefficients, or a batch of lenses of one model.

    The batch axes of `coefficients` meet the *leading* axes of the points: coefficients (5, 8) go with points
    (5, 2), (5, 100, 2), (5, 20, 30, 2); others that do not broadcast raise RuntimeError. Points are
    independent of each other; all maps are differentiable, twice, in the points and the coefficients.
    Coefficients out of a model's bounds, such as alpha above 1, are not refused: no point is valid then.

    Attributes:
        model: name of the model, a key of `LENS_TERMS` such as "brown-conrady" (OpenCV's).
        coefficients: its coefficients (*b, n), in the order of `LENS_TERMS`; for "brown-conrady" the first 4,
            5, 8, 12 or all 14.

    Raises:
        ValueError: for an unknown model, a number of coefficients that it does not have, NaN or infinity.
        TypeError: for coefficients that are no floating-point tensor.
    """

    item_axes: ClassVar = {"coefficients": 1}
    model: str
    coefficients: Float[Tensor, "*b n"]

    def __post_init__(self) -> None:
        if checking() and not isinstance(self.coefficients, Tensor):
            kind = type(self.coefficients).__name__
            raise TypeError(
                f"the coefficients are a {kind}: give a tensor, such as torch.tensor([-0.1, 0, 0, 0])"
            )
        if self.model not in COEFFICIENT_COUNTS:
            raise ValueError(f"unknown lens model {self.model!r}: use one of {', '.join(COEFFICIENT_COUNTS)}")
        counts = COEFFICIENT_COUNTS[self.model]
        if self.coefficients.shape[-1:] not in [(count,) for count in counts]:
            shape, wanted = tuple(self.coefficients.shape), " or ".join(map(str, counts))
            raise ValueError(f"{self.model} takes (..., {wanted}) coefficients, got {shape}: pad with zeros")
        if checking():
            check_numbers(self.coefficients, self.coefficients.shape[-1:], f"a lens ({self.model})")

    def with_coefficients(self, coefficients: Tensor) -> Distortion:
        """Return the same model with other coefficients."""
        return replace(self, coefficients=coefficients)

    @property
    def is_identity(self) -> bool:
        """True if this lens distorts nothing: Brown-Conrady with all coefficients 0."""
        return self.model == BROWN_CONRADY and not bool(self.coefficients.any())

    @property
    def harmless(self) -> bool:
        """True if the lens can be left out: without effect or gradient; False while torch traces."""
        return not self.coefficients.requires_grad and not traced() and self.is_identity

    @property
    def sees_behind(self) -> bool:
        """True if the model has directions at 90 degrees or more off axis."""
        return self.model not in (BROWN_CONRADY, FOV)

    def distort(self, xy: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Distort normalised pinhole points.

        Returns:
            Distorted points, and True inside the lens's range, not for NaN and infinity; others mean nothing.
        """
        xy, finite = finite_points(xy)
        if self.model == BROWN_CONRADY:
            xy_d, valid = brown_distort(self._lifted(xy), xy)
        else:
            xy_d, valid = self._project(to_homogeneous(xy))
        return xy_d, valid & finite

    def undistort(self, xy_d: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Undistort points to normalised pinhole points: the inverse of `distort`, iterated to convergence.

        Returns:
            Pinhole points, and True inside the model's range; others mean nothing. A fisheye ray at 90
            degrees or more has no pinhole point and is not valid: see `unproject`.
        """
        xy_d, finite = finite_points(xy_d)
        if self.model == BROWN_CONRADY:
            xy, valid = brown_undistort(self._lifted(xy_d), xy_d)
        else:
            ray, valid = self._unproject(xy_d)
            ahead = ray[..., 2] > 1 / WIDEST
            xy, valid = ray[..., :2] / torch.where(ahead, ray[..., 2], 1 / WIDEST)[..., None], valid & ahead
        return xy, valid & finite

    def project(self, X: Real[Tensor, "*n 3"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Project points in the camera's frame (any unit).

        Returns:
            Distorted normalised points, and True where the lens reaches the direction: ahead (z > 0) for
            Brown-Conrady and the field-of-view model, for others perhaps at and beyond 90 degrees off axis
            too. (0, 0, 0), NaN and infinity are not valid; others mean nothing.
        """
        X, finite = finite_points(X)
        if self.model != BROWN_CONRADY:
            xy_d, valid = self._project(X)
            return xy_d, valid & finite
        xy, ahead = on_plane(X)
        xy_d, valid = self.distort(xy)
        return xy_d, valid & ahead & finite

    def unproject(self, xy_d: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 3"], Bool[Tensor, "*n"]]:
        """Compute the directions of distorted normalised points: the inverse of `project`.

        Returns:
            Unit directions in the camera's frame, and True inside the model's range; others mean nothing.
        """
        if self.model != BROWN_CONRADY:
            xy_d, finite = finite_points(xy_d)
            ray, valid = self._unproject(xy_d)
            return ray, valid & finite
        xy, valid = self.undistort(xy_d)
        return unit(to_homogeneous(xy)), valid

    def _project(self, X: Tensor) -> tuple[Tensor, Tensor]:
        c = self._lifted(X)
        return fisheye_project(c, X) if self.model == KANNALA_BRANDT else central_project(self.model, c, X)

    def _unproject(self, xy_d: Tensor) -> tuple[Tensor, Tensor]:
        c = self._lifted(xy_d)
        return (
            fisheye_unproject(c, xy_d)
            if self.model == KANNALA_BRANDT
            else central_unproject(self.model, c, xy_d)
        )

    def _text(self) -> str:
        return self.model + (
            "" if self.batch_shape else "".join(f" {c:.4g}" for c in self.coefficients.tolist())
        )

    @property
    def squared_limit(self) -> float:
        """Limit of one lens's range: squared radius (Brown-Conrady) or squared angle (Kannala-Brandt)."""
        c = self.coefficients.detach()
        return float(once(fisheye_limit if self.model == KANNALA_BRANDT else brown_limit, c))

    def _lifted(self, points: Tensor) -> Tensor:
        """Coefficients (*b, 1.., n): batch axes in front, then one axis of length 1 for each further axis."""
        c = self.coefficients
        return c.reshape(*c.shape[:-1], *[1] * (points.ndim - c.ndim), c.shape[-1])


def lens_derivatives(
    lens: LensModel | None, X: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 3"], Float[Tensor, "n 2 k"]]:
    """Project finite points through one lens, with derivatives, as constants without gradient.

    In closed form for Brown-Conrady of fewer than 14 coefficients; otherwise by two reverse passes, with a
    copy of the coefficients for each point.

    Args:
        lens: one lens, not a batch; None for a pinhole.
        X: points in the camera's frame, in any unit; metres for a lens that is not central.

    Returns:
        Points of the image plane (n, 2), derivatives by X (n, 2, 3), and by the coefficients (n, 2, k), k = 0
        for None. Validity is not checked: points that a `Distortion` does not see give finite numbers.
    """
    X, c = X.detach(), X.new_zeros(0) if lens is None else lens.coefficients.detach()
    if lens is None or (lens.model == BROWN_CONRADY and len(c) < COEFFICIENT_COUNTS[BROWN_CONRADY][-1]):
        ahead = X[:, 2:] > 0
        z = torch.where(ahead, X[:, 2:], 1.0)
        xy = X[:, :2] / z
        pinhole = xy, torch.eye(2).to(X).expand(len(X), 2, 2), X.new_zeros(len(X), 2, 0)
        x_d, by_plane, by_lens = pinhole if lens is None else brown_derivatives(c, xy)
        by_depth = -by_plane @ torch.where(ahead, xy, 0.0)[..., None]
        return x_d, torch.cat([by_plane, by_depth], -1) / z[..., None], by_lens
    with torch.enable_grad():
        through = X.requires_grad_(), c.requires_grad_().expand(len(X), -1)
        x_d = lens.with_coefficients(through[1]).project(through[0][:, None])[0][:, 0]
        slopes = [
            torch.autograd.grad(v.sum(), through, retain_graph=True, materialize_grads=True)
            for v in x_d.unbind(-1)
        ]
    by_point, by_lens = (torch.stack(parts, 1) for parts in zip(*slopes))
    return x_d.detach(), by_point, by_lens


def typical_coefficients(lens: LensModel) -> tuple[float, ...]:
    """Return usual sizes of a lens's coefficients; 1 for a camera model's."""
    count = lens.coefficients.shape[-1]
    return tuple(LENS_TERMS[lens.model].values())[:count] if lens.model in LENS_TERMS else (1.0,) * count


def pinhole_coefficients(lens: LensModel) -> Float[Tensor, "*b n"]:
    """Return coefficients without effect: zeros, except for the extended unified model's beta of 1."""
    none = torch.zeros_like(lens.coefficients)
    return none + none.new_tensor([0.0, 1.0]) if lens.model == EXTENDED_UNIFIED else none


def term(lens: LensModel, index: int) -> str:
    """Return the name of a lens's coefficient, such as "k1"; "number 3" for a camera model."""
    return list(LENS_TERMS[lens.model])[index] if lens.model in LENS_TERMS else f"number {index + 1}"
