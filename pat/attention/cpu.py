"""C3 attention on the CPU: drives the compiled loops with as many threads as torch may use.

The threads are a plain pool, for which the loops release Python's lock: idle ones sleep, so that they do not
take the cores from torch's own. Nothing depends on how many there are: each output number is made by one
thread in an order that the inputs alone give.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from arraygeom.segments import sample_fractions
from pat.attention import cpu_kernels as kernels
from pat.attention.reference import EDGE_SLACK, Look

PIECE_SAMPLES = 2**17
"""Samples of one task: a millisecond or two."""
SCRATCH_TAPS = 2**19
"""Taps that backward holds at a time, 12 bytes each (16 in float64)."""


def forward(
    query: Tensor, key: Tensor, value: Tensor, look: Look, bias: Tensor | None, nearest: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Values (b, dv, ha, wa), channels last; statistics (b, ha, wa, 4); log of the sum of exponentials (b,
    ha, wa)."""
    b, d, ha, wa = query.shape
    dv = value.shape[1]
    counted = _accumulated(query)
    out = _new(b, ha, wa, dv, dtype=query.dtype)
    statistics = query.new_empty(b, ha, wa, 4, dtype=counted)
    logsum = query.new_empty(b, ha, wa, dtype=counted)
    call = (
        *(_flat(_channels_last(t)) for t in (query, key, value)),
        _geometry(look, query, key, nearest),
        _flat(_bias(bias, counted)),
        d,
        dv,
    )
    outputs = (_flat(out), _flat(statistics), _flat(logsum))
    pieces = _pieces(0, b * ha * wa, look)
    _share([partial(_in_room, kernels.forward, call, (*piece, *outputs)) for piece in pieces])
    return out.permute(0, 3, 1, 2), statistics, logsum


