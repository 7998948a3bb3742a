"""Interface of camera models, and the models by name."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal, TypeVar

import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from ..batching import Batched, tensors_of
from ..checks import check_numbers
from ..pixels import broadcast_shapes, floating, to_homogeneous
from .common import on_plane

AnyLens = TypeVar("AnyLens", bound="LensModel")

CAMERA_MODELS: dict[str, type[CameraModel]] = {}
"""Camera models that rig files know by name, registered when they are defined with one."""
TAKEN: set[str] = set()
"""Other names of lenses in rig files: the models of `Distortion`."""


class LensModel(Batched):
    """Base class of the lens of a camera (`Camera.distortion`): a `Distortion` or a `CameraModel`, from which
    models of your own derive.

    Attributes:
        central: True if all rays start in the camera's origin.
        even: measure in which another camera's ray is followed evenly if a model is not central: "pixels", or
            "distance" for parallel rays, whose image plane is in metres.
        period: length of the image plane along x after which it repeats itself; 0 for never.
        model: name of the model in rig files.
        coefficients: numbers of the model (*b, n), one after the other.
    """

    central: ClassVar[bool] = True
    even: ClassVar[Literal["pixels", "distance"]] = "pixels"
    period: ClassVar[float] = 0.0
    model: str
    coefficients: Float[Tensor, "*b n"]

    def project(self, X: Real[Tensor, "*n 3"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Project points in the camera's frame (*n, 3), metres.

        Returns:
            Points of the image plane (*n, 2), which `Camera.K` takes to pixels, and True (*n) where seen;
            others mean nothing. A batch of lenses (*b) takes points (*b, ..., 3).

        Raises:
            NotImplementedError: in this base class.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no project(X): points (..., 3) to (x, y) and valid"
        )

    def unproject(self, xy: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 3"], Bool[Tensor, "*n"]]:
        """Compute the directions of points of the image plane (*n, 2).

        Returns:
            Directions (*n, 3) of any length in the camera's frame, and True (*n) where there is one; others
            mean nothing. The rays start at `origins`. A batch of lenses (*b) takes points (*b, ..., 2).

        Raises:
            NotImplementedError: in this base class.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no unproject(xy): points (..., 2) to rays and valid"
        )

    def origins(self, xy: Real[Tensor, "*n 2"]) -> Float[Tensor, "*n 3"]:
        """Return the start of those rays, metres in the camera's frame: zeros for central models."""
        return torch.zeros_like(to_homogeneous(floating(xy)))

    @property
    def harmless(self) -> bool:
        """True if the model is a pinhole after all."""
        return False

    @property
    def sees_behind(self) -> bool:
        """True if the model may have directions at 90 degrees or more off axis."""
        return True

    def undistort(self, xy: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Map points of the image plane to points of a pinhole.

        Returns:
            Pinhole points, and True where there is one: rays ahead.
        """
        ray, valid = self.unproject(xy)
        xy, ahead = on_plane(ray)
        return xy, valid & ahead

    def distort(self, xy: Real[Tensor, "*n 2"]) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
        """Map points of a pinhole to points of the image plane.

        Returns:
            Points, and validity.
        """
        return self.project(to_homogeneous(floating(xy)))

    def scaled(self: AnyLens, factor: float) -> AnyLens:
        """Multiply all lengths by a factor; central models have none and are returned unchanged."""
        return self

    def with_coefficients(self: AnyLens, coefficients: Float[Tensor, "*b n"]) -> AnyLens:
        """Return the same model with other numbers.

        Raises:
            NotImplementedError: in this base class.
        """
        raise NotImplementedError


class CameraModel(LensModel):
    """Base class of camera models: maps from points in a camera's frame to points (x, y) of its image plane,
    which `K` then takes to pixels.

    A model of your own is a dataclass (`frozen=True, eq=False, repr=False`) with `project` and `unproject`,
    inverse to each other, and tensors for its numbers, with `item_axes = {"k": 1}` for a vector k: without,
    its first axis is a batch. Rig files hold it if it is defined as `class Mine(CameraModel, name="mine")`.
    It is used as `Camera.distortion`, and checked there (`check_model`). Resizing, cropping and rotating an
    image change `K` alone. Rays that do not start in the camera's origin also need `origins`, `central =
    False`, and `lengths`, the names of its numbers in metres or metres for each second.

    Raises:
        ValueError: when a subclass is defined with the name of another one or of a `Distortion`.
    """

    registered: ClassVar[str] = ""
    asked: ClassVar[bool] = False
    """True once `check_model` has called the class's methods."""
    lengths: ClassVar[tuple[str, ...] | None] = None

    def __init_subclass__(cls, *, name: str = "", **rest: Any) -> None:
        super().__init_subclass__(**rest)
        cls.registered = name
        if name in TAKEN:
            raise ValueError(f"a lens model named '{name}' exists: give {cls.__qualname__} another name")
        existing = CAMERA_MODELS.get(name)
        if name and existing is not None and existing.__qualname__ != cls.__qualname__:
            raise ValueError(
                f"a camera model named '{name}' exists: {existing.__module__}.{existing.__qualname__}"
            )
        if name:
            CAMERA_MODELS[name] = cls

    @property
    def model(self) -> str:  # type: ignore[override]
        """Name of the model in rig files; the class's name without one."""
        return type(self).registered or type(self).__name__

    @property
    def coefficients(self) -> Float[Tensor, "*b n"]:  # type: ignore[override]
        """Numbers of the model, one after the other."""
        numbers = [t.flatten(t.ndim - axes) if axes else t[..., None] for t, axes in self._own().values()]
        batch = broadcast_shapes(*(t.shape[:-1] for t in numbers))
        return torch.cat([t.expand(*batch, -1) for t in numbers], -1) if numbers else torch.zeros(0).double()

    def scaled(self: AnyLens, factor: float) -> AnyLens:
        """Multiply the numbers of the model that are named in `lengths` by a factor, as for another unit.

        Returns:
            A copy of the model; one without `lengths` has the same numbers.

        Raises:
            ValueError: for a model that is not central and states no `lengths`.
        """
        names = self.lengths  # type: ignore[attr-defined]
        if names is None and not self.central:
            raise ValueError(f"{self.model} does not say which of its numbers are lengths: state `lengths`")
        return dataclasses.replace(self, **{n: getattr(self, n) * factor for n in names or ()})  # type: ignore

    def with_coefficients(self: AnyLens, coefficients: Float[Tensor, "*b n"]) -> AnyLens:
        """Return the same model with other numbers; a lens within it (`BehindModel.lens`) keeps its own.

        Args:
            coefficients: numbers (*b, n), in the order of the property `coefficients`.

        Raises:
            RuntimeError: for another count of numbers.
            ValueError: for numbers that the model refuses.
        """
        tensors = self._own()  # type: ignore[attr-defined]
        sizes = [t.shape[t.ndim - axes :].numel() for t, axes in tensors.values()]
        parts = zip(tensors.items(), coefficients.split(sizes, -1))
        batch = coefficients.shape[:-1]
        new = {
            name: values.reshape((*batch, *t.shape[t.ndim - axes :])) for (name, (t, axes)), values in parts
        }
        return dataclasses.replace(self, **new)  # type: ignore[type-var]

    def _text(self) -> str:
        return self.model

    def _own(self) -> dict[str, tuple[Tensor, int]]:
        """Tensors of the model with the number of their item axes, by field."""
        held = ((f.name, getattr(self, f.name)) for f in dataclasses.fields(self))  # type: ignore[arg-type]
        return {name: (t, self.item_axes.get(name, 0)) for name, t in held if isinstance(t, Tensor)}


def check_model(model: LensModel | None) -> None:
    """Check that a camera model's numbers are finite, and that its methods return tensors like `LensModel`'s.

    Methods (`origins` too if it is not central) are called once for each class, in float32 and float64. A
    `Distortion` or None is not checked.

    Raises:
        ValueError: for NaN or infinity.
        TypeError: for integers, numpy arrays, and methods that raise, return other tensors or change their
            argument.
        NotImplementedError: for a missing method.
    """
    if not isinstance(model, CameraModel):
        return
    kind = type(model)
    for f in dataclasses.fields(model):  # type: ignore[arg-type]
        value = getattr(model, f.name)
        if isinstance(value, Tensor):
            check_numbers(value, (), f"{f.name} of {kind.__name__}")
        elif type(value).__module__ == "numpy":
            raise TypeError(
                f"{f.name} of {kind.__name__} is of numpy: give a tensor, as torch.as_tensor makes"
            )
    if "asked" in vars(kind) or any(t.is_meta for t, _ in tensors_of(model)):
        return
    one = model[(0,) * len(model.batch_shape)] if model.batch_shape else model
    device = next((t.device for t, _ in tensors_of(one)), None)
    for dtype in (torch.float32, torch.float64):
        xy = torch.tensor([[0, 0], [0.1, 0.05], [-0.1, 0.2]], dtype=dtype, device=device).expand(2, 3, 2)
        value, valid = xy.new_zeros(2, 3, 3), xy.new_zeros(2, 3).bool()
        _check_method(one, "project", 2 * to_homogeneous(xy), (value[..., :2], valid))
        _check_method(one, "unproject", xy, (value, valid))
        if not one.central:
            _check_method(one, "origins", xy, (value,))
    kind.asked = True


def _check_method(model: CameraModel, method: str, points: Tensor, like: tuple[Tensor, ...]) -> None:
    """Raise TypeError unless a method returns tensors of these kinds and leaves the points unchanged."""
    name, given = f"{type(model).__name__}.{method}", points.clone()
    try:
        with torch.no_grad():
            answer = getattr(model, method)(given)
    except NotImplementedError:
        raise
    except Exception as error:
        raise TypeError(
            f"{name} raised {type(error).__name__} for points {_kind(points)}: {error}; points have any "
            "number of axes before their last, and numbers of the model those that `item_axes` states"
        ) from error
    kinds = [_kind(v) for v in (answer if isinstance(answer, tuple) else (answer,))]
    wanted = [*map(_kind, like)]
    if kinds != wanted:
        raise TypeError(
            f"{name} gives {' and '.join(kinds)} for points {_kind(points)}; "
            f"wanted {' and, of which are valid, '.join(wanted)}"
        )
    if not torch.equal(given, points):
        raise TypeError(f"{name} changes the points that it is given: make new ones, `a / b` for `a /= b`")


def _kind(value: Any) -> str:
    """Describe a value: a tensor's dtype and shape, or its type."""
    return f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"


def beside_points(number: Tensor, points: Tensor, axes: int = 0) -> Tensor:
    """Reshape a model's number (*b, and `axes` of its own) for points (*b, ..., k), by axes of length 1.

    A number without axes of its own becomes (*b, 1, ...), with one axis fewer than the points, as X[..., 2].
    """
    batch = number.ndim - axes
    trailing = number.shape[batch:]
    return number.to(points).reshape((*number.shape[:batch], *[1] * (points.ndim - 1 - batch), *trailing))
