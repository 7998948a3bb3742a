"""Rigid transforms: X_to = R X_from + t."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from jaxtyping import Float, Real
from torch import Tensor

from .batching import Batched
from .checks import check_batches, check_numbers, check_rotation, checking, derived
from .pixels import broadcast_shapes, broadcasts, floating, product
from .runtime.text import angle, range_text
from .runtime.tracing import traced

if TYPE_CHECKING:
    from kornia.geometry.liegroup import Se3
    from kornia.geometry.pose import NamedPose


@dataclass(frozen=True, eq=False, repr=False)
class Pose(Batched):
    """Rigid transform named `to_from_from`, for instance `cam_from_world`: X_cam = R X_world + t.

    Poses compose where the inner words meet: `b_from_a @ a_from_world` is `b_from_world`.

    Attributes:
        R: rotation, to rounding (`ROUNDED` of `arraygeom.checks`); it is kept as given.
        t: translation, metres.

    Raises:
        ValueError: for an R that is not a rotation, other shapes, NaN or infinity, and batch axes that do not
            broadcast.
        TypeError: for values that are no floating-point tensors.
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
    def identity(cls, *, dtype: torch.dtype = torch.float64) -> Pose:
        """Return the identity transform."""
        return cls(torch.eye(3, dtype=dtype), torch.zeros(3, dtype=dtype))

    @classmethod
    def from_centre(cls, R: Float[Tensor, "*b 3 3"], centre: Float[Tensor, "*b 3"]) -> Pose:
        """Make `cam_from_world` of a camera with rotation R and optical centre in the world, metres."""
        return cls(R, -matvec(R, centre))

    @classmethod
    def look_at(
        cls,
        centre: Float[Tensor, "*b 3"],
        target: Float[Tensor, "*b 3"],
        *,
        down: Float[Tensor, "*b 3"] | None = None,
    ) -> Pose:
        """Make `cam_from_world` of a camera at `centre` that looks at `target`, with y nearest to `down`.

        >>> Pose.look_at(torch.tensor([0.0, 0.0, -2.0]), torch.zeros(3)).t.tolist()
        [-0.0, -0.0, 2.0]

        Args:
            centre: world coordinates, metres.
            target: world coordinates, metres.
            down: direction in the world; None for (0, 1, 0). For a world with z upwards it is (0, 0, -1).

        Raises:
            ValueError: if down is along the axis, the target at the centre, or for NaN; not while torch
                compiles.
        """
        z = target - centre
        down = z.new_tensor([0.0, 1.0, 0.0]) if down is None else down.to(z)
        x = torch.linalg.cross(down.expand_as(z), z)
        if not traced() and not bool((x.norm(dim=-1) > 1e-6 * down.norm(dim=-1) * z.norm(dim=-1)).all()):
            raise ValueError(
                "the target is at the centre, or `down` along the axis to it: give another `down`"
            )
        x, z = (v / v.norm(dim=-1, keepdim=True) for v in (x, z))
        return cls.from_centre(torch.stack([x, torch.linalg.cross(z, x), z], -2), centre)

    @classmethod
    def from_matrix(cls, matrix: Float[Tensor, "*b _ 4"]) -> Pose:
        """Make a pose of [R t], (*b, 4, 4) or (*b, 3, 4)."""
        return cls(matrix[..., :3, :3], matrix[..., :3, 3])

    @property
    def matrix(self) -> Float[Tensor, "*b 4 4"]:
        """Matrix [R t; 0 0 0 1]."""
        R, t = self.R.expand(*self.batch_shape, 3, 3), self.t.expand(*self.batch_shape, 3)
        return torch.cat(
            [torch.cat([R, t[..., None]], -1), R.new_tensor([0.0, 0, 0, 1]).expand(*R.shape[:-2], 1, 4)], -2
        )

    @classmethod
    def from_quaternion(cls, q: Float[Tensor, "*b 4"], t: Float[Tensor, "*b 3"]) -> Pose:
        """Make a pose of quaternions (w, x, y, z), of any length above 1e-12, and translations (metres).

        Raises:
            ValueError: for a quaternion of zeros, and as the constructor.
        """
        from kornia.geometry.conversions import quaternion_to_rotation_matrix

        if checking() and not bool(q.any(-1).all()):
            raise ValueError("a quaternion is 0: give (w, x, y, z) of a length above 0")
        return cls(quaternion_to_rotation_matrix(q), t)

    @property
    def quaternion(self) -> Float[Tensor, "*b 4"]:
        """Rotation as quaternion (w, x, y, z) of unit length; q and -q are the same rotation."""
        from kornia.geometry.conversions import rotation_matrix_to_quaternion

        return rotation_matrix_to_quaternion(self.R)

    @classmethod
    def from_kornia(cls, pose: Se3 | NamedPose) -> Pose:
        """Make a pose of kornia's `Se3`, or of the `Se3` of a `NamedPose`, with its gradient.

        Raises:
            ValueError: for a pose in the plane (`Se2`).
        """
        given: Any = getattr(pose, "pose", pose)
        return cls.from_matrix(given.matrix())

    def to_kornia(self) -> Se3:
        """Convert to kornia's `Se3`, which stores a quaternion: R comes back except for rounding."""
        from kornia.geometry.liegroup import Se3, So3
        from kornia.geometry.quaternion import Quaternion

        return Se3(So3(Quaternion(self.quaternion)), self.t)

    def __matmul__(self, other: Pose) -> Pose:
        if not isinstance(other, Pose):
            raise TypeError(f"a Pose times a {type(other).__name__}: give a Pose, or `apply` it to points")
        return derived(Pose, product(self.R, other.R), matvec(self.R, other.t) + self.t)

    def inverse(self) -> Pose:
        """Return the inverse transform, `from_from_to`."""
        Rt = self.R.transpose(-1, -2)
        return derived(Pose, Rt, -matvec(Rt, self.t))

    def apply(self, X: Real[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Transform points (*n, 3) to R X + t. With batched poses (*b), points are (*b, ..., 3).

        Returns:
            Points in the wider type of both, whose leading axes of length 1 become the batch's.

        Raises:
            ValueError: for points of other than three numbers, or without the batch's axes.
            TypeError: for points that are no tensor.
        """
        X, batch = floating(X), self.batch_shape
        if not broadcasts(batch, X.shape[:-1]):
            raise ValueError(
                f"poses batched over {tuple(batch)} need points (*batch, ..., 3), got {tuple(X.shape)}"
            )
        beside = (..., *[None] * (X.ndim - 1 - len(batch)))
        t = self.t.expand(*batch, 3).movedim(-1, 0)[beside].movedim(0, -1)
        if X.ndim - 1 == len(batch):
            return matvec(self.R, X) + t
        R = self.R.expand(*batch, 3, 3).movedim((-2, -1), (0, 1))[beside[:-1]].movedim((0, 1), (-2, -1))
        return product(X, R.mT) + t

    @property
    def centre(self) -> Float[Tensor, "*b 3"]:
        """Origin of `to` in `from`: a camera's optical centre in the world, metres."""
        return self.inverse().t

    @property
    def centre_jacobian(self) -> Float[Tensor, "*b 3 6"]:
        """Derivatives (3, 6) of the centre by the rotation vector and the translation of `perturbed`."""
        eye = torch.eye(3).to(self.t).expand_as(self.R)
        return -self.R.mT @ torch.cat([cross_matrix(self.t), eye], -1)

    def perturbed(
        self, rotation: Float[Tensor, "*b 3"] | None = None, translation: Float[Tensor, "*b 3"] | None = None
    ) -> Pose:
        """Step on the manifold: exp(rotation) R and t + translation, always in SO(3).

        Rounding of the product is removed, so that steps do not add up to a drift.

        Args:
            rotation: rotation vector in radians, about the axes of `to`; None keeps R as it is.
            translation: metres; None keeps t.

        Returns:
            The pose, unchecked: NaN passes.
        """
        R = self.R if rotation is None else nearest_rotation(product(rotation_from_vector(rotation), self.R))
        return derived(Pose, R, self.t if translation is None else self.t + translation)

    def _text(self) -> str:
        degrees = angle(self.R).rad2deg()
        if self.batch_shape:
            return f"{range_text(degrees, '.3g')} deg"
        return f"rotation {float(degrees):.2f} deg, t ({', '.join(f'{v:.4g}' for v in self.t.tolist())}) m"


def cross_matrix(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return [v]x, the matrix with [v]x w = v x w; kornia's."""
    from kornia.geometry.epipolar import cross_product_matrix

    return cross_product_matrix(v)


def matvec(M: Float[Tensor, "*b i j"], v: Float[Tensor, "*b j"]) -> Float[Tensor, "*b i"]:
    """Multiply matrices with vectors, as `product`."""
    return product(M, v[..., None])[..., 0]


def rotation_from_vector(w: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Convert a rotation vector (axis times angle, radians) to a matrix, by kornia's Rodrigues formula.

    Exact to rounding in float32 too, and differentiable any number of times, at angle zero as elsewhere.

    >>> rotation_from_vector(torch.tensor([0.0, 0.0, torch.pi / 2])).round(decimals=6)[0, 1].item()
    -1.0

    Returns:
        The rotation matrix.

    Raises:
        ValueError: for other than three numbers.
        TypeError: for a value that is no tensor.
    """
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    return axis_angle_to_rotation_matrix(w)


def rotation_vector(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Convert a rotation to axis times angle, radians, up to pi: the inverse of `rotation_from_vector`."""
    from kornia.geometry.conversions import rotation_matrix_to_axis_angle

    return rotation_matrix_to_axis_angle(R)


def in_float64(function: Callable[..., Tensor], *tensors: Tensor) -> Tensor:
    """Evaluate a function of small matrices in float64, unaffected by autocast and TF32.

    Matrices are expanded to common batch axes.

    Returns:
        The function's result, in the widest type of the matrices, float32 at least.

    Raises:
        ValueError: for batch axes that do not broadcast.
    """
    batch = broadcast_shapes(*(t.shape[:-2] for t in tensors))
    dtype = torch.promote_types(torch.float32, reduce(torch.promote_types, (t.dtype for t in tensors)))
    return function(*(t.double().expand(*batch, *t.shape[-2:]) for t in tensors)).to(dtype)


def nearest_rotation(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """Correct a near rotation by one Newton step, which squares its error: R (3 I - R^T R) / 2."""
    return 1.5 * R - product(0.5 * R, product(R.mT, R))


def rotation_error(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Measure R's distance from a rotation: the largest entry of |R R^T - I|, 2 or more for a reflection."""
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    error = (product(R, R.mT) - eye).abs().amax((-1, -2))
    return torch.where(torch.linalg.det(R) > 0, error, error.clamp(min=2.0))
