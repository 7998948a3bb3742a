"""The protocol that every receptive field follows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Real
from torch import Tensor

from ..batching import tensors_of
from ..camera import Camera
from ..checks import check_field
from ..pair import Pair
from ..pixels import floating, pixel_grid
from ..runtime.chunks import chunked
from ..runtime.compiled import can_compile
from ..runtime.tracing import followed
from ..segments import Positions, Segments

SamplingLocations = Segments | Positions


@runtime_checkable
class ReceptiveField(Protocol):
    """Protocol of receptive fields: callables that give the search segment or sampling locations in beta of
    each alpha pixel.

    A plain function serves too. Each pixel's answer may depend on that pixel and the pair alone.
    """

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> SamplingLocations:
        """Compute sampling locations in beta of alpha's pixels x.

        Returns:
            Segments (*n) or positions (*n, L) in beta's pixels, differentiable in the pair's numbers unless
            they are whole pixels or made from sizes.
        """
        ...


def sampling_locations(
    field: ReceptiveField, pair: Pair, x: Real[Tensor, "*n 2"] | None = None
) -> SamplingLocations:
    """Evaluate a field at given pixels, or over alpha's whole image.

    Args:
        x: pixels of alpha, for a batch of rigs *b with as many axes (or of length 1) in front; None for all,
            (H, W, 2) in float32.

    Returns:
        Segments (*n) or positions (*n, L) in beta's pixels; (H, W) or (*b, H, W) for all pixels.

    Raises:
        TypeError: for an object that is no field, such as a class of one, or pixels that are no tensor.
        ValueError: for pixels of another shape, an invalid result of the field, or whatever the field raises
            for this pair.
    """
    return answered(field, pair, all_pixels(pair) if x is None else floating(x))


def answered(field: ReceptiveField, pair: Pair, x: Real[Tensor, "*n 2"]) -> SamplingLocations:
    """Call a field, and check its result.

    Returns:
        The field's segments or positions, as it gave them.

    Raises:
        ValueError: if the result is not Segments or Positions for each pixel, with floats and bools on one
            device. An exception of the field itself passes, with its name in a note.
    """
    name = getattr(field, "__name__", type(field).__name__)
    try:
        answer = field(pair, x)
    except Exception as error:
        error.add_note(f"raised by the field {name}")
        raise
    if not isinstance(answer, Segments | Positions):
        raise ValueError(
            f"the field {name} gave a {type(answer).__name__}: fields give Segments or Positions"
        )
    for attribute, value in vars(answer).items():
        if not isinstance(value, Tensor):
            kind, held = type(answer).__name__, type(value).__name__
            raise ValueError(f"the field {name} gave {kind} whose {attribute} is a {held}: give a tensor")
    shape = answer.valid.shape if isinstance(answer, Segments) else answer.mask.shape[:-1]
    batch = len(pair.batch_shape)
    if len(shape) != x.ndim - 1 or shape[batch:] != x.shape[batch:-1]:
        raise ValueError(
            f"the field {name} gave {tuple(shape)} pixels for {tuple(x.shape[:-1])}: a field is asked for x "
            "(*n, 2), and answers with Segments (*n), or Positions (*n, L)"
        )
    _check_parts(answer, name)
    return answer


def _check_parts(answer: SamplingLocations, name: str) -> None:
    """Raise ValueError unless points are floats (..., 2), and bools (...) mask those that count."""
    *points, counts = vars(answer).values()
    fit = all(xy.is_floating_point() and xy.shape == (*counts.shape, 2) for xy in points)
    some = isinstance(answer, Segments) or counts.shape[-1] > 0
    if not (fit and some and counts.dtype == torch.bool and len({t.device for t in (*points, counts)}) == 1):
        parts = ", ".join(f"{part} {t.dtype} {tuple(t.shape)} {t.device}" for part, t in vars(answer).items())
        wanted = "start and end (*n, 2), valid (*n)"
        if isinstance(answer, Positions):
            wanted = "xy (*n, L, 2), mask (*n, L), L at least 1"
        raise ValueError(
            f"the field {name} gave {parts.replace('torch.', '')}: "
            f"wanted {wanted}, floats and bools, on one device"
        )


def lazily(field: ReceptiveField, pair: Pair) -> Callable[[Tensor], SamplingLocations]:
    """Make a function of alpha's pixels alone of a field and a pair; attention calls it chunk by chunk.

    Returns:
        Function from pixels (n, 2) to segments or positions, (n) or for a batch of rigs (*b, n), on the
        device of the pair's numbers. It raises as `answered`, and TypeError for pixels that are no tensor.

    Raises:
        TypeError: for an object that is no field.
    """
    check_field(field)
    axes, device = len(pair.batch_shape), device_of(pair)
    return lambda x: answered(field, pair, floating(x).to(device=device).reshape(*[1] * axes, *x.shape))


def device_of(pair: Pair) -> torch.device | None:
    """Return the device of a pair's numbers; None for one of which only the sizes are known."""
    calibration = pair.alpha if isinstance(pair.alpha, Camera) else pair.link
    return next((t.device for t, _ in tensors_of(calibration)), None)


def all_pixels(pair: Pair) -> Float[Tensor, "*b h w 2"]:
    """Return alpha's pixel centres, float32, with the axes of a batch of rigs (of length 1) in front."""
    grid = pixel_grid(pair.alpha.hw, device=device_of(pair))
    return grid.reshape(*[1] * len(pair.batch_shape), *grid.shape)


def compilable(x: Tensor) -> bool:
    """Return True if compiled loops can take a tensor: plain numbers on the CPU that no trace follows."""
    plain = type(x) is Tensor and x.device.type == "cpu" and x.dtype in (torch.float32, torch.float64)
    if not plain or followed() or torch._C._functorch.is_legacy_batchedtensor(x):  # by `is_grads_batched`
        return False
    return can_compile()


CHUNK = 1 << 15
"""Number of pixels handled at once, so that intermediate results stay in a core's cache."""
PIECE = 1 << 12
"""Number of pixels of alpha that a thread takes at a time."""


def segments_by_rows(f: Callable[[Tensor], Segments], pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments:
    """Apply f, which takes each pixel alone, to some rows of the first axis after the batch's at once."""
    axis = len(pair.batch_shape)
    if x.ndim <= axis + 1:
        return f(x)
    rows = max(1, CHUNK * x.shape[axis] * 2 // max(x.numel(), 1))
    return Segments(*chunked(lambda pixels: vars(f(pixels)).values(), x, rows=rows, axis=axis))
