"""The paper's protocols on colour stereo pairs: what a method is given, and the methods that are compared.

`table1` is the paper's mono + colour (its Table 1): left made grey is alpha, right, reduced, is beta.
`table2` is mono + three bands (its Table 2): the bands of right are three cameras, each of one channel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from arraygeom import Camera, Pair, Pose, Positions, ReceptiveField, Rectified, Rig, Segments, intrinsics
from arraygeom.pixels import HW

from ..data.pairs import Disparity, StereoPair
from ..data.sample_array import BETA, SAMPLE
from ..fusion.fuse import fuse
from ..media.colour import luminance
from ..media.images import read_image
from ..networks.protocol import FusionNetwork
from .baseline import classical_fusion

PROTOCOLS = {"table1": False, "table2": True}
"""Whether each channel of beta is a camera of its own."""
PRINTED = {
    ("table1", "flickr1024"): {2: (27.26, 0.8992), 4: (25.85, 0.8840)},
    ("table1", "kitti"): {2: (29.55, 0.9097), 4: (28.40, 0.8957)},
    ("table2", "flickr1024"): {2: (25.55, 0.8714), 4: (24.00, 0.8493)},
    ("table2", "kitti"): {2: (28.77, 0.8955), 4: (28.13, 0.8903)},
}
"""PSNR and SSIM of fusion as the paper prints them, by protocol, data set and rate; on its own choice of images."""


class MonoColourTask(NamedTuple):
    """What a fusion gets (`alpha`, `beta`) and what it should return (`ground_truth`).

    alpha is grey and sharp. beta is in colour and `rate` times smaller: the pixel at x in the whole right
    image is at (x + 0.5) / rate - 0.5 in it.
    """

    alpha: Float[Tensor, "1 h w"]
    beta: Float[Tensor, "3 hb wb"]
    ground_truth: Float[Tensor, "3 h w"]


def mono_colour_task(pair: StereoPair, rate: int) -> MonoColourTask:
    """Left as the grey alpha (Rec. 601) and as the ground truth in colour; right, reduced `rate` times, as beta.

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
    ground_truth = _cut_to_multiple(pair.left, rate)
    return MonoColourTask(luminance(ground_truth), reduce_by(_cut_to_multiple(pair.right, rate), rate), ground_truth)


def reduce_by(image: Float[Tensor, "c h w"], rate: int) -> Float[Tensor, "c hr wr"]:
    """The mean of each `rate` x `rate` block, as a sensor with larger pixels sees it."""
    if rate < 1 or any(side % rate for side in image.shape[1:]):
        raise ValueError(f"cannot reduce {tuple(image.shape[1:])} by {rate}: give a rate that divides both sides")
    return avg_pool2d(image, rate)


def _cut_to_multiple(image: Float[Tensor, "c h w"], rate: int) -> Float[Tensor, "c hc wc"]:
    height, width = (side - side % rate for side in image.shape[1:])
    return image[:, :height, :width]


def hw_of(image: Float[Tensor, "c h w"]) -> HW:
    """Height and width."""
    return image.shape[-2], image.shape[-1]


class StereoResult(NamedTuple):
    """A colour image (3, H, W), 0..1, and the disparity (H, W) of its match, pixels of alpha; NaN unknown."""

    image: Tensor
    disparity: Tensor | None = None


StereoMethod = Callable[[Tensor, Tensor, float], Tensor | StereoResult]
"""(alpha (1, H, W), beta (3, Hb, Wb), max_disparity in alpha pixels) -> a colour image (3, H, W), 0..1, or more."""


def alpha_alone(alpha: Tensor, beta: Tensor, max_disparity: float) -> Tensor:
    """The grey image in all three channels: the score without any colour."""
    return alpha.expand(3, -1, -1)


def beta_alone(alpha: Tensor, beta: Tensor, max_disparity: float) -> Tensor:
    """The colour image enlarged (bicubic) and not warped: the score without any matching."""
    return interpolate(beta[None], alpha.shape[1:], mode="bicubic", align_corners=False)[0]


BASELINES: dict[str, StereoMethod] = {"alpha": alpha_alone, "beta": beta_alone, "classical": classical_fusion}
"""Methods without learning, by name."""


