"""Attention of every pixel to a window of pixels around it, in compiled loops: what `attend` gives for a `Local` field
between views of one size, in a fifth of its time. Without gradients."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.threads import in_parallel

from .kernels import ROWS, attend_rows


def attend_to_windows(
    query: Float[Tensor, "b d h w"],
    key: Float[Tensor, "b d h w"],
    value: Float[Tensor, "b c h w"],
    size: int,
    spacing: int,
) -> Float[Tensor, "b c h w"]:
    """The mean of the values at `size` x `size` pixels, `spacing` apart, by the softmax of inner products; float32 on
    the CPU. What is outside the image does not count."""
    planes = [x.detach().contiguous().numpy() for x in (query, key, value)]
    out = np.empty_like(planes[2])
    tops = range(0, out.shape[-2], ROWS)
    in_parallel(
        [lambda one=one, top=top: attend_rows(*one, size, spacing, top) for one in zip(*planes, out) for top in tops]
    )
    return torch.from_numpy(out)
