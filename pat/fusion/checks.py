"""Doubts about a finished fusion: the confidence with which its images match."""

from __future__ import annotations

import statistics
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from arraygeom.runtime.warned import warn

from ..matching.inputs import Inputs
from ..networks.protocol import FusionNetwork
from .frame import Frame
from .inputs import FrameInputs
from .low_light import shown_noise

LOW_CONFIDENCE = 0.25
UNFIT_CONFIDENCE = 0.16
"""Mean confidences, where all views overlap, below which one is warned, and a rig is taken for wrong.

Measured on Middlebury's tune half: with the sign of the baseline changed, or beta turned upside down, 36
pairs had .05 to .24, 32 of them below .16; the same with the right rig .61 to .88, with beta reduced eight
times .27 to .55, and with 50 electrons from .23.
"""
PLAIN_NOISE = 4 / 255
"""The standard deviation from which noise is named as a reason."""


class LowConfidenceWarning(UserWarning):
    """Warning that the images hardly match along the rig's search segments; commands end with
    `exit_status`."""

    exit_status = 3


def warn_of_confidence(network: FusionNetwork, frame: Frame, inputs: FrameInputs) -> None:
    """Warn if the mean confidence is low where the segments of all betas are valid.

    Below `UNFIT_CONFIDENCE` by a `LowConfidenceWarning`. Of bands that are each another beta's, by that of
    the median band: some bands of nine are unlike alpha whatever the rig. Only for networks whose confidence
    is a trained probability.
    """
    if not network.uses_matches:
        return
    mean = statistics.median(overlap_confidences(frame, inputs))
    if not mean < LOW_CONFIDENCE:
        return
    several = " of the median band" if frame.by_band is not None else ""
    unfit = mean < UNFIT_CONFIDENCE
    why = "little texture, noise, or a rig that `pat rig doctor` finds wrong"
    if unfit:
        why = "the rig does not fit the images, or they hardly match: check it with `pat rig doctor`"
    text = f"mean confidence {mean:.2f}{several} where the views overlap: {why}{noise_advice(inputs.inputs)}"
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


def overlap_confidences(frame: Frame, inputs: FrameInputs) -> list[float]:
    """The mean confidence, or each band's, where all betas' segments are valid; NaN if that is nowhere."""
    h, w = inputs.hw
    overlap = torch.ones(inputs.hw, dtype=torch.bool, device=frame.confidence.device)
    for beta in inputs.inputs.betas:
        if beta.field.pixels is not None:
            overlap &= beta.field.pixels.valid.reshape(beta.field.pixels.valid.shape[-2:])[:h, :w]
    maps = [frame.confidence] if frame.by_band is None else frame.by_band
    return [float((one.detach() * overlap).sum(dtype=torch.float64) / overlap.sum()) for one in maps]
