"""Motion between frames of one camera: optical flow, its reliability, and images warped along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import pixel_grid, sample

from ..matching.normalisation import likeness
from ..media.colour import to_bytes
from ..support.settings import tuned


@dataclass(frozen=True)
class FlowSettings:
    """Settings of optical flow between frames.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    astray: float = tuned(
        1.0, "Source not recorded: flow that does not lead back to so many pixels has a weight below 1 / e"
    )


SETTINGS = FlowSettings()


class Flow(NamedTuple):
    """Motion of each pixel between two frames.

    Attributes:
        step: motion (2, H, W) from the first frame to the second, pixels in x and y.
        weight: reliability of the motion (H, W), 0 to 1.
    """

    step: Float[Tensor, "2 h w"]
    weight: Float[Tensor, "h w"]


def flow_between(a: Float[Tensor, "1 h w"], b: Float[Tensor, "1 h w"]) -> Flow:
    """Compute optical flow from frame a to b by dense inverse search (Kroeger et al. 2016).

    Frames are grey, 0..1, of one size, on the CPU. Values of b are first brought to a's mean: flickering
    light is no motion.

    Returns:
        The flow, weighted by forward-backward consistency and photometric similarity; the weight is 0 where
        motion leaves the image.
    """
    b = b * (a.mean() / b.mean().clamp(min=1e-6))
    there, back = _steps(a, b), _steps(b, a)
    returned = there + warped(back, there)
    alike = likeness((warped(b, there) - a)[None])[0, 0]
    weight = alike * torch.exp(-returned.square().sum(0) / SETTINGS.astray**2)
    h, w = there.shape[-2:]
    x = pixel_grid((h, w)) + there.movedim(0, -1)
    inside = ((x >= 0) & (x <= x.new_tensor([w - 1, h - 1]))).all(-1)
    return Flow(there, weight * inside.float())


def warped(image: Float[Tensor, "c h w"], step: Float[Tensor, "2 h w"]) -> Float[Tensor, "c h w"]:
    """Sample an image at each pixel's target, bilinearly; outside the frame its nearest pixel."""
    h, w = image.shape[-2:]
    x = pixel_grid((h, w)) + step.movedim(0, -1)
    return sample(image[None], x[None], extended=True).values[0]


def _steps(a: Tensor, b: Tensor) -> Float[Tensor, "2 h w"]:
    """Compute the flow of frames extended to two of OpenCV's patches a side: it may crash by smaller ones."""
    h, w = a.shape[-2:]
    engine = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    least = 2 * engine.getPatchSize()
    margins = (0, max(least - h, 0)), (0, max(least - w, 0))
    first, second = (np.pad(to_bytes(frame[0]), margins, "edge") for frame in (a, b))
    flow = engine.calc(first, second, np.empty(0, np.float32))[:h, :w]
    return torch.from_numpy(np.ascontiguousarray(flow.transpose(2, 0, 1)))
