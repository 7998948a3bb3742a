"""The paper's mono + colour protocol (its Table 1), made from any colour stereo pair."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from pat.data.pairs import StereoPair
from pat.media.colour import luminance


class MonoColourTask(NamedTuple):
    """What a fusion gets (`alpha`, `beta`) and what it should return (`truth`).

    alpha is grey and sharp. beta is in colour and `rate` times smaller: the pixel at x in the whole right
    image is at (x + 0.5) / rate - 0.5 in it.
    """

    alpha: Float[Tensor, "1 h w"]
    beta: Float[Tensor, "3 hb wb"]
    ground_truth: Float[Tensor, "3 h w"]


def mono_colour_task(pair: StereoPair, rate: int) -> MonoColourTask:
    """Left as the grey alpha (Rec. 601) and as the truth in colour; right, reduced `rate` times, as beta.

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