def rectified_fusion(
    network: FusionNetwork,
    *,
    bands: bool = False,
    beta: Callable[[Tensor], Tensor] = lambda beta: beta,
    shuffled: bool = False,
    field: ReceptiveField | None = None,
    **options: Any,
) -> StereoMethod:
    """`fuse` with a network as a method, alpha on the left: segments are rows, `max_disparity` pixels long.

    With `bands` each channel of beta is a camera. For controls: `beta` is applied to beta before the network gets it,
    and `shuffled` gives each pixel the segment of another one, drawn at random. `field` is another field than rows of
    that length. Other options go to `fuse`.
    """

    def fused(alpha: Tensor, given: Tensor, max_disparity: float) -> StereoResult:
        image = beta(given)
        betas = dict(zip("rgb", image.split(1))) if bands else {"beta": image}
        rig = rectified_rig(hw_of(alpha), {name: hw_of(band) for name, band in betas.items()}, max_disparity)
        looked_at = field or rectified_field(max_disparity)
        looked_at = ShuffledField(looked_at) if shuffled else looked_at
        frame = fuse(network, rig, {"alpha": alpha, **betas}, alpha="alpha", field=looked_at, **options)
        return StereoResult(frame.image, alpha.shape[-1] / frame.depth)

    return fused


def halved(pair: StereoPair) -> StereoPair:
    """The pair at half the size (cubic, as MATLAB's), as the paper's code tests: its "x2" and its "x4"."""
    hw = pair.left.shape[-2] // 2, pair.left.shape[-1] // 2
    disparity = None
    if pair.disparity is not None:
        value, valid = (t[: 2 * hw[0] : 2, : 2 * hw[1] : 2] for t in pair.disparity)
        disparity = Disparity(value / 2, valid)

    def smaller(image: Tensor) -> Tensor:
        cut = _cut_to_multiple(image, 2)[None]
        return interpolate(cut, hw, mode="bicubic", antialias=True, align_corners=False)[0].clamp(0, 1)

    return StereoPair(pair.name, smaller(pair.left), smaller(pair.right), pair.max_disparity, disparity)


@dataclass(frozen=True)
class AuthorsRows:
    """The rows of the paper's test loader: `arange(j - 80, j)` in column j, and columns 0 to 79 in the first 80.

    The pixel itself, zero disparity, is not among them.
    """

    length: int = 80

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Positions:
        """Integer positions in beta's pixels. Raises ValueError for views of unequal sizes."""
        if pair.alpha.hw != pair.beta.hw:
            sizes = f"alpha is {pair.alpha.hw}, beta {pair.beta.hw}"
            raise ValueError(f"the authors' rows need views of one size, and {sizes}: resize beta")
        column = x[..., :1].round()
        first = (column - self.length).clamp(min=0)
        columns = first + torch.arange(self.length, dtype=x.dtype, device=x.device)
        found = torch.stack([columns, x[..., 1:].round().expand_as(columns)], -1)
        return Positions(found, columns < pair.beta.hw[1])


def rectified_field(max_disparity: float) -> ReceptiveField:
    """Rows of `max_disparity` pixels, alpha on the left."""
    return Rectified(max_disparity, alpha_is="left")


def rectified_rig(hw: HW, betas: Mapping[str, HW], max_disparity: float) -> Rig:
    """A rectified rig in which disparity is alpha's width over depth, in pixels of alpha.

    All cameras have the same field of view; the betas are co-located, one metre to the right of alpha.
    """
    alpha = Camera(K=intrinsics(float(hw[1]), hw), cam_from_world=Pose.identity(), hw=hw)
    right = alpha.replace(cam_from_world=Pose(alpha.R, alpha.t.new_tensor([-1.0, 0.0, 0.0])))
    cameras = {"alpha": alpha} | {name: right.resize(size) for name, size in betas.items()}
    return Rig(cameras, depth=(hw[1] / max_disparity, math.inf))


@dataclass(frozen=True)
class ShuffledField:
    """A field in which each alpha pixel has the segment of another one: the same segments, wrongly assigned."""

    field: ReceptiveField
    seed: int = 0

    def __call__(self, pair: Pair, x: Float[Tensor, "*n 2"]) -> Segments | Positions:
        """The segments of the pixels to which a random permutation takes x."""
        h, w = pair.alpha.hw
        order = torch.randperm(h * w, generator=torch.Generator().manual_seed(self.seed)).to(x.device)
        column, row = x[..., 0].round().long().clamp(0, w - 1), x[..., 1].round().long().clamp(0, h - 1)
        drawn = order[row * w + column]
        return self.field(pair, torch.stack([drawn % w, drawn // w], -1).to(x))


def controls(network: FusionNetwork, *, bands: bool = False) -> dict[str, StereoMethod]:
    """A fusion that uses beta must score less with each: no beta (zeros), beta of another scene, shuffled fields."""
    other = read_image(SAMPLE / f"{BETA}.png")[None]

    def foreign(beta: Tensor) -> Tensor:
        return interpolate(other, hw_of(beta), mode="bicubic", align_corners=False, antialias=True)[0].clamp(0, 1)

    return {
        "no beta": rectified_fusion(network, bands=bands, beta=torch.zeros_like),
        "another scene's beta": rectified_fusion(network, bands=bands, beta=foreign),
        "shuffled fields": rectified_fusion(network, bands=bands, shuffled=True),
    }
