"""C3 attention on the CPU: runs the compiled loops on as many threads as torch may use.

The threads are a plain pool, for which the loops release Python's lock: idle ones sleep, so that they do not
take the cores from torch's own. Results do not depend on their number: each output number is made by one
thread in an order that the inputs alone give.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from arraygeom.fields import Local
from arraygeom.runtime.threads import in_parallel, threads
from arraygeom.sampling import SLACK
from arraygeom.segments import sample_fractions
from pat.attention import kernels
from pat.attention.reference import AttentionInputs, accumulated, channels_last

PIECE_SAMPLES = 2**15
"""Samples that a thread takes at a time: a fraction of a millisecond."""
SCRATCH_TAPS = 2**20
"""Taps that backward holds at a time, 12 bytes each (16 in float64)."""


def forward(inputs: AttentionInputs, measured: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute attention of prepared inputs.

    Args:
        measured: True to compute statistics.

    Returns:
        Values (b, dv, ha, wa) of the query's type, channels last in memory; in `accumulated` precision
        statistics (b, ha, wa, 4): x, y, spread, peak (empty if not `measured`), and the log of the sum of
        exponentials (b, ha, wa), -inf where no sample counts; and an empty tensor, where the GPU backend has
        the samples of largest weight. Nothing has a gradient.
    """
    query = inputs.query
    b, _, ha, wa = query.shape
    counted = accumulated(query)
    out = _new(b, ha, wa, inputs.value.shape[1], dtype=counted)
    statistics = _new(*((b, ha, wa, 4) if measured else (0,)), dtype=counted)
    logsum = _new(b, ha, wa, dtype=counted)
    call = _call(inputs)
    outputs = kernels.Outputs(_flat(out), _flat(statistics), _flat(logsum), measured)
    in_parallel([partial(kernels.forward, call, share, outputs) for share in _shares(0, b * ha * wa, call)])
    return out.to(query.dtype).permute(0, 3, 1, 2), statistics, logsum, torch.empty(0, dtype=torch.int32)


