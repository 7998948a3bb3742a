"""The paper's mono + colour protocol on stereo pairs, and the methods under comparison.

Left made grey is alpha; right, reduced, is beta.
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
from arraygeom.checks import check_above
from arraygeom.pixels import HW

from ...fusion.classical import classical_fusion
from ...fusion.fuse import FuseSettings, fuse_frame
from ...matching.match import Matcher, match
from ...media.colour import luminance
from ...networks.protocol import FusionNetwork
from ..data.pairs import Disparity, StereoPair


class MonoColourTask(NamedTuple):
    """One fusion task of the protocol.

    Attributes:
        alpha: left, made grey.
        beta: right in colour, `rate` times smaller: the pixel at x in right is at (x + 0.5) / rate - 0.5 in
            it.
        ground_truth: left in colour.
        disparity: true disparity of the ground truth's pixels, in those pixels; None if unknown.
    """

    alpha: Float[Tensor, "1 h w"]
    beta: Float[Tensor, "3 hb wb"]
    ground_truth: Float[Tensor, "3 h w"]
    disparity: Disparity | None = None


def mono_colour_task(pair: StereoPair, rate: int) -> MonoColourTask:
    """Make the task of a stereo pair: left as grey alpha (Rec. 601) and as ground truth, right reduced as
    beta.

    A pixel of beta is the mean of `rate` x `rate` pixels of right. Rows and columns beyond the last multiple
    of `rate` are cut from both images and the disparity, whose unit stays.

    Args:
        pair: pair of colour images.
        rate: factor by which beta is smaller than alpha, 1 or more.

    Raises:
        ValueError: if an image is grey, and for images of unequal sizes or smaller than `rate`.
    """
    if pair.left.shape[0] != 3 or pair.right.shape[0] != 3:
        raise ValueError(f"{pair.name}: the mono + colour protocol needs colour images, and these are grey")
    if pair.left.shape != pair.right.shape:
        raise ValueError(
            f"{pair.name}: left is {tuple(pair.left.shape[1:])} and right {tuple(pair.right.shape[1:])}: "
            "the mono + colour protocol needs equal sizes"
        )
    if min(pair.left.shape[1:]) < rate:
        raise ValueError(
            f"{pair.name}: images of {tuple(pair.left.shape[1:])} are smaller than {rate} pixels"
        )
    ground_truth, right = (cut_to_multiple(image, rate) for image in (pair.left, pair.right))
    disparity = pair.disparity and Disparity(*(cut_to_multiple(plane, rate) for plane in pair.disparity))
    return MonoColourTask(luminance(ground_truth), avg_pool2d(right, rate), ground_truth, disparity)


def cut_to_multiple(image: Shaped[Tensor, "*c h w"], rate: int) -> Shaped[Tensor, "*c hc wc"]:
    """Cut the rows and columns beyond the last multiple of `rate`, at the bottom and the right.

    Returns:
        A view of the image.
    """
    height, width = (side - side % rate for side in image.shape[-2:])
    return image[..., :height, :width]


def hw_of(image: Float[Tensor, "*c h w"]) -> HW:
    """Return an image's (height, width)."""
    return image.shape[-2], image.shape[-1]


class StereoResult(NamedTuple):
    """Result of a fusion method.

    Attributes:
        image: fused image (3, h, w) at alpha's pixels, may exceed 0..1.
        disparity: disparity (h, w) of alpha's pixels, in pixels of alpha, NaN or infinite where unknown; None
            if the method returns none.
    """

    image: Tensor
    disparity: Tensor | None = None


StereoMethod = Callable[[Tensor, Tensor, float], StereoResult]
"""Fusion method: called with alpha (1, h, w), beta (3, hb, wb), the largest disparity in pixels of alpha."""


def enlarged(beta: Float[Tensor, "c hb wb"], hw: HW) -> Float[Tensor, "c h w"]:
    """Enlarge beta to alpha's size `hw` (bicubic, clipped to 0..1), without warping.

    Returns:
        Image (c, *hw).
    """
    return interpolate(beta[None], hw, mode="bicubic", align_corners=False)[0].clamp(0, 1)


BASELINES: dict[str, StereoMethod] = {
    "alpha": lambda alpha, beta, most: StereoResult(alpha.expand(3, -1, -1)),
    "beta": lambda alpha, beta, most: StereoResult(enlarged(beta, hw_of(alpha))),
    "classical": lambda alpha, beta, most: StereoResult(classical_fusion(alpha, beta, most)),
}
"""Methods without learning: alpha alone, beta alone, and the classical fusion."""


def rectified_fusion(
    network: FusionNetwork,
    *,
    bands: bool = False,
    settings: FuseSettings = FuseSettings(),
    matcher: Matcher = match,
) -> StereoMethod:
    """Make a method from `fuse_frame` with a network, alpha on the left: segments are rows, `max_disparity`
    pixels long, of beta as the network receives it.

    Args:
        network: network to fuse with.
        bands: True to treat each of beta's (up to three) channels as a camera of its own.
        settings: settings of fusion; a field in them replaces the rows.
        matcher: matcher to use instead of `match`.

    Returns:
        The method, called with alpha, beta and `max_disparity` (above 0). It raises what `rectified_rig` and
        `fuse_frame` raise.
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
    """Make a rectified rig in which disparity is alpha's width over depth, in pixels of alpha.

    All cameras have the same field of view; the betas are together, one metre to the right of alpha.

    Args:
        hw: (height, width) of alpha.
        betas: (height, width) of each beta, by name; a beta called "alpha" would replace alpha.
        max_disparity: pixels of alpha, which sets the near bound; the far bound is infinity.

    Returns:
        The rig; its first camera is called "alpha".

    Raises:
        ValueError: unless `max_disparity` is finite and above 0.
    """
    check_above(0, itself=False, max_disparity=max_disparity)
    alpha = Camera(K=intrinsics(float(hw[1]), hw), cam_from_world=Pose.identity(), hw=hw)
    right = alpha.replace(cam_from_world=Pose(alpha.R, alpha.t.new_tensor([-1.0, 0.0, 0.0])))
    cameras = {"alpha": alpha} | {name: right.resize(size) for name, size in betas.items()}
    return Rig(cameras, depth=(hw[1] / max_disparity, math.inf))
