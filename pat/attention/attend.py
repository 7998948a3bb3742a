"""C3 attention as one operator: checks inputs, converts sampling locations to one form, selects a backend.

A sample counts if it is valid and lies on beta's area, [-0.5, W - 0.5] x [-0.5, H - 0.5] (to 1e-3 pixels). On
that area bilinear look-up clamps coordinates to the border's centres, and nearest look-up takes the pixel
whose area contains the position. An alpha pixel without a sample that counts gets 0 everywhere, and passes no
gradient.

Gradients reach query, key, value, bias and the geometry. Which samples count is a constant in the graph: a
sample that enters or leaves beta's image when a rig moves has no gradient, which is part of the truth near
its border. With `border` samples fade there, the output is continuous, and its gradient whole. With `nearest`
the value and the peak have no gradient by the geometry (they are constant almost everywhere); position and
spread do, as weighted means of the positions.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn.functional import scaled_dot_product_attention
from torch.utils.checkpoint import checkpoint

from arraygeom import Dense, Local, Pair, Positions, Segments, View, lazily, pixel_grid
from arraygeom.checks import check_above, check_tensors
from arraygeom.pixels import HW, pixel_coordinates
from arraygeom.runtime.chunks import chunked
from arraygeom.runtime.tracing import needs_numbers, transformations
from pat.attention import reference, torch_op
from pat.attention.reference import Attended, AttentionInputs, SamplePositions, accumulated

Locations = Segments | Positions
Interpolation = Literal["bilinear", "nearest"]
Backend = Literal["auto", "reference", "cpu", "triton", "local"]

DTYPES = (torch.float64, torch.float32, torch.bfloat16, torch.float16)
CHUNK_SAMPLES = 2**22
"""Explicit positions that a callable is asked for at a time: 32 MiB of float32 (x, y)."""
CHUNK_PIXELS = 2**18
"""Segments that a callable is asked for at a time."""
LOCAL_SERVES = (
    "nearest values, without statistics, their gradients by query, key and value and no other derivatives, "
    "with a constant bias for each sample or none, of `Local` windows of odd size and whole spacing in "
    "float32 images of one size on the CPU"
)


def attend(
    query: Float[Tensor, "b d ha wa"],
    key: Float[Tensor, "b d hb wb"],
    value: Float[Tensor, "b dv hb wb"],
    locations: Locations | Callable[[Tensor], Locations] | Local | Dense,
    *,
    samples: int | None = None,
    interpolation: Interpolation = "bilinear",
    bias: Tensor | None = None,
    border: float = 0.0,
    backend: Backend = "auto",
) -> Float[Tensor, "b dv ha wa"]:
    """Compute for each alpha pixel the values at its samples in beta, weighted by softmax(query . key).

    The scores are plain inner products (the paper's). The output is channels-last in memory.

    Args:
        query: features of alpha; float64, float32, bfloat16 or float16, as are key and value. 16-bit numbers
            are accumulated in float32. Under autocast all three are cast to its type (the geometry never is).
        key: features of beta that the query is compared with.
        value: features of beta that are returned.
        locations: the search segments or sampling locations in beta of each alpha pixel: Segments or
            Positions with the leading axes (Ha, Wa) or (B, Ha, Wa), or a function from (n, 2) alpha pixels
            (x, y) to either, with the leading axes (n) or (B, n), which is called on one piece of alpha at a
            time, and for Positions again in backward, so that not all of these exist at once. Or the field
            `Local`: windows, of views of the same field of view; or `Dense`: all of beta (every `stride`-th
            pixel), by `scaled_dot_product_attention`, which may store all weights, if `border`, `samples` and
            `backend` have their defaults.
        samples: how many samples a segment has. None: one for each beta pixel of the longest valid one.
            Positions have their own number, which alone may be given.
        interpolation: `bilinear` (differentiable in the geometry) or `nearest` (the paper's).
        bias: added to the scores; anything that broadcasts to (B, Ha, Wa, L); -inf skips a sample; None for
            none.
        border: pixels from beta's border within which weights and values fall smoothly to 0, so that nothing
            jumps when a sample enters or leaves the image. Takes one number of memory for each sample.
        backend: `reference` (plain torch, differentiable any number of times and in forward mode), `cpu`,
            `triton`, `local` (windows alone, see `LOCAL_SERVES`; its output is channels-first in memory), or
            `auto`: `local` where that serves, or the compiled one of the tensors' device, with forward-mode
            derivatives and gradients of gradients by the reference, or the reference if there is none.

    Returns:
        Weighted means of the values (B, Dv, Ha, Wa), in the type of `value` (autocast's under autocast); 0
        where no sample counts.

    Raises:
        ValueError: shapes, devices, numbers or options that do not fit together.
        TypeError: not tensors, or not Segments or Positions; a mask that is not bool; dtypes that differ or
            are not supported.
        RuntimeError: an explicit backend that cannot serve, or a function that returns other axes than those
            of its pixels. What else the function raises passes.
        NotImplementedError: derivatives that an explicit backend does not have; segments without `samples`
            under `torch.func.vmap`.
    """
    given = query, key, value, locations, samples, interpolation, bias, border, backend
    return _attend(*given, measured=False)[0]


def attend_with_statistics(
    query: Float[Tensor, "b d ha wa"],
    key: Float[Tensor, "b d hb wb"],
    value: Float[Tensor, "b dv hb wb"],
    locations: Locations | Callable[[Tensor], Locations] | Local | Dense,
    *,
    samples: int | None = None,
    interpolation: Interpolation = "bilinear",
    bias: Tensor | None = None,
    border: float = 0.0,
    backend: Backend = "auto",
) -> Attended:
    """Compute `attend` together with statistics of its weights; arguments and errors as there.

    Returns:
        `Attended`: the values as `attend` returns them; the expected position of the match (B, 2, Ha, Wa) and
        the spread of the weights (`deviation`, (B, Ha, Wa)), pixels of beta; and the largest weight (`peak`,
        (B, Ha, Wa)). Statistics are float32 (float64 for float64 inputs) and differentiable, the peak not by
        the geometry if `nearest` without `border`. All are 0 where no sample counts.

    Raises:
        RuntimeError: as `attend`; also for the backend `local`, which has no statistics.
    """
    given = query, key, value, locations, samples, interpolation, bias, border, backend
    return Attended(*_attend(*given, measured=True))


def _attend(*given: Any, measured: bool) -> tuple[Tensor, ...]:
    """Values, and if `measured` the statistics; `given` are the arguments of `attend` in order."""
    query, key, value, locations, samples, interpolation, bias, border, backend = given
    check_tensors((), query=query, key=key, value=value)
    if not torch.compiler.is_compiling():
        check_above(0, border=border)
        check_above(1, whole=True, samples=samples)
    border, kind = float(border), query.device.type
    if kind != "meta" and torch.is_autocast_enabled(kind):
        query, key, value = (t.to(torch.get_autocast_dtype(kind)) for t in (query, key, value))
    _check(query, key, value, interpolation, backend)
    if bias is not None and bias.device != query.device:
        raise ValueError(f"bias is on {bias.device}, features on {query.device}: move one of them")
    nearest = interpolation == "nearest"
    if border > 0 and isinstance(locations, Local | Dense):
        locations = _lazily_between(query, key, locations)
    if isinstance(locations, Dense) and backend == "auto" and samples is None and not measured:
        return (_attend_dense(query, key, value, locations.stride, bias),)
    if isinstance(locations, Local | Dense):
        values_alone = nearest and samples is None and not measured
        asked = values_alone and backend in ("auto", "local")
        if isinstance(locations, Local) and asked and _local_serves(query, key, value, locations, bias):
            return (_attend_local(query, key, value, locations, bias),)
        locations = _lazily_between(query, key, locations)
    if backend == "local":
        raise RuntimeError(f"backend 'local' serves {LOCAL_SERVES} only: ask for 'auto'")

    def run(q: Tensor, k: Tensor, v: Tensor, locations: Locations, bias: Tensor | None) -> tuple[Tensor, ...]:
        form = sample_positions(locations, q, samples)
        if border > 0:
            seen = _visibility(form.positions(), (k.shape[2], k.shape[3]), border)
            faded = seen.clamp(min=LEAST_VISIBLE).log()
            bias = faded if bias is None else bias + faded
            v = v * _visibility(pixel_grid((k.shape[2], k.shape[3])).to(v), (k.shape[2], k.shape[3]), border)
        inputs = AttentionInputs(q, k, v, form, _bias(bias, q, form.samples), nearest)
        attended = _run(inputs, backend, measured)
        return attended if measured else attended[:1]

    if not callable(locations):
        return run(query, key, value, locations, bias)
    return _attend_by_rows(query, key, value, locations, bias, run)


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
        raise TypeError(f"query, key, value must be all float64, float32, bfloat16 or float16, got {names}")
    if not query.device == key.device == value.device:
        raise ValueError(f"query, key, value are on {query.device}, {key.device}, {value.device}: move them")
    if interpolation not in ("bilinear", "nearest"):
        raise ValueError(f"interpolation must be 'bilinear' or 'nearest', got {interpolation!r}")
    if backend not in get_args(Backend):
        raise ValueError(f"backend must be one of {', '.join(get_args(Backend))}, got {backend!r}")


LEAST_VISIBLE = 1e-9
"""Factor of the weight of a sample on the border's centres."""


def _visibility(xy: Tensor, hw: HW, border: float) -> Tensor:
    """Factor (*n) of weights at positions (*n, 2): 0 on the border's centres, 1 from `border` pixels on."""
    inside = torch.minimum(xy, xy.new_tensor([hw[1] - 1, hw[0] - 1]) - xy)
    share = (inside / border).clamp(0, 1)
    return (share * share * (3 - 2 * share)).prod(-1)


def _local_serves(query: Tensor, key: Tensor, value: Tensor, field: Local, bias: Tensor | None) -> bool:
    whole = field.size > 0 and field.size % 2 == 1 and float(field.spacing).is_integer()
    taken = query.dtype == torch.float32 and query.device.type == "cpu" and query.shape[2:] == key.shape[2:]
    tensors = query, key, value, bias
    plain = torch_op.is_seen_by_autograd_alone(*tensors) and not _missing(*tensors)
    of_samples = bias is None or (bias.shape == (field.size**2,) and bias.dtype == torch.float32)
    plain = plain and not torch_op.wants_gradient(bias)
    return whole and taken and plain and of_samples


def _attend_local(query: Tensor, key: Tensor, value: Tensor, field: Local, bias: Tensor | None) -> Tensor:
    def again(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        return attend(q, k, v, _lazily_between(q, k, field), interpolation="nearest", bias=bias)

    return torch_op.attend_local(query, key, value, field, bias, again)


def _lazily_between(query: Tensor, key: Tensor, field: Local | Dense) -> Callable[[Tensor], Locations]:
    """Locations of a field between two views of which only the sizes are known."""
    alpha, beta = (View(hw=(t.shape[2], t.shape[3])) for t in (query, key))
    return lazily(field, Pair(alpha, beta))


def _attend_dense(query: Tensor, key: Tensor, value: Tensor, stride: int, bias: Tensor | None) -> Tensor:
    """Attend to every `stride`-th pixel of beta by torch's own operator."""
    (b, _, ha, wa), dv = query.shape, value.shape[1]
    q, k, v = (t.flatten(2).mT for t in (query, key[..., ::stride, ::stride], value[..., ::stride, ::stride]))
    bias = _bias(bias, query, k.shape[1])
    mask = None if bias is None else bias.flatten(1, 2).to(q)
    return scaled_dot_product_attention(q, k, v, attn_mask=mask, scale=1.0).mT.reshape(b, dv, ha, wa)


def sample_positions(locations: Locations, query: Tensor, samples: int | None) -> SamplePositions:
    """Convert Segments or Positions to the one form that backends take, in their precision.

    Args:
        locations: segments (ha, wa) or (b, ha, wa), or positions with one more axis.
        query: features (b, d, ha, wa), for their sizes, device and precision.
        samples: samples of each segment; None for one on each beta pixel of the longest valid segment.

    Returns:
        `SamplePositions` with a leading batch axis of 1 or b, float64 for a float64 query, else float32.

    Raises:
        ValueError: for wrong axes, another device, no samples, or a number of samples that contradicts the
            positions.
        TypeError: for other types, and a mask that is not bool.
        NotImplementedError: for segments without `samples` under `torch.func.vmap`.
    """
    if isinstance(locations, Segments):
        points = torch.stack([locations.start, locations.end], -2)
        mask, straight = locations.valid[..., None], True
    elif isinstance(locations, Positions):
        points, mask, straight = locations.xy, locations.mask, False
        if samples not in (None, points.shape[-2]):
            raise ValueError(f"samples is {samples}, the positions are {points.shape[-2]} a pixel: omit it")
        samples = points.shape[-2]
    else:
        raise TypeError(f"locations are {type(locations)}: give Segments, Positions or a function of these")
    if mask.dtype != torch.bool:
        raise TypeError(f"the locations' mask must be bool, got {mask.dtype}: compare it, as in mask > 0")
    if samples is None:
        samples = samples_for(Segments(points[..., 0, :], points[..., 1, :], mask[..., 0]))
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
    b, _, ha, wa = query.shape
    if (got := tuple(mask.shape[:-1])) not in ((ha, wa), (b, ha, wa), (1, ha, wa)):
        raise ValueError(f"locations have the leading axes {got}, want {(ha, wa)} or {(b, ha, wa)}")
    if points.device != query.device:
        raise ValueError(f"locations are on {points.device}, features on {query.device}: move one of them")
    if mask.dim() == 3:
        points, mask = points[None], mask[None]
    count_in = torch.float64 if query.dtype == torch.float64 else torch.float32
    return SamplePositions(points.to(count_in), mask, samples, straight)


def samples_for(segments: Segments) -> int:
    """Return the number of samples that puts one on each beta pixel of the longest valid, finite segment."""
    what = "the number of samples of the longest segment (give `samples`)"
    needs_numbers(what, segments.start, segments.end)
    length = segments.length.detach()
    return int(torch.where(segments.valid & length.isfinite(), length, 0).max().ceil()) + 1


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
    tensors = inputs.query, inputs.key, inputs.value, inputs.positions.points, inputs.bias
    missing = "" if chosen == "reference" else _missing(*tensors)
    if missing and backend != "auto":
        raise NotImplementedError(f"backend '{backend}' has no {missing}: ask for backend=\"reference\"")
    if missing or chosen == "reference":
        return reference.attend(inputs)
    return torch_op.attend(inputs, measured=measured, backend=chosen, strict=backend != "auto")


def _missing(*tensors: Tensor | None) -> str:
    """Name of a derivative in progress that compiled backends lack; empty if there is none."""
    if torch.compiler.is_compiling():
        return ""
    under_way = transformations()
    tangents = (forward_ad.unpack_dual(t).tangent for t in tensors if t is not None)
    if "Jvp" in under_way or any(tangent is not None for tangent in tangents):
        return "forward mode"
    return "gradients by torch.func (by torch.autograd it has)" if "Grad" in under_way else ""


def chosen_backend(backend: Backend, device: str) -> str:
    """Resolve "auto", and check that a backend can serve tensors on a device.

    Args:
        backend: name of a backend; "reference" and "local" are returned without a check.
        device: type of the device, such as "cuda", without a number.

    Returns:
        The backend; for "auto" "cpu", "triton" (on "cuda", if installed) or "reference".

    Raises:
        RuntimeError: for "cpu" or "triton" that cannot serve tensors on the device.
    """
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


def _attend_by_rows(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    locations: Callable[[Tensor], Locations],
    bias: Tensor | None,
    run: Callable[..., tuple[Tensor, ...]],
) -> tuple[Tensor, ...]:
    """Ask `locations` for some rows of alpha at a time.

    Segments are small: they are gathered for the whole image. Explicit positions are used at once, and asked
    for again in backward.
    """
    x, y = pixel_coordinates((query.shape[2], query.shape[3]), dtype=accumulated(query), device=query.device)

    def at(x: Tensor, y: Tensor, kind: Any = None) -> Any:
        here = locations(torch.stack([x, y], -1).reshape(-1, 2))
        if not isinstance(here, kind or Locations):
            wanted = "Segments or Positions, of one kind for all pixels"
            raise TypeError(f"locations must return {wanted}, got {type(here)}")
        return here

    def segments(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        here, rows = at(x, y, Segments), x.shape[-2:]
        return here.start.unflatten(-2, rows), here.end.unflatten(-2, rows), here.valid.unflatten(-1, rows)

    def attended(q: Tensor, x: Tensor, y: Tensor, *bias_rows: Tensor) -> tuple[Tensor, ...]:
        positions = at(x, y, Positions)
        positions = Positions(positions.xy.unflatten(-3, x.shape), positions.mask.unflatten(-2, x.shape))
        return run(q, key, value, positions, bias_rows[0].transpose(1, 2) if bias_rows else None)

    first = at(x[:1], y[:1])
    if isinstance(first, Segments):
        batch = (None,) * (first.valid.dim() - 1)
        rows = max(1, CHUNK_PIXELS // x.shape[1])
        ends = chunked(segments, x[batch], y[batch], rows=rows, axis=len(batch))
        return run(query, key, value, Segments(*ends), bias)
    bias = _bias(bias, query, first.xy.shape[-2])
    biases = [] if bias is None else [bias.transpose(1, 2)]
    again = partial(checkpoint, attended, use_reentrant=False) if torch.is_grad_enabled() else attended
    return chunked(again, query, x, y, *biases, rows=max(1, CHUNK_SAMPLES // max(first.xy.numel() // 2, 1)))
