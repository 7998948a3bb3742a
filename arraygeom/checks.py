"""Checks of constructors: numbers that no camera, pose, lens or field can have are refused in one sentence
each.

Values are not available while torch compiles, traces or transforms: nothing is checked then, nor within
`unchecked`.
"""

from __future__ import annotations

import math
import operator
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor

from .pixels import broadcast_shapes
from .runtime.tracing import followed

T = TypeVar("T")

LARGEST_SIDE, MOST_PIXELS = 65_535, 2**30
"""Sizes above these are more likely damaged numbers than images (the largest sensors have 4e8 pixels)."""
ROUNDED = 1e-3
"""Rounding that is tolerated in R R^T - I, in the last row of K, and relative to the near bound."""
SINGULAR = 1e-9
"""Determinant of K's upper block, pixels squared, below which it maps the plane to a line."""

_state = threading.local()


@contextmanager
def unchecked() -> Iterator[None]:
    """Context manager in which constructors do not check, for loops in which each microsecond counts."""
    before, _state.off = getattr(_state, "off", False), True
    try:
        yield
    finally:
        _state.off = before


def derived(make: Callable[..., T], *args: Any, **kwargs: Any) -> T:
    """Call `make` with the checks of cameras, poses and lenses left out, for results made of checked numbers.

    Args:
        make: function or class to call.
        args: its arguments.
        kwargs: its named arguments.

    Returns:
        The result of the call.
    """
    if followed():
        return make(*args, **kwargs)
    with unchecked():
        return make(*args, **kwargs)


def checking() -> bool:
    """Return True if constructors check their numbers here and now."""
    return not followed() and not getattr(_state, "off", False)


