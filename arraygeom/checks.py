"""Checks of constructors: numbers that no camera, pose, lens or field can have are refused in one sentence
each.

Values are not available while torch compiles, traces or transforms: nothing is checked then, nor within
`unchecked`.
"""

from __future__ import annotations

import inspect
import math
import operator
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial, wraps
from numbers import Integral, Real
from types import FunctionType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import torch
from jaxtyping import AbstractArray
from torch import Tensor

from .pixels import HW, broadcast_shapes
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
    """Call `make` with the checks of constructors and of `checked` left out, for results of checked numbers.

    Args:
        make: function or class to call; its own errors pass.
        args, kwargs: its arguments.

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
        The tensor, detached. A tensor of the meta device has no numbers to check.

    Raises:
        TypeError: for another type, or a tensor of integers, bools or complex numbers.
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

    `unit` names their unit of length in the message. Other types are not checked.

    Raises:
        ValueError: if rounding is more than `ROUNDED` of near.
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
    """Check that R (\\*b, 3, 3) is a rotation, except for rounding (`ROUNDED`).

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
    """Check that `hw` is (height, width) of an image: whole pixels, at least 1, at most `LARGEST_SIDE` each.

    Raises:
        ValueError: if it is not, or for more than `MOST_PIXELS` in all.
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
        TypeError: for a value that is no number; for `whole` also one that is no integer, such as 2.0.
    """
    bound = f"of {least:g} or more" if itself else f"above {least:g}"
    wanted = f"wanted a {'whole' if whole else 'finite'} number {bound}"
    for name, value in values.items():
        if value is None or isinstance(value, Tensor):
            continue
        try:
            number = operator.index(value) if whole or isinstance(value, str) else float(value)
        except (TypeError, ValueError):
            raise TypeError(f"{name} is a {type(value).__name__}: {wanted}") from None
        if not (number > least or (itself and number == least)) or number == math.inf:
            raise ValueError(f"{name} is {value}: {wanted}")


def check_bounds(near: Any, far: Any) -> None:
    """Check depth bounds: 0 < near <= far, metres, both perhaps infinite; None and tensors are passed over.

    Raises:
        ValueError: for other numbers, NaN included.
        TypeError: for values of other types than int and float, such as NumPy's float32.
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


def check_plane(what: str, plane: Tensor, hw: HW) -> None:
    """Check that images or maps (\\*b, h, w) have their camera's size; `what` names them in the message.

    Raises:
        ValueError: if they have not.
    """
    if tuple(plane.shape[-2:]) != tuple(hw):
        raise ValueError(f"{what} is {tuple(plane.shape[-2:])}, its camera {tuple(hw)}: resize one")


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


def checked(function: Callable[..., T]) -> Callable[..., T]:
    """Decorate a function or method to check its arguments by their annotations before it runs.

    Tensors are checked for dtype, number of axes, last axes of fixed size, and a common device; an `HW` as
    `check_hw`; numbers, texts, lists, mappings, fields and this package's classes for their type. Defaults
    and other annotations are not checked, none at all where one cannot be resolved (but devices); nothing is
    unless `checking`.

    Returns:
        The function, which raises TypeError for a wrong type or dtype, else ValueError, in one sentence.
    """

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> T:
        if checking():
            _check_arguments(function, args, kwargs)
        return function(*args, **kwargs)

    return call


def _check_arguments(function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
    names, refusals = _refusals(function)
    given = {**dict(zip(names, args)), **kwargs}
    for name, value in given.items():
        if name in refusals and (error := refusals[name](name, value)):
            raise error
    _check_devices(given)


def check_methods(cls: type) -> None:
    """Check the arguments of a class's public methods, as `checked`."""
    for name, member in list(vars(cls).items()):
        if isinstance(member, FunctionType) and not name.startswith("_"):
            setattr(cls, name, checked(member))
        elif isinstance(member, classmethod) and not name.startswith("_"):
            setattr(cls, name, classmethod(checked(member.__func__)))


