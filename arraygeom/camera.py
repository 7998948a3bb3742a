"""Cameras: intrinsics, lens, pose and size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, is_dataclass
from numbers import Real as Number
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from .batching import Batched
from .checks import check_above, check_batches, check_hw, check_K, checking
from .distortion import Distortion
from .kornia_models import from_kornia_model, to_kornia_model, to_pinhole
from .lenses.common import on_plane
from .lenses.model import LensModel, check_model
from .pixels import (
    HW,
    broadcast_shapes,
    coarse_grid,
    floating,
    map_homogeneous,
    product,
    resize_matrix,
    rot90_matrix,
    shift_matrix,
    to_homogeneous,
    within,
)
from .pose import Pose
from .runtime.text import range_text
from .runtime.tracing import traced
from .sensor import Sensor, response_text

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera
    from kornia.sensors.camera import CameraModel


class Projected(NamedTuple):
    """Projection of points into an image.

    Attributes:
        x: pixels (x, y); without meaning where not `valid`.
        depth: z in the camera's frame, metres, of any sign.
        valid: True for points that the model sees: in front of a pinhole (X and Y may be NaN), within a lens
            model's range; the image's borders are not considered.
    """

    x: Float[Tensor, "*n 2"]
    depth: Float[Tensor, "*n"]
    valid: Bool[Tensor, "*n"]


AnyView = TypeVar("AnyView", bound="View")


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class View(Batched):
    """Properties of any camera, calibrated or not.

    Attributes:
        hw: image size (height, width), pixels.
        sensor: properties of what the camera records: spectral response, bits, exposure, ...

    Raises:
        ValueError: for an invalid size.
        TypeError: for a `sensor` that is no Sensor.
    """

    hw: HW
    sensor: Sensor = field(default_factory=Sensor)

    def __post_init__(self) -> None:
        if checking():
            check_hw(self.hw)
            if not isinstance(self.sensor, Sensor):
                raise TypeError(
                    f"sensor is a {type(self.sensor).__name__}: give a Sensor, as Sensor(response='mono')"
                )

    def resize(self: AnyView, hw: HW) -> AnyView:
        """Return the view of images resized to `hw`: c' = (c + 0.5) s - 0.5."""
        return self.transformed(resize_matrix(self.hw, hw), hw)

    def crop(self: AnyView, top: int, left: int, hw: HW) -> AnyView:
        """Return the view of a window of size `hw`. A negative `top` or `left`, or a larger size, pads."""
        return self.transformed(shift_matrix(left, top), hw)

    def rot90(self: AnyView, quarter_turns: int) -> AnyView:
        """Return the view of images rotated counter-clockwise, as `torch.rot90(image, k, (-2, -1))`."""
        hw = self.hw if quarter_turns % 2 == 0 else (self.hw[1], self.hw[0])
        return self.transformed(rot90_matrix(self.hw, quarter_turns), hw)

    def transformed(self: AnyView, A: Float[Tensor, "*b 3 3"], hw: HW) -> AnyView:
        """Return the view of images with pixels x' ~ A x and size `hw`."""
        return self.replace(hw=hw)

    def undistort(self, x: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Map pixels of the image to undistorted pixels.

        Returns:
            Undistorted pixels, and True within the lens model's range. Without a lens the pixels themselves.
        """
        return floating(x), torch.ones_like(floating(x)[..., 0], dtype=torch.bool)

    def distort(self, x: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Map undistorted pixels to pixels of the image: the inverse of `undistort`.

        Returns:
            Pixels, and True within the lens model's range.
        """
        return floating(x), torch.ones_like(floating(x)[..., 0], dtype=torch.bool)

    @property
    def has_pinhole_view(self) -> bool:
        """True if a pinhole camera can replace the view once its image is undistorted."""
        return True

    def contains(self, x: Real[Tensor, "*n 2"]) -> Bool[Tensor, "*n"]:
        """Return True for points on the image's area, [-0.5, W - 0.5] x [-0.5, H - 0.5]."""
        return within(floating(x), self.hw)

    def _text(self) -> str:
        return " ".join(filter(None, view_facts(self)))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class LensView(View):
    """View with a lens model, whose focal length and pose need not be known.

    Without a calibration K is only the scale and centre to which `distortion` refers: angles of `rays` mean
    nothing then. Links of such views relate undistorted pixels. A subclass must not override `rays` or
    `project_local`: models of one's own are a `CameraModel`.

    >>> lens = Distortion("brown-conrady", torch.tensor([-0.1, 0, 0, 0], dtype=torch.float64))
    >>> view = LensView(hw=(61, 101), K=intrinsics(50.0, (61, 101)), distortion=lens)
    >>> view.distort(torch.tensor([100.0, 30.0], dtype=torch.float64))[0].tolist()
    [95.0, 30.0]

    Attributes:
        K: map from the plane z = 1 (after the lens) to pixels, last row (0, 0, 1), not singular.
        distortion: lens model; None for a pinhole.

    Raises:
        ValueError: for an invalid size or K, NaN in a lens, or batch axes that do not broadcast.
        TypeError: for fields of other types, a `CameraModel` that `check_model` refuses, and, when it is
            defined, such a subclass.
        NotImplementedError: for a `CameraModel` without one of its methods.
    """

    item_axes: ClassVar = {"K": 2}
    K: Float[Tensor, "*b 3 3"]
    distortion: LensModel | None = None

    def __init_subclass__(cls, **rest: Any) -> None:
        super().__init_subclass__(**rest)
        overridden = [name for name in ("rays", "project_local") if name in vars(cls)]
        if overridden and cls.__module__ != __name__:
            raise TypeError(
                f"{cls.__name__} overrides {' and '.join(overridden)}, which fields do not ask: make it a "
                "arraygeom.lenses.CameraModel with project and unproject, "
                "and give that to a Camera as `distortion`"
            )

    def __post_init__(self) -> None:
        super().__post_init__()
        if checking():
            check_K(self.K)
            if not isinstance(self.distortion, LensModel | None):
                kind = type(self.distortion).__name__
                raise TypeError(
                    f"distortion is a {kind}: give a Distortion(model, coefficients), "
                    "or a camera model of your own, a subclass of arraygeom.lenses.CameraModel"
                )
            if self.distortion is not None and not is_dataclass(self.distortion):
                kind = type(self.distortion).__name__
                raise TypeError(
                    f"{kind} is no dataclass: put @dataclass(frozen=True, eq=False, repr=False) before it"
                )
            check_model(self.distortion)
            check_batches("K and lens", self.K.shape[:-2], self._lens_batch)

    @property
    def _lens_batch(self) -> torch.Size:
        return self.distortion.batch_shape if self.distortion is not None else torch.Size()

    def _normalised(self, x: Tensor) -> Tensor:
        """Map pixels to points of the image plane, which the lens takes to rays."""
        return map_homogeneous(torch.linalg.inv(self.K)[..., :2, :], x)

    def project_local(self, X: Real[Tensor, "*n 3"]) -> Projected:
        """Compute the projections of points (*n, 3) in the camera's frame."""
        X = floating(X)
        normalised, valid = on_plane(X) if self.distortion is None else self.distortion.project(X)
        return Projected(map_homogeneous(self.K[..., :2, :], normalised), X[..., 2], valid)

    def rays(self, x: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*m 3"], Bool[Tensor, "*m"]]:
        """Compute the directions of pixels' rays, which start at `ray_origins`, in the camera's frame.

        Returns:
            Directions (z = 1 for pinholes, unit length with a `Distortion`, any length by other models), and
            True where there is one; others mean nothing. A pinhole says True for NaN pixels too.

        Raises:
            ValueError: for pixels without the axes of a batched K: wanted (*b, ..., 2).
            RuntimeError: for pixels without those of a lens, where K has none.
        """
        normalised = self._normalised(x)
        if self.distortion is None:
            return to_homogeneous(normalised), torch.ones_like(normalised[..., 0], dtype=torch.bool)
        return self.distortion.unproject(normalised)

    def ray_origins(self, x: Real[Tensor, "*n 2"]) -> Float[Tensor, "*m 3"]:
        """Return the start of each pixel's ray in the camera's frame, metres: 0 if the camera is central."""
        normalised = self._normalised(x)
        if self.distortion is None:
            return torch.zeros_like(to_homogeneous(normalised))
        return self.distortion.origins(normalised)

    @property
    def has_pinhole_view(self) -> bool:
        """True for no lens, a `Distortion`, or a central model whose image is within 75 degrees off axis."""
        if isinstance(self.distortion, Distortion | None):
            return True
        if not self.distortion.central or traced():
            return False
        rays, valid = self.rays(coarse_grid(self.hw).to(self.K).reshape(*[1] * len(self.batch_shape), -1, 2))
        return bool((valid & (rays[..., 2] > NARROW * rays.norm(dim=-1))).all())

    @property
    def central(self) -> bool:
        """True if all rays start in the camera's origin."""
        return self.distortion is None or self.distortion.central

    @property
    def parallel(self) -> bool:
        """True if all rays are parallel, and the image plane is in metres."""
        return self.distortion is not None and self.distortion.even == "distance"

    def undistort(self, x: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Map pixels of the image to pixels of a pinhole with the same K.

        Returns:
            Undistorted pixels, and True within the lens model's range.
        """
        return self._each_through(lambda lens, xy: lens.undistort(xy), x)

    def distort(self, x: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Map undistorted pixels to pixels of the image: the inverse of `undistort`.

        Returns:
            Pixels, and True within the lens model's range.
        """
        return self._each_through(lambda lens, xy: lens.distort(xy), x)

    def transformed(self: AnyLensView, A: Float[Tensor, "*b 3 3"], hw: HW) -> AnyLensView:
        """Return the view of images with pixels x' ~ A x and size `hw`: K' = A K.

        A may be that of kornia's augmentations (`transform_matrix`), mirrored too, one for each of a batch.

        Raises:
            ValueError: for a last row of A other than (0, 0, 1) (no K describes a perspective), a singular A,
                an invalid size, or batch axes that do not broadcast with a lens's or a pose's.
            RuntimeError: for batch axes that do not broadcast with K's.
        """
        if checking() and not bool(((A[..., 2, :] - A.new_tensor([0, 0, 1])).abs() < 1e-6).all()):
            raise ValueError("A is a perspective, which no K follows: crop, resize, mirror, rotate or shear")
        return self.replace(K=product(A.to(self.K), self.K), hw=hw)

    def scaled(self: AnyLensView, factor: float) -> AnyLensView:
        """Return the view with all lengths multiplied by a factor, as for another unit.

        Raises:
            ValueError: for a factor that is not positive and finite, and a lens that is not central and does
                not state which of its numbers are lengths.
        """
        check_above(0, itself=False, factor=factor)
        K, lens = self.K, self.distortion
        if self.parallel:  # the image plane is in metres
            K = torch.cat([K[..., :2] / K.new_tensor([factor, factor, 1.0])[:, None], K[..., 2:]], -1)
        return self.replace(K=K, distortion=lens and lens.scaled(factor))

    def _each_through(self, f: ThroughLens, x: Tensor) -> tuple[Tensor, Tensor]:
        """Map pixels to normalised points, through f, and back to pixels."""
        if self.distortion is None:
            return super().undistort(x)
        normalised, valid = f(self.distortion, self._normalised(x))
        return map_homogeneous(self.K[..., :2, :], normalised), valid


NARROW = 0.259
"""Cosine of 75 degrees."""
AnyLensView = TypeVar("AnyLensView", bound=LensView)
ThroughLens = Callable[[Any, Tensor], tuple[Tensor, Tensor]]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Camera(LensView):
    """Calibrated camera. Leading batch axes everywhere; every tensor may require grad.

    K is affine, not necessarily upper triangular: that of a rotated image has zeros on its diagonal. The
    first pixel's centre is (0, 0).

    >>> K = torch.tensor([[100.0, 0, 49.5], [0, 100.0, 29.5], [0, 0, 1]], dtype=torch.float64)
    >>> camera = Camera(K=K, cam_from_world=Pose.identity(), hw=(60, 100))
    >>> camera.project(torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)).x.tolist()
    [49.5, 29.5]

    Attributes:
        cam_from_world: pose, X_cam = R X_world + t in metres, x right, y down, z forward.

    Raises:
        ValueError: for a pose whose batch axes do not broadcast, and as `LensView`.
        TypeError: for a pose that is no Pose, and as `LensView`, which raises NotImplementedError too.
    """

    cam_from_world: Pose

    def __post_init__(self) -> None:
        super().__post_init__()
        if checking():
            if not isinstance(self.cam_from_world, Pose):
                raise TypeError(
                    f"cam_from_world is a {type(self.cam_from_world).__name__}: give a Pose(R, t)"
                )
            shapes = self.K.shape[:-2], self._lens_batch, self.cam_from_world.batch_shape
            check_batches("K, lens and cam_from_world", *shapes)

    def scaled(self, factor: float) -> Camera:
        """Return the camera with all lengths multiplied by a factor; raises as `LensView.scaled`."""
        return super().scaled(factor).replace(cam_from_world=Pose(self.R, self.t * factor))

    @property
    def R(self) -> Float[Tensor, "*b 3 3"]:
        """Rotation of `cam_from_world`."""
        return self.cam_from_world.R

    @property
    def t(self) -> Float[Tensor, "*b 3"]:
        """Translation of `cam_from_world`, metres."""
        return self.cam_from_world.t

    @property
    def centre(self) -> Float[Tensor, "*b 3"]:
        """Optical centre in the world, metres."""
        return self.cam_from_world.centre

    def project(self, X: Real[Tensor, "*n 3"]) -> Projected:
        """Project world points (*n, 3); with a batched camera (*b), points are (*b, ..., 3).

        Returns:
            Pixels, depth in metres, and validity.
        """
        return self.project_local(self.cam_from_world.apply(X))

    def unproject(self, x: Real[Tensor, "*n 2"], depth: Real[Tensor, "*n"]) -> Float[Tensor, "*n 3"]:
        """Compute the world points of pixels at depth z (metres).

        Returns:
            World points (metres); NaN for pixels outside the lens's range (see `rays`), rays at 90 degrees
            off axis, and depths that rays do not reach: NaN, below 0 for rays ahead, above 0 for rays farther
            off axis than that. Infinite depths give NaN or infinity.

        Raises:
            ValueError: if pixels and depths do not broadcast or are then more than either, as (n, 2) beside
                (n, 1), and for pixels without the axes of a batch of cameras.
        """
        rays, valid = self.rays(x)
        z = rays[..., 2]
        _check_pairs(z.shape, depth.shape)
        valid = valid & (z != 0) & (z * depth >= 0)
        X = rays * (depth / torch.where(valid, z, 1.0))[..., None]
        if not self.central:
            start = self.ray_origins(x)
            X = X + start - rays * (start[..., 2] / torch.where(valid, z, 1.0))[..., None]
        X = self.cam_from_world.inverse().apply(torch.where(valid[..., None], X, 0.0))
        return torch.where(valid[..., None], X, torch.nan)

    def to_kornia(self) -> PinholeCamera | CameraModel:
        """Convert to kornia: a `PinholeCamera`, or a `CameraModel` for a lens with effect or gradient.

        Matrices of the former are (B, 4, 4), B = 1 for one camera; several batch axes become one. Kornia's
        camera models (`kornia.sensors.camera`) have no pose: keep `cam_from_world`. Pixels and axes agree.
        `PinholeCamera.scale` moves the principal point differently: `resize` first.

        Raises:
            ValueError: for a lens, or prism or tilt terms, that kornia does not have, and with a lens for
                a K that is skewed or rotated.
        """
        if self.distortion is not None and not self.distortion.harmless:
            return to_kornia_model(self.K, self.hw, self.distortion)
        return to_pinhole(self.K, self.cam_from_world, self.hw)

    @classmethod
    def from_kornia(
        cls, camera: PinholeCamera | CameraModel, *, batched: bool = False, cam_from_world: Pose | None = None
    ) -> Camera:
        """Convert a camera of kornia.

        Args:
            batched: True keeps a batch of one as a batch; a `CameraModel` keeps its axes as they are.
            cam_from_world: pose for a `CameraModel`, which has none; None for the identity. Else unused.

        Raises:
            ValueError: if the images of a batch differ in size, and as the constructor.
            TypeError: for another kind of camera.
        """
        from kornia.geometry.camera import PinholeCamera
        from kornia.sensors.camera import CameraModel

        if isinstance(camera, CameraModel):
            K, hw, lens = from_kornia_model(camera)
            if cam_from_world is None:
                here = Pose.identity().to(K)
                cam_from_world = Pose(here.R.expand_as(K), here.t.expand(K.shape[:-1]))
            return cls(K=K, cam_from_world=cam_from_world, hw=hw, distortion=lens)
        if not isinstance(camera, PinholeCamera):
            kind = type(camera).__name__
            raise TypeError(f"a {kind} is none of kornia's PinholeCamera and CameraModel: make one of these")
        sizes = sorted(
            {(int(h), int(w)) for h, w in zip(camera.height.reshape(-1), camera.width.reshape(-1))}
        )
        if len(sizes) > 1:
            listed = " and ".join(f"{w}x{h}" for h, w in sizes)
            raise ValueError(
                f"the cameras of a kornia batch have images of {listed}: convert those of each size apart"
            )
        pose = Pose(camera.extrinsics[..., :3, :3], camera.extrinsics[..., :3, 3])
        made = cls(K=camera.intrinsics[..., :3, :3], cam_from_world=pose, hw=sizes[0])
        return made[0] if made.batch_shape == (1,) and not batched else made


def _check_pairs(pixels: torch.Size, depths: torch.Size) -> None:
    """Raises ValueError unless pixels and depths, broadcast, are as many as one of both."""
    try:
        fits = broadcast_shapes(pixels, depths) in (pixels, depths)
    except (RuntimeError, ValueError):
        fits = False
    if not fits:
        raise ValueError(
            f"depth has the shape {tuple(depths)} beside pixels {tuple(pixels)}: wanted one for each pixel"
        )


def intrinsics(
    focal: tuple[Any, Any] | float | Tensor, hw: HW, centre: tuple[Any, Any] | Tensor | None = None
) -> Float[Tensor, "3 3"]:
    """Make K from focal lengths and principal point in pixels.

    >>> intrinsics(500.0, (480, 640))[0].tolist()
    [500.0, 0.0, 319.5]

    Args:
        focal: one number, or (fx, fy), of any sign; tensors keep their gradient.
        hw: height and width of the image, for the middle alone.
        centre: principal point (cx, cy); None for the image's middle, ((W - 1) / 2, (H - 1) / 2).

    Returns:
        K in float64, of one camera: a batch is made with `stack`.

    Raises:
        ValueError: for other than one number or a pair, or an invalid size.
        TypeError: for values that are no numbers.
    """
    fx, fy = _two(focal, "focal")
    cx, cy = _two(((hw[1] - 1) / 2, (hw[0] - 1) / 2) if centre is None else centre, "centre")
    entries = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    device = next((v.device for v in entries if isinstance(v, Tensor)), None)
    return torch.stack([torch.as_tensor(v, dtype=torch.float64, device=device) for v in entries]).reshape(
        3, 3
    )


def _two(value: Any, name: str) -> tuple[Any, Any]:
    """Pair of numbers; a single one counts for both."""
    if isinstance(value, Tensor) and value.numel() > 1:
        value = tuple(value)
    pair = tuple(value) if isinstance(value, tuple | list) else (value, value)
    if any(not isinstance(v, Number | Tensor) for v in pair):
        raise TypeError(f"{name} is {value!r}: give one number or two, in pixels")
    if len(pair) != 2 or any(isinstance(v, Tensor) and v.numel() != 1 for v in pair):
        raise ValueError(
            f"{name} is one number or two, in pixels, of one camera: make cameras one by one, and stack them"
        )
    return tuple(v.reshape(()) if isinstance(v, Tensor) else v for v in pair)  # type: ignore[return-value]


def view_facts(view: Any) -> tuple[str, str, str, str]:
    """Describe a view in words: size, focal length (pixels; empty if not calibrated), lens, response."""
    lens, focal = getattr(view, "distortion", None), ""
    if hasattr(view, "cam_from_world"):
        focal = "f=" + range_text(view.K.detach()[..., :2, :2].det().abs().sqrt(), ".4g")
    return f"{view.hw[1]}x{view.hw[0]}", focal, lens.model if lens else "", response_text(view.sensor)