def check_numbers(value: Any, shape: tuple[int, ...], what: str) -> Tensor:
    """Check that a value is a tensor of finite floating-point numbers (\\*b, \\*shape).

    Args:
        what: name of the value in messages.

    Returns:
        The tensor, detached.

    Raises:
        TypeError: for another type, or integers.
        ValueError: for another shape, NaN or infinity.
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{what} is a {type(value).__name__}: give a tensor of {_shape(shape)} numbers")
    if not value.is_floating_point():
        raise TypeError(f"{what} holds {value.dtype}: give floating-point numbers, as by `.double()`")
    if tuple(value.shape[value.ndim - len(shape) :]) != shape or value.ndim < len(shape):
        raise ValueError(f"{what} has shape {tuple(value.shape)}; wanted (..., {_shape(shape)})")
    value = value.detach()
    if not value.is_meta and not bool(value.isfinite().all()):
        raise ValueError(f"{what} holds NaN or infinity: did the calibration fail?")
    return value


def check_origin(near: Tensor, *translations: Tensor, unit: str) -> None:
    """Check that float32 translations (\\*b, 3) are not visibly rounded for a scene at `near` (\\*b).

    `unit` names their unit of length in the message.

    Raises:
        ValueError: if they are.
    """
    for t in translations:
        if t.dtype != torch.float32 or t.is_meta or near.is_meta or not t.numel():
            continue
        largest = t.detach().abs().amax(-1)
        rounding = largest * torch.finfo(t.dtype).eps
        if bool((rounding > ROUNDED * near.detach()).any()):
            raise ValueError(
                f"a camera is {float(largest.max()):,.0f} {unit} from the origin, which float32 holds to "
                f"{float(rounding.max()):.1g} {unit}: give float64, or put the origin near the cameras"
            )


def check_rotation(R: Any) -> None:
    """Check that R (\\*b, 3, 3) is a rotation, except for rounding.

    Raises:
        ValueError: if it is a reflection, singular, or not orthonormal, or as `check_numbers`.
        TypeError: if it is no tensor of floating-point numbers.
    """
    R = check_numbers(R, (3, 3), "R")
    if R.is_meta or not R.numel():
        return
    wide = R.double() if R.dtype != torch.float64 else R
    if not bool((torch.linalg.det(wide) > 0).all()):
        raise ValueError(
            "R is a reflection or singular (determinant not 1), not a rotation: was an axis flipped?"
        )
    error = float((wide @ wide.mT - torch.eye(3, dtype=wide.dtype, device=wide.device)).abs().max())
    if error > max(ROUNDED, 4 * torch.finfo(R.dtype).eps):
        raise ValueError(f"R is not a rotation (R R^T is off by {error:.2g}): was it scaled, or a row lost?")


def check_K(K: Any) -> None:
    """Check that K (\\*b, 3, 3) maps the plane z = 1 to pixels: last row (0, 0, 1), not singular.

    Raises:
        ValueError: if it does not, or as `check_numbers`.
        TypeError: if it is no tensor of floating-point numbers.
    """
    K = check_numbers(K, (3, 3), "K")
    if K.is_meta or not K.numel():
        return
    if float((K[..., 2, :] - K.new_tensor([0, 0, 1])).abs().max()) > ROUNDED:
        last = [float(f"{v:.4g}") for v in K[..., 2, :].reshape(-1, 3)[0].tolist()]
        raise ValueError(f"K has last row {last}, wanted [0, 0, 1]: is it transposed, or scaled?")
    area = K[..., 0, 0] * K[..., 1, 1] - K[..., 0, 1] * K[..., 1, 0]
    if not bool((area.abs() > SINGULAR).all()):
        raise ValueError("K has a focal length of 0: wanted [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], in pixels")


def check_hw(hw: Any) -> None:
    """Check that `hw` is the (height, width) of an image, in whole pixels.

    Raises:
        ValueError: if it is not.
    """
    try:
        h, w = map(operator.index, () if isinstance(hw, Tensor) else hw)  # a tensor would be one of a batch
    except (TypeError, ValueError):
        raise ValueError(f"hw is {hw!r}; wanted (height, width) in whole pixels") from None
    if min(h, w) < 1:
        raise ValueError(f"hw is {(h, w)}; wanted (height, width), each 1 or more")
    if max(h, w) > LARGEST_SIDE or h * w > MOST_PIXELS:
        raise ValueError(
            f"hw is {(h, w)}; images of up to {LARGEST_SIDE} pixels a side and {MOST_PIXELS / 1e6:.0f} "
            "million in all are supported: is it in pixels?"
        )


def check_batches(what: str, *shapes: tuple[int, ...]) -> None:
    """Check that batch axes broadcast; `what` names them in messages.

    Raises:
        ValueError: if they do not.
    """
    try:
        broadcast_shapes(*shapes)
    except (RuntimeError, ValueError):
        listed = " and ".join(map(str, map(tuple, shapes)))
        raise ValueError(f"the batch axes of {what} are {listed}: give all the same, or none") from None


def check_above(least: float, *, whole: bool = False, itself: bool = True, **values: Any) -> None:
    """Check that each of the named values is a finite number from `least` up.

    None and tensors are not checked.

    Args:
        whole: True for integers only.
        itself: False to exclude `least`.

    Raises:
        ValueError: for another number, infinity or NaN.
        TypeError: for a value that is no number; text such as "3" passes unless `whole`.
    """
    bound = f"of {least:g} or more" if itself else f"above {least:g}"
    wanted = f"wanted a {'whole' if whole else 'finite'} number {bound}"
    for name, value in values.items():
        if value is None or isinstance(value, Tensor):
            continue
        try:
            number = operator.index(value) if whole else float(value)
        except (TypeError, ValueError):
            raise TypeError(f"{name} is a {type(value).__name__}: {wanted}") from None
        if not (number > least or (itself and number == least)) or number == math.inf:
            raise ValueError(f"{name} is {value}: {wanted}")


def check_bounds(near: Any, far: Any) -> None:
    """Check depth bounds: 0 < near <= far, metres. None and tensors are not checked.

    Raises:
        ValueError: for other numbers.
        TypeError: for values that are no numbers.
    """
    for name, value in (("near", near), ("far", far)):
        if value is None or isinstance(value, Tensor):
            continue
        if not isinstance(value, int | float):
            hint = ": a field is made first and called then, as Epipolar()(pair, x)" if name == "near" else ""
            raise TypeError(f"{name} is a {type(value).__name__}, wanted metres{hint}")
        if not value > 0:
            raise ValueError(f"{name} is {value:g}: wanted metres above 0")
    if isinstance(near, int | float) and isinstance(far, int | float) and near > far:
        raise ValueError(f"near is {near:g} m and far {far:g} m: exchange them")


def check_pixels(x: Any) -> None:
    """Check that x are pixels (\\*n, 2).

    Raises:
        ValueError: for another shape.
        TypeError: for a value that is no tensor.
    """
    if not isinstance(x, Tensor):
        raise TypeError(f"the pixels are a {type(x).__name__}: give a tensor of (x, y)")
    if x.ndim < 1 or x.shape[-1] != 2:
        raise ValueError(f"the pixels have shape {tuple(x.shape)}; wanted (..., 2), each (x, y)")


def check_tensors(last: tuple[int, ...], **values: Any) -> None:
    """Check that each of the named values is a tensor whose last axes have these sizes.

    Raises:
        ValueError: for other sizes.
        TypeError: for a value that is no tensor.
    """
    for name, value in values.items():
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} is a {type(value).__name__}: give a tensor (..., {_shape(last)})")
        if value.ndim < len(last) or tuple(value.shape[value.ndim - len(last) :]) != last:
            raise ValueError(f"{name} has shape {tuple(value.shape)}; wanted (..., {_shape(last)})")


def check_field(field: Any) -> None:
    """Check that a receptive field can be called and is not a class.

    Raises:
        TypeError: otherwise.
    """
    if isinstance(field, type):
        raise TypeError(f"{field.__name__} is a class: make a field of it, {field.__name__}()")
    if not callable(field):
        raise TypeError(
            f"a field is a function of a pair and alpha's pixels, this is a {type(field).__name__}: "
            "give a field such as Epipolar()"
        )


def _shape(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))
