"""Doubts about a finished fusion: the confidence with which its images match."""

from __future__ import annotations

import statistics
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from arraygeom.runtime.warned import warn

from ..matching.inputs import Inputs
from ..networks.protocol import FusionNetwork
from .frame import Frame
from .inputs import FrameInputs
from .low_light import shown_noise

LOW_CONFIDENCE, LOW_SHARE = 0.5, 0.25
"""Mean confidence, where all views overlap, below which a warning is given, and the share of that area with
less than half of it above which one is. Of ten of Middlebury's pairs the right rig gives .66 to .84 and up to
17 %; six with a black third, with every other row shifted or in other light give .16 to .48 and from 22 %,
but for one (.56 and 14 %)."""
UNFIT_CONFIDENCE = 0.16
"""Mean confidence, where all views overlap, below which the rig counts as wrong; a warning begins at
`LOW_CONFIDENCE`. Measured on Middlebury's tune half: with the sign of the baseline changed, or beta turned
upside down, 36 pairs had .05 to .24, 32 of them below .16; the same with the right rig .61 to .88, with beta
reduced eight times .27 to .55, and with 50 electrons from .23."""
PLAIN_NOISE = 4 / 255
"""Standard deviation from which noise is named as a reason."""


class LowConfidenceWarning(UserWarning):
    """Warning that the images hardly match along the rig's search segments.

    Commands that show it end with `exit_status`.
    """

    exit_status = 3


def warn_of_confidence(network: FusionNetwork, frame: Frame, inputs: FrameInputs) -> None:
    """Warn if confidence is low, in the mean or in a large part, where the segments of all betas are valid.

    A mean below `UNFIT_CONFIDENCE` gives a `LowConfidenceWarning`, others a UserWarning. Of bands of several
    betas the median one decides: some bands of nine differ from alpha whatever the rig. Nothing is checked
    without such pixels, and for networks without matches, whose confidence is no probability.
    """
    overlap = _overlap(inputs).to(frame.confidence.device)
    if not (network.uses_matches and overlap.any()):
        return
    by_band = frame.confidence[None] if frame.by_band is None else frame.by_band
    maps = [one.detach() * overlap for one in by_band]
    means = [float(one.sum(dtype=torch.float64) / overlap.sum()) for one in maps]
    mean = statistics.median_low(means)
    confidence = maps[means.index(mean)].float()
    share = float(((confidence < LOW_CONFIDENCE / 2) & overlap).sum() / overlap.sum())
    if mean >= LOW_CONFIDENCE and share <= LOW_SHARE:
        return
    several = " of the median band" if frame.by_band is not None else ""
    unfit = mean < UNFIT_CONFIDENCE
    why = "little texture, noise, other light, something in the way, or a rig that `pat rig doctor` names"
    if unfit:
        why = "the rig does not fit the images, or they hardly match: check it with `pat rig doctor`"
    ninths = adaptive_avg_pool2d(confidence[None], 3) / adaptive_avg_pool2d(overlap[None].float(), 3)
    row, column = divmod(int(ninths.nan_to_num(torch.inf).argmin()), 3)
    place = f"{('top', 'middle', 'bottom')[row]} {('left', 'centre', 'right')[column]}"
    text = (
        f"mean confidence {mean:.2f}{several} where the views overlap, under {LOW_CONFIDENCE / 2:g} in "
        f"{share:.0%} of that, lowest at the {place}: {why}{noise_advice(inputs.inputs)}"
    )
    warn(text, LowConfidenceWarning if unfit else UserWarning)


def noise_advice(inputs: Inputs) -> str:
    """Return advice on noise that the middle of an image shows plainly; empty if there is hardly any."""
    shown = max(shown_noise(image[0]) for image in (inputs.alpha, *(beta.image for beta in inputs.betas)))
    advice = f"; noise of {255 * shown:.0f}/255 shows: try `--noise estimate` first"
    return "" if shown < PLAIN_NOISE else advice


@contextmanager
def confidence_checked(*, strict: bool) -> Iterator[None]:
    """Context manager in which, if `strict`, a `LowConfidenceWarning` is raised."""
    with warnings.catch_warnings():
        if strict:
            warnings.simplefilter("error", LowConfidenceWarning)
        yield


def _overlap(inputs: FrameInputs) -> Bool[Tensor, "h w"]:
    """Compute the mask of the pixels where all betas' segments are valid."""
    h, w = inputs.hw
    overlap = torch.ones(inputs.hw, dtype=torch.bool)
    for beta in inputs.inputs.betas:
        if beta.field.pixels is not None:
            valid = beta.field.pixels.valid
            overlap = overlap.to(valid) & valid.reshape(valid.shape[-2:])[:h, :w]
    return overlap
