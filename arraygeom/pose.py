"""Rigid transforms: X_to = R X_from + t."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float, Real
from torch import Tensor

from .batching import Batched
from .checks import check_batches, check_numbers, check_rotation, checking, derived
from .pixels import broadcasts, floating, product
from .text import angle, range_text


@dataclass(frozen=True, eq=False, repr=False)
class Pose(Batched):
    """A rigid transform named `to_from_from`, for instance `cam_from_world`: X_cam = R X_world + t.

    Poses compose where the inner words meet: `b_from_a @ a_from_world` is `b_from_world`. Metres.
    Raises ValueError for an R that is not a rotation, and for NaN and infinity.
    """

    item_axes: ClassVar = {"R": 2, "t": 1}
    R: Float[Tensor, "*b 3 3"]
    t: Float[Tensor, "*b 3"]

    def __post_init__(self) -> None:
        if checking():
            check_rotation(self.R)
            check_numbers(self.t, (3,), "t")
            check_batches("R and t", self.R.shape[:-2], self.t.shape[:-1])

    @classmethod
    def identity(cls, *, dtype: torch.dtype = torch.float64, device: torch.device | None = None) -> Pose:
        """The transform that changes nothing."""
        return cls(torch.eye(3, dtype=dtype, device=device), torch.zeros(3, dtype=dtype, device=device))

    @classmethod
    def from_centre(cls, R: Float[Tensor, "*b 3 3"], centre: Float[Tensor, "*b 3"]) -> Pose:
        """`cam_from_world` of a camera with rotation R whose optical centre is at `centre` in the world."""
        return cls(R, -matvec(R, centre))

    def __matmul__(self, other: Pose) -> Pose:
        return derived(Pose, product(self.R, other.R), matvec(self.R, other.t) + self.t)

    def inverse(self) -> Pose:
        """`from_to_to`: the transform the other way."""
        Rt = self.R.transpose(-1, -2)
        return derived(Pose, Rt, -matvec(Rt, self.t))

    def apply(self, X: Real[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Points (*n, 3) to R X + t. With batched poses (*b), points are (*b, ..., 3).

        Raises ValueError for points without the batch's axes.
        """
        X, batch = floating(X), self.batch_shape
        if not broadcasts(batch, X.shape[:-1]):
            raise ValueError(f"poses batched over {tuple(batch)} need points (*batch, ..., 3), got {tuple(X.shape)}")
        beside = (..., *[None] * (X.ndim - 1 - len(batch)))
        t = self.t.expand(*batch, 3).movedim(-1, 0)[beside].movedim(0, -1)
        if X.ndim - 1 == len(batch):
            return matvec(self.R, X) + t
        R = self.R.expand(*batch, 3, 3).movedim((-2, -1), (0, 1))[beside[:-1]].movedim((0, 1), (-2, -1))
        return product(X, R.mT) + t

    @property
    def centre(self) -> Float[Tensor, "*b 3"]:
        """Where the origin of `to` is in `from`: a camera's optical centre in the world."""
        return self.inverse().t

    def perturbed(
        self, rotation: Float[Tensor, "*b 3"] | None = None, translation: Float[Tensor, "*b 3"] | None = None
    ) -> Pose:
        """exp(rotation) R and t + translation: a step on the manifold that never leaves SO(3).

        The rounding of the product is taken out again, so that steps do not add up to a drift.
        `rotation` is a rotation vector in radians, about the axes of `to`.
        """
        R = self.R if rotation is None else nearest_rotation(product(rotation_from_vector(rotation), self.R))
        return derived(Pose, R, self.t if translation is None else self.t + translation)

    def _text(self) -> str:
        degrees = angle(self.R).rad2deg()
        if self.batch_shape:
            return f"{range_text(degrees, '.3g')} deg"
        return f"rotation {float(degrees):.2f} deg, t ({', '.join(f'{v:.4g}' for v in self.t.tolist())}) m"


def cross_matrix(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """[v]x, the matrix with [v]x w = v x w."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def matvec(M: Float[Tensor, "*b i j"], v: Float[Tensor, "*b j"]) -> Float[Tensor, "*b i"]:
    """The matrix times the vector."""
    return product(M, v[..., None])[..., 0]


def rotation_from_vector(w: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrix of a rotation vector (axis times angle, radians): kornia's Rodrigues formula.

    Exact to rounding in float32 too, and differentiable any number of times, at angle zero as elsewhere.
    (`torch.linalg.matrix_exp` is off by 2e-14 a step in float64.)

    >>> rotation_from_vector(torch.tensor([0.0, 0.0, torch.pi / 2])).round(decimals=6)[0, 1].item()
    -1.0
    """
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    return axis_angle_to_rotation_matrix(w)


def rotation_vector(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Axis times angle of a rotation, radians: the inverse of `rotation_from_vector` up to 180 degrees."""
    from kornia.geometry.conversions import rotation_matrix_to_axis_angle

    return rotation_matrix_to_axis_angle(R)


def nearest_rotation(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """A matrix that is a rotation but for rounding, made one to rounding squared: R (3 I - R^T R) / 2."""
    return 1.5 * R - product(0.5 * R, product(R.mT, R))


def rotation_error(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """How far R is from a rotation: the largest entry of |R R^T - I|, or 2 for a reflection."""
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    error = (product(R, R.mT) - eye).abs().amax((-1, -2))
    return torch.where(torch.linalg.det(R) > 0, error, error.clamp(min=2.0))
