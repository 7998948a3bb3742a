"""C3 attention as one operator: checks its inputs, brings the sampling locations into one form, picks a backend.

A sample counts if it is valid and lies on beta's area, [-0.5, W - 0.5] x [-0.5, H - 0.5] (to 1e-3 pixels).
On that area the bilinear look-up takes coordinates clamped to the border's centres, and the nearest one
takes the pixel on whose area the position lies. An alpha pixel without a sample that counts gets 0
everywhere, and passes no gradient.

Gradients reach query, key, value, bias and the geometry. With `nearest` the value and the peak have no
gradient by the geometry (they are constant almost everywhere); position and spread do, as weighted means of the
positions.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils.checkpoint import checkpoint

from arraygeom.segments import Positions, Segments
from arraygeom.tracing import transformations
from pat.attention import reference, torch_op
from pat.attention.reference import Attended, AttentionInputs, SamplePositions

Locations = Segments | Positions
Interpolation = Literal["bilinear", "nearest"]
Backend = Literal["auto", "reference", "cpu", "triton"]

DTYPES = (torch.float64, torch.float32, torch.bfloat16, torch.float16)
CHUNK_SAMPLES = 2**22
"""How many explicit positions a callable is asked for at a time: 32 MiB of float32 (x, y)."""
CHUNK_PIXELS = 2**18
"""How many segments a callable is asked for at a time."""


def attend(
    query: Float[Tensor, "b d ha wa"],
    key: Float[Tensor, "b d hb wb"],
    value: Float[Tensor, "b dv hb wb"],
    locations: Locations | Callable[[Tensor], Locations],
    *,
    samples: int | None = None,
    interpolation: Interpolation = "bilinear",
    bias: Tensor | None = None,
    backend: Backend = "auto",
) -> Float[Tensor, "b dv ha wa"]:
    """For each alpha pixel, the values at its samples in beta, weighted by softmax(query . key).

    The scores are plain inner products (the paper's). The output is channels-last in memory.

    Args:
        query: features of alpha; float64, float32, bfloat16 or float16, as are key and value. 16-bit numbers
            are accumulated in float32. Under autocast all three are cast to its type (the geometry never is).
        key: features of beta that the query is compared with.
        value: features of beta that are returned.
        locations: the search segments or sampling locations in beta of each alpha pixel: Segments or Positions
            with the leading axes (Ha, Wa) or (B, Ha, Wa), or a function from (n, 2) alpha pixels (x, y) to
            either, with the leading axes (n) or (B, n), which is called on one piece of alpha at a time and
            again in backward, so that not all explicit positions exist at once.
        samples: how many samples a segment has. None: one for each beta pixel of the longest valid one.
        interpolation: `bilinear` (differentiable in the geometry) or `nearest` (the paper's).
        bias: added to the scores; anything that broadcasts to (B, Ha, Wa, L).
        backend: `reference` (plain torch, differentiable any number of times and in forward mode), `cpu`,
            `triton`, or `auto`: the compiled one of the tensors' device, with forward-mode derivatives and
            gradients of gradients by the reference, or the reference if there is none. An explicit compiled
            backend that cannot serve raises.

    Raises:
        ValueError: shapes, devices or options that do not fit together.
        TypeError: not Segments or Positions; a mask that is not bool; dtypes that differ or are not supported.
        RuntimeError: an explicit backend that cannot serve.
        NotImplementedError: derivatives that an explicit backend does not have.
    """
    return _attend(query, key, value, locations, samples, interpolation, bias, backend, measured=False).value


def attend_with_statistics(
    query: Float[Tensor, "b d ha wa"],
    key: Float[Tensor, "b d hb wb"],
    value: Float[Tensor, "b dv hb wb"],
    locations: Locations | Callable[[Tensor], Locations],
    *,
    samples: int | None = None,
    interpolation: Interpolation = "bilinear",
    bias: Tensor | None = None,
    backend: Backend = "auto",
) -> Attended:
    """As `attend`, with the expected position of the match, the spread of the weights and the largest of them.

    The statistics are float32 (float64 for float64 inputs) and differentiable, too.
    """
    return _attend(query, key, value, locations, samples, interpolation, bias, backend, measured=True)


def _attend(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    locations: Locations | Callable[[Tensor], Locations],
    samples: int | None,
    interpolation: Interpolation,
    bias: Tensor | None,
    backend: Backend,
    *,
    measured: bool,
) -> Attended:
    """The statistics are of no length if not `measured`, but for the reference's."""
    query, key, value = _autocast(query, key, value)
    _check(query, key, value, interpolation, backend)
    nearest = interpolation == "nearest"

    def run(q: Tensor, k: Tensor, v: Tensor, given: Locations, part: Tensor | None) -> Attended:
        form = sample_positions(given, q, samples)
        return _run(AttentionInputs(q, k, v, form, _bias(part, q, form.samples), nearest), backend, measured)

    if not callable(locations):
        return run(query, key, value, locations, bias)
    return _attend_chunks(query, key, value, locations, bias, run, measured)


def _autocast(*tensors: Tensor) -> list[Tensor]:
    kind = tensors[0].device.type
    if not torch.is_autocast_enabled(kind):
        return list(tensors)
    return [t.to(torch.get_autocast_dtype(kind)) for t in tensors]


def _check(query: Tensor, key: Tensor, value: Tensor, interpolation: str, backend: str) -> None:
    shapes = f"query {tuple(query.shape)}, key {tuple(key.shape)}, value {tuple(value.shape)}"
    if any(t.dim() != 4 for t in (query, key, value)):
        raise ValueError(f"query, key and value must be (B, D, H, W), got {shapes}")
    if query.shape[:2] != key.shape[:2]:
        raise ValueError(f"query and key must agree in batch and channels, got {shapes}")
    if key.shape[0] != value.shape[0] or key.shape[2:] != value.shape[2:]:
        raise ValueError(f"key and value must agree in batch, height and width, got {shapes}")
    if min(query.shape + key.shape + value.shape) < 1:
        raise ValueError(f"query, key and value must not be empty, got {shapes}")
    if not (query.dtype == key.dtype == value.dtype and query.dtype in DTYPES):
        names = ", ".join(str(t.dtype) for t in (query, key, value))
        raise TypeError(f"query, key and value must be all float64, float32, bfloat16 or float16, got {names}")
    if not query.device == key.device == value.device:
        raise ValueError(f"query, key and value are on {query.device}, {key.device} and {value.device}: move them")
    if interpolation not in ("bilinear", "nearest"):
        raise ValueError(f"interpolation must be 'bilinear' or 'nearest', got {interpolation!r}")
    if backend not in ("auto", "reference", "cpu", "triton"):
        raise ValueError(f"backend must be 'auto', 'reference', 'cpu' or 'triton', got {backend!r}")


def sample_positions(locations: Locations, query: Tensor, samples: int | None) -> SamplePositions:
    """Segments or Positions in the one form that the backends take, in the precision that they count in."""
    if isinstance(locations, Segments):
        points, mask, straight = torch.stack([locations.start, locations.end], -2), locations.valid[..., None], True
    elif isinstance(locations, Positions):
        points, mask, straight = locations.xy, locations.mask, False
        if samples not in (None, points.shape[-2]):
            raise ValueError(f"samples is {samples}, but the positions given are {points.shape[-2]} a pixel: omit it")
        samples = points.shape[-2]
    else:
        raise TypeError(f"locations must be Segments, Positions or a function that returns them, got {type(locations)}")
    if mask.dtype != torch.bool:
        raise TypeError(f"the locations' mask (valid) must be bool, got {mask.dtype}: compare it, as in mask > 0")
    if samples is None:
        samples = samples_for(Segments(points[..., 0, :], points[..., 1, :], mask[..., 0]))
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
    b, _, ha, wa = query.shape
    if tuple(mask.shape[:-1]) not in ((ha, wa), (b, ha, wa), (1, ha, wa)):
        raise ValueError(f"locations have the leading axes {tuple(mask.shape[:-1])}, want {(ha, wa)} or {(b, ha, wa)}")
    if points.device != query.device:
        raise ValueError(f"locations are on {points.device}, the features are on {query.device}: move one of them")
    if mask.dim() == 3:
        points, mask = points[None], mask[None]
    count_in = torch.float64 if query.dtype == torch.float64 else torch.float32
    return SamplePositions(points.to(count_in), mask, samples, straight)


def samples_for(segments: Segments) -> int:
    """Enough samples for one on each beta pixel of the longest valid segment."""
    lengths = torch.where(segments.valid, segments.length.detach(), 0)
    return int(lengths.max().ceil()) + 1


def _bias(bias: Tensor | None, query: Tensor, samples: int) -> Tensor | None:
    if bias is None:
        return None
    b, _, ha, wa = query.shape
    try:
        return bias.expand(b, ha, wa, samples)
    except RuntimeError:
        raise ValueError(f"bias {tuple(bias.shape)} does not broadcast to {(b, ha, wa, samples)}") from None


def _run(inputs: AttentionInputs, backend: Backend, measured: bool) -> Attended:
    chosen = chosen_backend(backend, inputs.query.device.type)
    missing = "" if chosen == "reference" else _missing(inputs)
    if missing and backend != "auto":
        raise NotImplementedError(f"backend '{backend}' has no {missing}: ask for backend=\"reference\"")
    if missing or chosen == "reference":
        return reference.attend(inputs)
    return torch_op.attend(inputs, measured=measured, backend=chosen, strict=backend != "auto")


def _missing(inputs: AttentionInputs) -> str:
    """What is under way that compiled backends have not; empty if nothing."""
    if torch.compiler.is_compiling():
        return ""
    under_way = transformations()
    tensors = (inputs.query, inputs.key, inputs.value, inputs.positions.points, inputs.bias)
    if "Jvp" in under_way or any(t is not None and forward_ad.unpack_dual(t).tangent is not None for t in tensors):
        return "forward mode"
    return "gradients by torch.func (by torch.autograd it has)" if "Grad" in under_way else ""


def chosen_backend(backend: Backend, device: str) -> str:
    """The backend that serves; raises if the one asked for cannot."""
    triton = importlib.util.find_spec("triton") is not None
    if backend == "auto":
        return "cpu" if device == "cpu" else "triton" if device == "cuda" and triton else "reference"
    if backend == "cpu" and device != "cpu":
        raise RuntimeError(f"backend 'cpu' cannot serve tensors on {device}: move them, or ask for 'auto'")
    if backend == "triton" and not triton:
        raise RuntimeError("backend 'triton' needs the package triton, which is not installed")
    if backend == "triton" and device != "cuda" and os.environ.get("TRITON_INTERPRET") != "1":
        raise RuntimeError(f"backend 'triton' cannot serve tensors on {device}: move them to a GPU")
    return backend


def _attend_chunks(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    locations: Callable[[Tensor], Locations],
    bias: Tensor | None,
    run: Callable[..., Attended],
    measured: bool,
) -> Attended:
    """Asks `locations` for a piece of alpha at a time.

    Segments are small: they are gathered for the whole image. Explicit positions are used at once, and
    asked for again in backward.
    """
    ha, wa = query.shape[2:]
    first = locations(_pixel_rows(0, 1, wa, query))
    if isinstance(first, Segments):
        return run(query, key, value, _all_segments(locations, query), bias)
    if not isinstance(first, Positions):
        raise TypeError(f"locations must return Segments or Positions, got {type(first)}")

    def chunk(q: Tensor, k: Tensor, v: Tensor, part: Tensor | None, top: int) -> Attended:
        given = locations(_pixel_rows(top, top + q.shape[2], wa, q))
        if not isinstance(given, Positions):
            raise TypeError(f"locations returned Positions for some pixels and {type(given)} for others")
        given = Positions(given.xy.unflatten(-3, (-1, wa)), given.mask.unflatten(-2, (-1, wa)))
        return run(q, k, v, given, part)

    step = max(1, CHUNK_SAMPLES // (first.xy.numel() // 2))
    again = partial(checkpoint, chunk, use_reentrant=False) if torch.is_grad_enabled() else chunk
    chunks = [
        again(query[:, :, top : top + step], key, value, _bias_rows(bias, top, step), top) for top in range(0, ha, step)
    ]
    values, positions, spreads, peaks = zip(*chunks)
    if not measured:
        return chunks[0]._replace(value=torch.cat(values, 2))
    return Attended(torch.cat(values, 2), torch.cat(positions, 2), torch.cat(spreads, 1), torch.cat(peaks, 1))


def _pixel_rows(top: int, bottom: int, width: int, like: Tensor) -> Float[Tensor, "n 2"]:
    """The centres (x, y) of rows of alpha."""
    count_in = torch.float64 if like.dtype == torch.float64 else torch.float32
    y, x = torch.meshgrid(
        torch.arange(top, bottom, dtype=count_in, device=like.device),
        torch.arange(width, dtype=count_in, device=like.device),
        indexing="ij",
    )
    return torch.stack([x.flatten(), y.flatten()], -1)


def _all_segments(locations: Callable[[Tensor], Locations], query: Tensor) -> Segments:
    ha, wa = query.shape[2:]
    step = max(1, CHUNK_PIXELS // wa)
    parts = [locations(_pixel_rows(top, min(top + step, ha), wa, query)) for top in range(0, ha, step)]
    axes = {"start": -2, "end": -2, "valid": -1}
    whole = {name: torch.cat([getattr(p, name) for p in parts], axis) for name, axis in axes.items()}
    return Segments(**{name: t.unflatten(axes[name], (ha, wa)) for name, t in whole.items()})


def _bias_rows(bias: Tensor | None, top: int, step: int) -> Tensor | None:
    """The rows of a bias that broadcasts to (B, Ha, Wa, L)."""
    if bias is None or bias.dim() < 3 or bias.shape[-3] == 1:
        return bias
    return bias.narrow(-3, top, min(step, bias.shape[-3] - top))