def forward_local(
    query: Tensor, key: Tensor, value: Tensor, field: Local, bias: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Attend to windows around the same pixel of a view of equal size: nearest look-up, float32.

    Args:
        query: features (b, d, h, w) of alpha.
        key: features (b, d, h, w) of beta.
        value: values (b, dv, h, w) of beta.
        field: size and spacing of the windows; an odd size and whole spacing, which are not checked.
        bias: score (size²) added to each sample, the same for all pixels, where -inf skips the sample; None
            for none.

    Returns:
        Values (b, dv, h, w), channels first, 0 where no sample counts; log of the sum of exponentials
        (b, h, w), inf there. Neither has a gradient.
    """
    planes = [_planes(x) for x in (query, key, value)]
    out = np.empty_like(planes[2])
    logsum = np.empty((len(out), *out.shape[2:]), np.float32)
    _by_rows(kernels.attend_rows, zip(*planes, out, logsum), out.shape[2], field, bias)
    return torch.from_numpy(out), torch.from_numpy(logsum)


def backward_local(
    inputs: Sequence[Tensor],
    field: Local,
    bias: Tensor | None,
    outputs: Sequence[Tensor],
    upstream: Tensor,
    wanted: Sequence[bool],
) -> tuple[Tensor, ...]:
    """Differentiate `forward_local` by query, key and value.

    Args:
        inputs: query, key and value, as given to `forward_local`; so are `field` and `bias`.
        outputs: results of `forward_local`.
        upstream: gradient (b, dv, h, w) by the values.
        wanted: three flags, True for a gradient to compute.

    Returns:
        Three gradients of the inputs' shapes; zeros where not `wanted`.
    """
    planes, wide = [_planes(x) for x in inputs], _planes(upstream)
    sums = _planes(torch.stack([outputs[1], (upstream * outputs[0]).sum(1)], 1))
    gradients = [np.zeros_like(x) for x in planes]
    images = ((*one[:5], one[5:], wanted) for one in zip(*planes, wide, sums, *gradients))
    _by_rows(kernels.differentiate_rows, images, wide.shape[2], field, bias)
    return tuple(map(torch.from_numpy, gradients))


def _planes(images: Tensor) -> np.ndarray:
    return images.detach().contiguous().numpy()


def _by_rows(
    kernel: Callable[..., None], images: Iterable[tuple], height: int, field: Local, bias: Tensor | None
) -> None:
    """Run one of the window loops for each image, some rows at a time."""
    of_samples = np.zeros(field.size**2, np.float32) if bias is None else _planes(bias)
    window = of_samples, np.flatnonzero(of_samples != -np.inf), field.size, round(field.spacing)
    rows = [partial(kernel, *image, *window) for image in images]
    in_parallel([partial(of_image, top) for of_image in rows for top in range(0, height, kernels.ROWS)])


def backward(
    inputs: AttentionInputs,
    saved: tuple[Tensor, Tensor, Tensor, Tensor | None],
    cotangents: tuple[Tensor, Tensor],
    wanted: Sequence[bool],
) -> tuple[Tensor, ...]:
    """Differentiate `forward` by query, key, value, points and bias.

    One piece of alpha at a time, in two steps: first pixels are shared among the threads, for all gradients
    of alpha; then channels are, for the additions to beta's pixels.

    Args:
        inputs: inputs of `forward`.
        saved: results of `forward`: statistics, log sums, and two that only the GPU's needs.
        cotangents: gradients by values and statistics (empty if these are).
        wanted: five flags, True for a gradient to compute.

    Returns:
        Five gradients of the inputs' shapes, empty where not `wanted`: of images in the query's type,
        channels last in memory; of points and of bias (b, ha, wa, samples) in `accumulated` precision.
    """
    query, key, value, positions, *_ = inputs
    b, d, ha, wa = query.shape
    counted = accumulated(query)
    call = _call(inputs)
    upstream = _flat(channels_last(cotangents[0].to(counted)))
    measured = saved[0], cotangents[1].to(counted).contiguous()
    statistics, statistics_upstream = (t if t.numel() else t.new_zeros(4) for t in measured)
    step = 4 if saved[0].numel() else 0
    results = kernels.Saved(_flat(statistics), _flat(saved[1]), upstream, _flat(statistics_upstream), step)
    query_out, key_out, value_out = (
        _new(*((b, *t.shape[2:], t.shape[1]) if want else (0,)), dtype=counted).zero_()
        for t, want in zip((query, key, value), wanted)
    )
    points_out = query.new_zeros((b, *positions.points.shape[1:]) if wanted[3] else 0, dtype=counted)
    bias_out = query.new_zeros((b, ha, wa, positions.samples) if wanted[4] else 0, dtype=counted)
    outputs = _flat(query_out), _flat(points_out), _flat(bias_out)
    gradients = kernels.Gradients(*outputs, wanted[0], wanted[3], wanted[4])
    taps = _tap_list(b * ha * wa, call)
    step = len(taps.tap_count)
    for first in range(0, b * ha * wa, step):
        last, here = min(first + step, b * ha * wa), taps._replace(first=first)
        shares = _shares(first, last, call)
        in_parallel([partial(kernels.backward, call, results, share, here, gradients) for share in shares])
        for_keys = _channel_tasks(here, here.key_weight, last, call.query, d, key_out)
        for_values = _channel_tasks(here, here.value_weight, last, upstream, call.value_channels, value_out)
        in_parallel([*for_keys, *for_values])
    images = (
        (out.to(like.dtype).permute(0, 3, 1, 2) if want else like.new_empty(0))
        for out, like, want in zip((query_out, key_out, value_out), (query, key, value), wanted)
    )
    points_out = points_out.sum_to_size(positions.points.shape) if wanted[3] else points_out
    return *images, points_out, bias_out


def _flat(tensor: Tensor) -> np.ndarray:
    """Flat numpy array of a tensor, for the kernels."""
    return tensor.detach().reshape(-1).numpy()


def _new(*shape: int, dtype: torch.dtype) -> Tensor:
    """Uninitialised tensor in numpy's memory, which asks for huge pages: first touching torch's pages of 4
    KiB took an eighth of forward's time."""
    if not math.prod(shape):
        return torch.empty(shape, dtype=dtype)
    return torch.from_numpy(np.empty(math.prod(shape) * dtype.itemsize, np.uint8)).view(dtype).view(shape)


def _call(inputs: AttentionInputs) -> kernels.Call:
    query, key, value, positions, bias, nearest = inputs
    counted, (h, w) = accumulated(query), key.shape[2:]
    number = np.float64 if counted == torch.float64 else np.float32
    fractions = pad(sample_fractions(positions.samples, like=positions.points), (0, kernels.LANES))
    geometry = kernels.Geometry(
        points=_flat(positions.points.contiguous()),
        mask=_flat(positions.mask.contiguous().view(torch.uint8)),
        fractions=_flat(fractions),
        samples=positions.samples,
        straight=positions.straight,
        nearest=nearest,
        alpha_pixels=query.shape[2] * query.shape[3],
        shared=positions.points.shape[0] == 1,
        height=h,
        width=w,
        last_x=number(w - 1),
        last_y=number(h - 1),
        slack=number(SLACK),
    )
    images = [_flat(channels_last(image.to(counted))) for image in (query, key, value)]
    return kernels.Call(
        *images,  # type: ignore[arg-type]
        geometry=geometry,
        bias=_flat(query.new_empty(0, dtype=counted) if bias is None else bias.to(counted).contiguous()),
        biased=bias is not None,
        channels=query.shape[1],
        value_channels=value.shape[1],
    )


def _shares(first: int, last: int, call: kernels.Call) -> list[kernels.Share]:
    """Work shares, one for each thread that is needed."""
    samples, number = call.geometry.samples, call.geometry.fractions.dtype
    size, counter = max(1, PIECE_SAMPLES // samples), np.zeros(1, np.int64)
    channels = max(call.channels, call.value_channels)
    return [
        kernels.Share(first, last, size, counter, kernels.block_scratch(samples, channels, number))
        for _ in range(min(threads(), -(-(last - first) // size)))
    ]


def _tap_list(pixels: int, call: kernels.Call) -> kernels.TapList:
    """Tap list for as many pixels as fit into `SCRATCH_TAPS`."""
    geometry = call.geometry
    stride = (geometry.samples * (1 if geometry.nearest else 4) // kernels.LANES + 2) * kernels.LANES
    pixels = min(pixels, max(64, SCRATCH_TAPS // stride))
    counts, rows = np.empty((pixels, 1), np.int32), np.empty((pixels, stride), np.int32)
    weights = (np.empty((pixels, stride), geometry.fractions.dtype) for _ in range(2))
    return kernels.TapList(0, counts, rows, *weights)


def _channel_tasks(
    taps: kernels.TapList, weights: np.ndarray, last: int, x: np.ndarray, channels: int, out: Tensor
) -> list[Callable[[], None]]:
    """Tasks for blocks of channels; their width changes no bit of the result."""
    if not out.numel():
        return []
    lanes = kernels.LANES
    width = -(-channels // (lanes * threads())) * lanes
    flat = _flat(out)
    return [
        partial(kernels.scatter, taps, weights, last, x, channels, c, min(c + width, channels), flat)
        for c in range(0, channels, width)
    ]
