"""Convolutions on all threads, next to compiled loops that leave torch one thread."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from arraygeom.runtime.threads import in_parallel, limited_to, threads

WORTH_STRIPS = 10**8
"""Multiplications in a convolution above which splitting into strips pays: some milliseconds of work."""
STRIPS = 2
"""Strips for each thread: more than one, as other processes may occupy a core."""


_SLEEPING = os.environ.get("OMP_WAIT_POLICY", "").upper() == "PASSIVE"
"""True if torch's own threads sleep while they wait (OMP_WAIT_POLICY=PASSIVE), as in the commands."""


@contextmanager
def convolutions_in_parallel() -> Iterator[None]:
    """Context manager that computes `torch.conv2d` on all `threads` inside `torch_in_one_thread`.

    Convolutions without gradients are cut into strips of rows for the pool's threads, which sleep while they
    wait; the others use torch's threads. Results agree with `torch.conv2d` to rounding.
    """
    with _InStrips() if threads() > 1 else nullcontext():
        yield


class _InStrips(TorchFunctionMode):
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is not torch.conv2d or kwargs or len(args) != 7:
            return func(*args, **(kwargs or {}))
        if _SLEEPING or torch.is_grad_enabled() or torch.is_autocast_enabled("cpu"):
            with limited_to(threads()):
                return func(*args)
        return _convolved(*args)


def _convolved(
    x: Tensor, weight: Tensor, bias: Any, stride: Any, padding: Any, dilation: Any, groups: int
) -> Tensor:
    """`torch.conv2d` to rounding; for one large image computed in strips of rows, each with the rows its
    kernel reaches."""
    further = bias, stride, padding, dilation, groups
    plain = x.device.type == "cpu" and tuple(stride) == (1, 1) and not isinstance(padding, str)
    if not plain or len(x) != 1 or weight[0].numel() * len(weight) * x[0, 0].numel() < WORTH_STRIPS:
        return torch.conv2d(x, weight, *further)
    reach, above = dilation[0] * (weight.shape[2] - 1), padding[0]
    width = x.shape[3] + 2 * padding[1] - dilation[1] * (weight.shape[3] - 1)
    order = torch.contiguous_format if x.is_contiguous() and weight.is_contiguous() else torch.channels_last
    shape = 1, len(weight), x.shape[2] + 2 * above - reach, width
    out = torch.empty(shape, dtype=x.dtype, memory_format=order)
    rows = math.ceil(out.shape[2] / (STRIPS * threads()))

    def strip(top: int) -> None:
        bottom = min(top + rows, out.shape[2])
        first = max(top - above, 0)
        convolved = torch.conv2d(x[:, :, first : max(bottom - above + reach, first + 1)], weight, *further)
        out[:, :, top:bottom] = convolved[:, :, top - first : bottom - first]

    in_parallel([partial(strip, top) for top in range(0, out.shape[2], rows)])
    return out
