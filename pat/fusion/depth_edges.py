"""Depth with alpha's edges: beside them, the weighted median of the depth around.

Matching compares squares, and is off by pixels beside an edge of depth. There each pixel takes the median
depth of those around, weighted by their similarity in alpha (Ma, He, Wei, Sun and Wu, Constant time weighted
median filtering for stereo matching and beyond, 2013).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.runtime.chunks import chunked, spans
from arraygeom.runtime.threads import in_parallel

from ..matching.filters import numpy_of
from ..support.settings import size, tuned
from . import depth_edges_numba as kernels
from .frame import Frame
from .inputs import FrameInputs


@dataclass(frozen=True)
class EdgeSettings:
    """Settings of the choice of depth next to depth edges.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    radius: int = size(5, "Pixels to each side of what counts around a pixel")
    near: int = size(2, "Pixels to an edge of depth up to which depth is chosen anew")
    alike: float = tuned(
        0.1, "Middlebury, tune half, of .02 to .2: the standard deviation of what is alike in alpha"
    )


SETTINGS = EdgeSettings()
ROWS, STRIP = 512, 16
"""Size: rows of a part, and those of it that a thread takes at a time."""


def beside_edges(
    depth: Float[Tensor, "h w"], frame: Frame, frame_inputs: FrameInputs
) -> Float[Tensor, "h w"]:
    """Replace depth near depth edges by that of a nearby pixel: the median weighted by similarity in alpha.

    An edge is a change of inverse depth by more than the width of its interval. Gradients are those of the
    pixel whose depth is taken.

    Args:
        depth: depth to change, metres; NaN where unknown.
        frame: fused frame with the confidence and interval of depth.
        frame_inputs: inputs of the frame.

    Returns:
        Depth (H, W); unchanged where segments were around a known depth of each pixel, or no depth is known.
    """
    has_depth = depth.isfinite() & (frame.confidence > 0)
    if any(beta.around for beta in frame_inputs.inputs.betas) or not bool(has_depth.any()):
        return depth
    likely = has_depth & (frame.confidence >= frame.confidence[has_depth].mean())
    step = 2 * float(frame.half_width[likely].detach().nanmedian())
    if not step > 0:
        return depth
    alpha = frame_inputs.inputs.alpha[0, 0, : depth.shape[0], : depth.shape[1]]
    halo = SETTINGS.near + SETTINGS.radius
    return chunked(partial(_taken, step=step), depth, alpha, rows=ROWS, halo=halo)


def _taken(depth: Float[Tensor, "h w"], alpha: Float[Tensor, "h w"], step: float) -> Float[Tensor, "h w"]:
    inverse, grey = numpy_of(1 / depth), numpy_of(alpha)
    square, finite = np.ones((2 * SETTINGS.near + 1,) * 2, np.uint8), np.isfinite(inverse)
    greatest = cv2.dilate(np.where(finite, inverse, 0), square)
    least = cv2.erode(np.where(finite, inverse, np.float32(np.inf)), square)
    where = finite & (greatest > least + np.float32(step))
    weights = 4096 * np.exp(-np.square(np.arange(256) / (255 * SETTINGS.alike)) / 2)
    out = np.empty(inverse.shape, np.int64)
    rows = partial(kernels.weighted_medians, inverse, grey, where, weights.astype(np.int32), SETTINGS.radius)
    in_parallel([partial(rows, *span, out) for span in spans(len(out), STRIP)])
    return depth.flatten()[torch.from_numpy(out).to(depth.device)]