def _check_devices(given: Mapping[str, Any]) -> None:
    """Raise ValueError for tensors, a single number excepted, on several devices."""
    devices = {name: t.device for name, t in given.items() if isinstance(t, Tensor) and t.ndim}
    if len(set(devices.values())) > 1:
        listed = ", ".join(f"{name} on {device}" for name, device in devices.items())
        raise ValueError(f"{listed}: give all on one device")


@cache
def _refusals(
    function: Callable[..., Any],
) -> tuple[list[str], dict[str, Callable[[str, Any], Exception | None]]]:
    """Names of a function's positional arguments, and functions that say what is wrong with an argument."""
    function = inspect.unwrap(function)
    parameters = inspect.signature(function).parameters
    names = [name for name, p in parameters.items() if p.kind == p.POSITIONAL_OR_KEYWORD]
    try:
        hints = get_type_hints(function)
    except NameError:  # of another package, imported for type checkers alone
        return names, {}
    made: dict[str, Callable[[str, Any], Exception | None]] = {}
    for name, hint in hints.items():
        hint = getattr(hint, "__bound__", None) or hint
        kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        if name != "return" and all(map(_is_checked, kinds)):
            made[name] = partial(_refusal, kinds)
    return names, made


def _is_checked(kind: Any) -> bool:
    if kind in (HW, int, float, str, type(None)) or get_origin(kind) in (Sequence, Mapping):
        return True
    own = isinstance(kind, type) and kind.__module__.startswith("arraygeom.")
    return own or (isinstance(kind, type) and issubclass(kind, AbstractArray))


def _refusal(kinds: Sequence[Any], name: str, value: Any) -> Exception | None:
    """Return the error for a value that should be of one of these kinds; None for a value that is."""
    if value is None and type(None) in kinds:
        return None
    errors = [_fault(kind, name, value) for kind in kinds if kind is not type(None)]
    return None if None in errors else errors[0]


def _fault(kind: Any, name: str, value: Any) -> Exception | None:
    held = f"{name} is a {type(value).__name__}"
    if kind == HW:
        return _raised(check_hw, value)
    if kind in (int, float):
        number = isinstance(value, Integral if kind is int else Real)
        scalar = isinstance(value, Tensor) and value.ndim == 0
        return None if number or scalar else TypeError(f"{held}: give a number")
    if kind is str:
        return None if isinstance(value, str) else TypeError(f"{held}: give a name")
    if get_origin(kind) is Mapping:
        return None if isinstance(value, Mapping) else TypeError(f"{held}: give a mapping by name")
    if get_origin(kind) is Sequence:
        (item,) = get_args(kind)
        several = isinstance(value, Sequence) and not isinstance(value, str)
        if not several and not isinstance(value, Tensor):
            return TypeError(f"{held}: give a list")
        found = (_fault(item, f"an item of {name}", one) for one in value if _is_checked(item))
        return next(filter(None, found), None)
    if not issubclass(kind, AbstractArray):
        if getattr(kind, "_is_protocol", False):
            return _raised(check_field, value)
        return None if isinstance(value, kind) else TypeError(f"{held}: give a {kind.__name__}")
    axes = kind.dim_str.split()
    if not isinstance(value, Tensor):
        return TypeError(f"{held}: give a tensor of shape ({', '.join(axes)})")
    fixed = [axis for axis in axes if axis[0] not in "*."]
    fits = value.ndim == len(axes) if len(fixed) == len(axes) else value.ndim >= len(fixed)
    last = [(int(axis), n) for axis, n in zip(reversed(axes), reversed(value.shape)) if axis.isdigit()]
    if not fits or any(wanted != n for wanted, n in last):
        return ValueError(f"{name} has shape {tuple(value.shape)}; wanted ({', '.join(axes)})")
    if str(value.dtype).removeprefix("torch.") not in kind.dtypes:
        return TypeError(
            f"{name} holds {value.dtype}: wanted {kind.__name__.partition('[')[0].lower()} numbers"
        )
    return None


def _raised(check: Callable[[Any], None], value: Any) -> Exception | None:
    """The error that a check raises; None for none."""
    try:
        check(value)
    except (TypeError, ValueError) as error:
        return error
    return None


def _shape(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))
