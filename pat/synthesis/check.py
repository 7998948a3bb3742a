"""Is a rendered array true? Depth and cameras of one view must foretell what the others see."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom.pixels import pixel_grid
from arraygeom.sampling import sample

from .layered import ArrayBatch


class Across(NamedTuple):
    """For every pixel of one view: where its point is in another, whether it is seen there, and its colour there."""

    x: Float[Tensor, "b h w 2"]
    visible: Bool[Tensor, "b h w"]
    image: Float[Tensor, "b 3 h w"]


def look_across(batch: ArrayBatch, alpha: int = 0, beta: int = 1, *, tolerance: float = 0.01) -> Across:
    """Follow every pixel of view `alpha` into view `beta` by its depth.

    Visible means on beta's picture and as far from beta as the surface recorded there, to the relative `tolerance`.
    Inverse depth is interpolated, which is exact on planes; points beside an edge in beta count as not visible.
    """
    a, b = batch.cameras[alpha], batch.cameras[beta]
    grid = pixel_grid(a.hw, device=batch.images[alpha].device).flatten(0, 1).expand(len(a.K), -1, 2)
    X = a.unproject(grid, batch.depth[alpha].flatten(1))
    x, depth, in_front = b.project(X)
    seen = sample(torch.cat([batch.images[beta], 1 / batch.depth[beta][:, None]], 1), x)
    same = (seen.values[:, 3] * depth - 1).abs() < tolerance
    visible = in_front & seen.valid & same
    h, w = a.hw
    return Across(x.unflatten(1, (h, w)), visible.unflatten(1, (h, w)), seen.values[:, :3].unflatten(2, (h, w)))
