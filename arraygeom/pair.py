"""Pairs of views, and links that relate views that are not calibrated."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from .batching import Batched
from .camera import Camera, LensView, View
from .checks import check_numbers, check_origin, checking, derived
from .epipolar import fundamental_matrix
from .homography import plane_homography
from .pixels import HW, product, resize_matrix
from .pose import Pose
from .runtime.text import baseline_text, depth_text
from .runtime.tracing import traced

SAME_CENTRE = 1e-12
"""Metres between centres, or entries of F, that are rounding."""
Depths = tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]


@dataclass(frozen=True, eq=False, repr=False)
class Link(Batched):
    """Two-view geometry of an uncalibrated pair: x_beta^T F x_alpha = 0 and, roughly, x_beta ~ H x_alpha.

    For views with lenses x are undistorted pixels (`LensView.undistort`).

    Attributes:
        F: fundamental matrix; 0 for cameras at one place, or whose scene is one plane or far away, so that H
            is all there is and depth has no effect.
        H: rough homography; None if unknown.
        spread: standard deviation of points from H x, pixels of beta, where H is all there is; 0 if unknown.

    Raises:
        ValueError: for other shapes, NaN or infinity.
        TypeError: for matrices that are no floating-point tensors.
    """

    item_axes: ClassVar = {"F": 2, "H": 2}
    F: Float[Tensor, "*b 3 3"]
    H: Float[Tensor, "*b 3 3"] | None = None
    spread: float = 0.0

    def __post_init__(self) -> None:
        if checking():
            for name, matrix in (("F", self.F), ("H", self.H)):
                if not (name == "H" and matrix is None):
                    check_numbers(matrix, (3, 3), name)

    @classmethod
    def from_homography(cls, H: Float[Tensor, "*b 3 3"], spread: float = 0.0) -> Link:
        """Make the link of images that H alone registers, with points that are `spread` off it."""
        return cls(torch.zeros_like(H), H, spread)

    def reversed(self) -> Link:
        """Return the link with alpha and beta exchanged."""
        if self.H is None:
            return Link(self.F.transpose(-1, -2))
        back = torch.linalg.inv(self.H)
        return Link(self.F.transpose(-1, -2), back, self.spread and self.spread * _enlargement(back))

    def _text(self) -> str:
        return "F" if self.H is None else "F and H" if self.F.any() else "H"

    def transformed(self, A_alpha: Float[Tensor, "*b 3 3"], A_beta: Float[Tensor, "*c 3 3"]) -> Link:
        """Return the link between images whose pixels are A x of the old ones."""
        A_alpha, A_beta = A_alpha.to(self.F), A_beta.to(self.F)
        back = torch.linalg.inv(A_alpha)
        F = product(product(torch.linalg.inv(A_beta).mT, self.F), back)
        H = None if self.H is None else product(product(A_beta, self.H), back)
        return Link(F, H, self.spread and self.spread * _enlargement(A_beta))


def _enlargement(H: Tensor) -> float:
    """Return the factor of lengths by a homography, at the first pixel."""
    return float((H[..., :2, :2].det().abs().sqrt() / H[..., 2, 2].abs()).mean())


@dataclass(frozen=True, eq=False, repr=False)
class Pair(Batched):
    """Alpha and one beta with their relation: two calibrated cameras, or a link, or only sizes.

    Nothing is checked here: `Rig.pair` makes pairs.

    Attributes:
        alpha: view whose pixels are matched.
        beta: view in which their matches are searched.
        depth: (near, far) along alpha's axis, or rays (`natural_bounds`), in `unit`; None if unknown.
        link: F and H measured between the two, which count before a calibration; None if there is none.
        unit: unit of lengths; "baselines" for rigs of unknown scale.
        memo: cache of what fields compute once for a pair; never copied.
    """

    alpha: View
    beta: View
    depth: Depths | None = None
    link: Link | None = None
    unit: str = "m"
    memo: dict[str, Any] = field(default_factory=dict, init=False, compare=False, repr=False)

    @property
    def calibrated(self) -> bool:
        """True if both cameras are calibrated."""
        return isinstance(self.alpha, Camera) and isinstance(self.beta, Camera)

    @property
    def at_one_place(self) -> bool:
        """True if depth moves no point between the images: of equal centres, or of a link of H alone."""
        if traced() or (self.link is None and not self.calibrated):
            return False
        moves = self.beta_from_alpha.t if self.link is None else self.link.F
        return float(moves.detach().abs().max()) < SAME_CENTRE

    @property
    def has_lens(self) -> bool:
        """True if either view has a lens that distorts, so that lines are curves in its image."""
        lenses = [view.distortion for view in (self.alpha, self.beta) if isinstance(view, LensView)]
        return any(lens is not None and not lens.harmless for lens in lenses)

    @property
    def cameras(self) -> tuple[Camera, Camera]:
        """Both cameras, (alpha, beta).

        Raises:
            ValueError: unless both are calibrated.
        """
        if not (isinstance(self.alpha, Camera) and isinstance(self.beta, Camera)):
            raise ValueError(
                "this field needs calibrated cameras and the pair has none: "
                "use one that needs only F or sizes, such as HomographyDisplacement or Rectified"
            )
        return self.alpha, self.beta

    @property
    def beta_from_alpha(self) -> Pose:
        """Pose X_beta = R X_alpha + t, in `unit`; t is 0 where it is only rounding of the cameras' poses.

        Raises:
            ValueError: unless both cameras are calibrated, and, with a depth range, for float32 poses too far
                from the origin (`check_origin`).
        """
        alpha, beta = self.cameras
        if checking() and self.depth is not None:
            check_origin(self.depth[0], alpha.t, beta.t, unit=self.unit)
        # torch.compile cannot trace @ of these
        pose = beta.cam_from_world.__matmul__(alpha.cam_from_world.inverse())
        baseline, *sides = (t.detach().norm(dim=-1, keepdim=True) for t in (pose.t, alpha.t, beta.t))
        is_rounding = baseline <= ROUNDED * torch.finfo(baseline.dtype).eps * sum(sides)
        return derived(Pose, pose.R, pose.t - torch.where(is_rounding, pose.t.detach(), 0.0))

    @property
    def depth_range(self) -> Depths:
        """Depth range (near, far) along alpha's axis, or rays (`natural_bounds`), in `unit`.

        Raises:
            ValueError: if the rig states none.
        """
        if self.depth is None:
            raise ValueError(
                "the rig states no depth range: give it one, `depth: [near, far]` in its file or "
                "`rig.replace(depth=(near, far))`, or `--depth NEAR FAR` to `pat fuse` and `pat align`; "
                "`pat rig doctor` says between which depths it finds points"
            )
        return self.depth

    @property
    def fundamental(self) -> Float[Tensor, "*b 3 3"]:
        """Fundamental matrix F with x_beta^T F x_alpha = 0: the link's, else that of the cameras.

        It relates undistorted pixels. Zero without a baseline, and for a link of H alone.

        Raises:
            ValueError: if neither calibration nor F is known, or, without a link, for a camera that is not
                central, and as `beta_from_alpha`.
        """
        if self.link is not None:
            return self.link.F
        if not self.calibrated:
            raise ValueError(
                "neither the cameras' calibration nor F is known for this pair: give the rig a link"
            )
        alpha, beta = self._central("fundamental matrix")
        return fundamental_matrix(alpha.K, beta.K, self.beta_from_alpha)

    @property
    def homography(self) -> Float[Tensor, "*b 3 3"]:
        """Homography H with x_beta ~ H x_alpha, roughly: the link's, else of the plane at the middle inverse
        depth.

        Undistorted pixels, for views with lenses. Calibrated cameras without a depth range give the plane at
        infinity; other pairs known only by sizes, or by F alone, are assumed to have one field of view.

        Raises:
            ValueError: as `homography_at`, where it is a plane's.
        """
        if self.link is not None and self.link.H is not None:
            return self.link.H
        if self.calibrated and self.depth is not None:
            near, far = self.depth
            return self.homography_at(2 / (1 / near + 1 / far))  # the middle of the disparities
        if self.calibrated:
            return self.homography_at(torch.tensor(torch.inf, dtype=torch.float64))
        return resize_matrix(self.alpha.hw, self.beta.hw)

    def transform_beta(self, A: Float[Tensor, "3 3"], hw: HW) -> Pair:
        """Return the pair in which beta's pixels are x' ~ A x and its image's size is `hw`."""
        eye = torch.eye(3, dtype=A.dtype)
        link = None if self.link is None else self.link.transformed(eye, A)
        return dataclasses.replace(self, beta=self.beta.transformed(A, hw), link=link)

    def homography_at(self, depth: Float[Tensor, "*d"] | float) -> Float[Tensor, "*b 3 3"]:
        """Compute the homography of the plane z = depth in alpha's frame, from alpha's undistorted pixels to
        beta's.

        Args:
            depth: depths (*d) in the rig's unit, which broadcast with the pair's batch axes; may be infinite.

        Returns:
            H (*b, 3, 3), of batch and depths broadcast, scaled so that its third coordinate is positive
            in front of both cameras.

        Raises:
            ValueError: unless both cameras are calibrated and central, for depths that are not positive, and
                as `beta_from_alpha`. Depths that do not broadcast give RuntimeError.
        """
        alpha, beta = self._central("homography")
        depth = torch.as_tensor(depth).to(alpha.K)
        if checking() and not depth.is_meta and not bool((depth > 0).all()):
            raise ValueError(f"a plane at a depth of {_shown(depth)} has no homography: give metres above 0")
        normal = alpha.K.new_tensor([0.0, 0.0, 1.0])
        pose = self.beta_from_alpha
        return plane_homography(alpha.K, beta.K, pose.R, pose.t, normal=normal, d=-depth)

    def _central(self, what: str) -> tuple[Camera, Camera]:
        """Both cameras. Raises ValueError if the rays of one do not meet in a point."""
        for camera in self.cameras:
            if not camera.central and camera.distortion is not None:
                model = camera.distortion.model
                raise ValueError(
                    f"rays of a camera ({model}) do not meet in a point: there is no {what}; use Curved"
                )
        return self.cameras

    def _text(self) -> str:
        views = {"alpha": self.alpha, "beta": self.beta}
        named = ", ".join(f"{name} {view._text()}" for name, view in views.items())
        link = "" if self.link is None else f"link by {self.link._text()}"
        lengths = baseline_text(views, self.unit), depth_text(self.depth, self.unit)
        return "; ".join(filter(None, (named, *lengths, link)))


ROUNDED = 8
"""Units in the last place of the cameras' translations below which a baseline counts as none."""


def depth_range(near: Any, far: Any) -> Depths:
    """Convert depth bounds to tensors: numbers by `float` to float64, tensors as they are.

    Returns:
        (near, far).

    Raises:
        ValueError: unless 0 < near <= far and near is finite; not checked while torch traces.
        TypeError: for a bound that is no number; ValueError for a text, unless it reads as one.
    """
    bounds = [
        d if isinstance(d, Tensor) else torch.tensor(float(d), dtype=torch.float64) for d in (near, far)
    ]
    near, far = bounds
    sound = traced() or near.is_meta or far.is_meta
    if not sound and not bool(((near > 0) & near.isfinite() & (far >= near)).all()):
        raise ValueError(
            "depth bounds must satisfy 0 < near <= far, in metres; "
            f"got near = {_shown(near)}, far = {_shown(far)}"
        )
    return near, far


def _shown(d: Tensor) -> str:
    return ", ".join(f"{v:g}" for v in d.reshape(-1).tolist())
