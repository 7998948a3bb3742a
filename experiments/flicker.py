"""How much a fused sequence flickers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pat.media.colour import to_bytes, to_luma_chroma

STILL = 0.5
"""Pixels that move less than this between two frames are still."""


def flicker(images: Sequence[Float[Tensor, "3 h w"]], greys: Sequence[Float[Tensor, "1 h w"]]) -> float:
    """Mean change of chroma (R - Y, B - Y) from frame to frame where nothing moves, 0..1.

    `greys` are alpha's frames, which show what moves. Raises ValueError for fewer than two frames.
    """
    if len(images) < 2:
        raise ValueError("flicker needs two frames or more")
    changes = []
    for (a, b), (grey_a, grey_b) in zip(pairwise(images), pairwise(greys)):
        change = (to_luma_chroma(b)[1] - to_luma_chroma(a)[1]).abs().mean(0)
        changes.append(float(change[still(grey_a, grey_b)].mean()))
    return sum(changes) / len(changes)


def still(a: Float[Tensor, "1 h w"], b: Float[Tensor, "1 h w"]) -> Bool[Tensor, "h w"]:
    """Where nothing moves from frame a to b, and nothing near does."""
    engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow = engine.calc(to_bytes(a[0]), to_bytes(b[0]), np.empty(0, np.float32))
    moves = (np.square(flow).sum(-1) > STILL**2).astype(np.uint8)
    return torch.from_numpy(cv2.dilate(moves, np.ones((9, 9), np.uint8)) == 0)
