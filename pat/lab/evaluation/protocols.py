"""The paper's mono + colour on stereo pairs: what a method is given, and the methods that are compared.

Left made grey is alpha, right, reduced, is beta.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

from jaxtyping import Float, Shaped
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from arraygeom import Camera, Pose, Rectified, Rig, intrinsics
from arraygeom.pixels import HW

from ...fusion.classical import classical_fusion
from ...fusion.fuse import FuseSettings, fuse_frame
from ...matching.match import Matcher, match
from ...media.colour import luminance
from ...networks.protocol import FusionNetwork
from ..data.pairs import Disparity, StereoPair


class MonoColourTask(NamedTuple):
    """What a fusion gets (`alpha`, `beta`) and what it should return (`ground_truth`).

    alpha is grey and sharp. beta is in colour and `rate` times smaller: the pixel at x in the whole right
    image is at (x + 0.5) / rate - 0.5 in it. `disparity` is of the ground truth's pixels, where it is known.
    """

    alpha: Float[Tensor, "1 h w"]
    beta: Float[Tensor, "3 hb wb"]
    ground_truth: Float[Tensor, "3 h w"]
    disparity: Disparity | None = None


def mono_colour_task(pair: StereoPair, rate: int) -> MonoColourTask:
    """Left as grey alpha (Rec. 601) and as ground truth in colour; right, reduced `rate` times, as beta.

    A pixel of beta is the mean of `rate` x `rate` pixels of right, as a sensor with larger pixels sees it.
    Rows and columns beyond the last multiple of `rate` are cut from the bottom and the right. Raises
    ValueError for a grey pair, and for images of unequal sizes.
    """
    if pair.left.shape[0] != 3 or pair.right.shape[0] != 3:
        raise ValueError(f"{pair.name}: the mono + colour protocol needs colour images, and these are grey")
    if pair.left.shape != pair.right.shape:
        raise ValueError(
            f"{pair.name}: left is {tuple(pair.left.shape[1:])} and right {tuple(pair.right.shape[1:])}: "
            "the mono + colour protocol needs equal sizes"
        )
    ground_truth, right = (cut_to_multiple(image, rate) for image in (pair.left, pair.right))
    disparity = pair.disparity and Disparity(*(cut_to_multiple(plane, rate) for plane in pair.disparity))
    return MonoColourTask(luminance(ground_truth), avg_pool2d(right, rate), ground_truth, disparity)


def cut_to_multiple(image: Shaped[Tensor, "*c h w"], rate: int) -> Shaped[Tensor, "*c hc wc"]:
    """The image without the rows and columns beyond the last multiple of `rate`."""
    height, width = (side - side % rate for side in image.shape[-2:])
    return image[..., :height, :width]


def hw_of(image: Float[Tensor, "*c h w"]) -> HW:
    """Height and width."""
    return image.shape[-2], image.shape[-1]


class StereoResult(NamedTuple):
    """An image (3, H, W), 0..1 or more, and the disparity (H, W) of its match in alpha's pixels, or NaN."""

    image: Tensor
    disparity: Tensor | None = None


StereoMethod = Callable[[Tensor, Tensor, float], StereoResult]
"""Of alpha (1, H, W), beta (3, Hb, Wb), and the largest disparity in alpha's pixels."""


def enlarged(beta: Float[Tensor, "c hb wb"], hw: HW) -> Float[Tensor, "c h w"]:
    """Beta as large as alpha (bicubic, 0..1), and not warped."""
    return interpolate(beta[None], hw, mode="bicubic", align_corners=False)[0].clamp(0, 1)


BASELINES: dict[str, StereoMethod] = {
    "alpha": lambda alpha, beta, most: StereoResult(alpha.expand(3, -1, -1)),
    "beta": lambda alpha, beta, most: StereoResult(enlarged(beta, hw_of(alpha))),
    "classical": lambda alpha, beta, most: StereoResult(classical_fusion(alpha, beta, most)),
}
"""Methods without learning, by name: without any colour, without any matching."""


def rectified_fusion(
    network: FusionNetwork,
    *,
    bands: bool = False,
    settings: FuseSettings = FuseSettings(),
    matcher: Matcher = match,
) -> StereoMethod:
    """`fuse` with a network as a method, alpha on the left: segments are rows, `max_disparity` pixels long.

    With `bands` each channel of beta is a camera. A field in the settings replaces rows of that length.
    """

    def fused(alpha: Tensor, beta: Tensor, max_disparity: float) -> StereoResult:
        betas = dict(zip("rgb", beta.split(1))) if bands else {"beta": beta}
        rig = rectified_rig(hw_of(alpha), {name: hw_of(band) for name, band in betas.items()}, max_disparity)
        field = settings.field or Rectified(max_disparity, alpha_is="left")
        how, images = replace(settings, field=field), {"alpha": alpha, **betas}
        frame = fuse_frame(images, rig, alpha="alpha", network=network, settings=how, matcher=matcher)
        return StereoResult(frame.image, alpha.shape[-1] / frame.depth)

    return fused


def rectified_rig(hw: HW, betas: Mapping[str, HW], max_disparity: float) -> Rig:
    """A rectified rig in which disparity is alpha's width over depth, in pixels of alpha.

    All cameras have the same field of view; the betas are co-located, one metre to the right of alpha.
    """
    alpha = Camera(K=intrinsics(float(hw[1]), hw), cam_from_world=Pose.identity(), hw=hw)
    right = alpha.replace(cam_from_world=Pose(alpha.R, alpha.t.new_tensor([-1.0, 0.0, 0.0])))
    cameras = {"alpha": alpha} | {name: right.resize(size) for name, size in betas.items()}
    return Rig(cameras, depth=(hw[1] / max_disparity, math.inf))