def backward(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    look: Look,
    bias: Tensor | None,
    nearest: bool,
    saved: tuple[Tensor, Tensor],
    cotangents: tuple[Tensor, Tensor],
    wanted: Sequence[bool],
) -> tuple[Tensor, ...]:
    """Gradients by query, key, value (channels last), points and bias; of no length where not wanted.

    `saved` are statistics and logsum of forward, `cotangents` those of values and statistics. A piece of
    alpha at a time, in two steps: its pixels are shared among the threads for all that belongs to alpha; then
    the channels are, for the additions to beta's pixels.
    """
    b, d, ha, wa = query.shape
    dv, counted = value.shape[1], _accumulated(query)
    q, k, v, upstream = (_flat(_channels_last(t)) for t in (query, key, value, cotangents[0]))
    query_out = _new(*((b, ha, wa, d) if wanted[0] else (0,)), dtype=query.dtype)
    key_out, value_out = (
        _new(*((b, *t.shape[2:], t.shape[1]) if want else (0,)), dtype=counted).zero_()
        for t, want in ((key, wanted[1]), (value, wanted[2]))
    )
    points_out = query.new_zeros((b, *look.points.shape[1:]) if wanted[3] else 0, dtype=counted)
    bias_out = query.new_zeros((b, ha, wa, look.samples) if wanted[4] else 0, dtype=counted)

    stride = (look.samples * (1 if nearest else 4) // kernels.LANES + 2) * kernels.LANES
    step = max(64, SCRATCH_TAPS // stride)
    scratch = _scratch(min(step, b * ha * wa), stride, query)
    call = (
        *(q, k, v, _geometry(look, query, key, nearest), _flat(_bias(bias, counted)), d, dv),
        *(_flat(saved[1]), _flat(saved[0])),
        *(upstream, _flat(cotangents[1].to(counted).contiguous())),
    )
    outputs = tuple(_flat(t) for t in (query_out, points_out, bias_out))
    additions = [
        *_channel_tasks(scratch.by_key, scratch, stride, q, d, key_out),
        *_channel_tasks(scratch.by_value, scratch, stride, upstream, dv, value_out),
    ]
    for first in range(0, b * ha * wa, step):
        last = min(first + step, b * ha * wa)
        rest = (first, stride, scratch, *outputs)
        pieces = _pieces(first, last, look)
        _share([partial(_in_room, kernels.backward, call, (*piece, *rest)) for piece in pieces])
        _share([partial(add, first, last) for add in additions])
    pictures = (
        (out.to(like.dtype).permute(0, 3, 1, 2) if want else like.new_empty(0))
        for out, like, want in zip((query_out, key_out, value_out), (query, key, value), wanted)
    )
    points_out = points_out.sum_to_size(look.points.shape) if wanted[3] else points_out
    return *pictures, points_out, bias_out


def _accumulated(tensor: Tensor) -> torch.dtype:
    return torch.float64 if tensor.dtype == torch.float64 else torch.float32


def _channels_last(picture: Tensor) -> Tensor:
    """(b, d, h, w) to (b, h, w, d); a copy only if it does not lie in memory like that."""
    return picture.permute(0, 2, 3, 1).contiguous()


def _flat(tensor: Tensor) -> np.ndarray:
    """The numbers as the kernels know them: bfloat16 as uint16, float16 as int16."""
    seen = {torch.bfloat16: torch.uint16, torch.float16: torch.int16}.get(tensor.dtype, tensor.dtype)
    return tensor.detach().reshape(-1).view(seen).numpy()


def _new(*shape: int, dtype: torch.dtype) -> Tensor:
    """An uninitialised tensor. Of numpy's memory, which asks for huge pages: first touching torch's pages of
    4 KiB took an eighth of forward's time."""
    if not math.prod(shape):
        return torch.empty(shape, dtype=dtype)
    return torch.from_numpy(np.empty(math.prod(shape) * dtype.itemsize, np.uint8)).view(dtype).view(shape)


def _bias(bias: Tensor | None, counted: torch.dtype) -> Tensor:
    return torch.empty(0, dtype=counted) if bias is None else bias.to(counted).contiguous()


def _geometry(look: Look, query: Tensor, key: Tensor, nearest: bool) -> kernels.Look:
    h, w = key.shape[2:]
    number = _number(query)
    fractions = pad(sample_fractions(look.samples, like=look.points), (0, kernels.LANES))
    return kernels.Look(
        points=_flat(look.points.contiguous()),
        mask=_flat(look.mask.contiguous().view(torch.uint8)),
        fractions=_flat(fractions),
        samples=look.samples,
        straight=look.straight,
        nearest=nearest,
        alpha_pixels=query.shape[2] * query.shape[3],
        shared=look.points.shape[0] == 1,
        height=h,
        width=w,
        last_x=number(w - 1),
        last_y=number(h - 1),
        slack=number(EDGE_SLACK),
    )


def _number(like: Tensor) -> type:
    return np.float64 if _accumulated(like) == torch.float64 else np.float32


def _in_room(kernel: Callable[..., None], call: tuple, rest: tuple) -> None:
    """Calls a kernel with scratch of its own."""
    look, channels = call[3], max(call[5:7])
    integers, numbers = kernels.room(look.samples, channels)
    kernel(*call, np.empty(integers, np.int32), np.empty(numbers, look.fractions.dtype), *rest)


def _scratch(pixels: int, stride: int, like: Tensor) -> kernels.Scratch:
    taps = pixels * stride + kernels.LANES
    number = _number(like)
    return kernels.Scratch(
        np.empty(pixels, np.int32), np.empty(taps, np.int32), np.empty(taps, number), np.empty(taps, number)
    )


def _channel_tasks(
    weights: np.ndarray, scratch: kernels.Scratch, stride: int, x: np.ndarray, channels: int, out: Tensor
) -> list[Callable[[int, int], None]]:
    """One task for each block of channels; how wide the blocks are changes no bit of the result."""
    if not out.numel():
        return []
    lanes = kernels.LANES
    width = -(-channels // (lanes * torch.get_num_threads())) * lanes
    flat = _flat(out)

    def task(c: int) -> Callable[[int, int], None]:
        return lambda first, last: kernels.scatter(
            scratch.counts,
            scratch.rows,
            weights,
            stride,
            x,
            channels,
            first,
            last,
            c,
            min(c + width, channels),
            flat,
        )

    return [task(c) for c in range(0, channels, width)]


def _pieces(first: int, last: int, look: Look) -> list[tuple[int, int]]:
    step = max(1, PIECE_SAMPLES // look.samples)
    return [(p, min(p + step, last)) for p in range(first, last, step)]


def _share(tasks: list[Callable[[], None]]) -> None:
    """Runs tasks on the threads that torch may use, this one included; raises what any of them raises."""
    left = iter(tasks)

    def work() -> None:
        for task in left:
            task()

    helpers = min(torch.get_num_threads(), len(tasks)) - 1
    waiting = [_pool(os.getpid(), helpers).submit(work) for _ in range(helpers)]
    work()
    for future in waiting:
        future.result()


@lru_cache(maxsize=4)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Threads of this process: those of a parent do not live on in its forks."""
    return ThreadPoolExecutor(threads, thread_name_prefix="pat-attention")
