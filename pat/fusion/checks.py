"""What is doubtful about a fusion that is done: the confidence with which its images match."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from ..networks.protocol import FusionNetwork
from .inputs import FrameInputs
from .results import Frame

LOW_CONFIDENCE = 0.3
UNFIT_CONFIDENCE = 0.21
"""Mean confidences, where all views overlap, below which one is warned, and below which a rig is taken for
wrong.

Measured with the shipped weights: 34 pairs with the sign of the baseline changed had .04 to .38, 29 of them
below .3 and 19 below .21; the same with the right rig .35 to .79, two without texture or with strong noise
.22 and .23, and three bands at three positions .26 to .33.
"""


class LowConfidenceWarning(UserWarning):
    """The images hardly match along the rig's search segments; commands end with `exit_status`."""

    exit_status = 3


def warn_of_confidence(network: FusionNetwork, frame: Frame, inputs: FrameInputs) -> None:
    """Warn if the mean confidence is low where the segments of all betas are valid.

    Below `UNFIT_CONFIDENCE` by a `LowConfidenceWarning`. Only for networks whose confidence is a trained
    probability.
    """
    if not network.uses_matches:
        return
    mean = overlap_confidence(frame, inputs)
    if not mean < LOW_CONFIDENCE:
        return
    found = f"mean confidence {mean:.2f} where the views overlap"
    if mean < UNFIT_CONFIDENCE:
        text = f"{found}: the rig does not fit the images, or they hardly match: check it with `pat rig doctor`"
        warnings.warn(text, LowConfidenceWarning, stacklevel=3)
    else:
        warnings.warn(f"{found}: little texture, noise, or a rig that `pat rig doctor` finds wrong", stacklevel=3)


@contextmanager
def confidence_checked(*, strict: bool) -> Iterator[None]:
    """A block in which, if `strict`, a `LowConfidenceWarning` is raised."""
    with warnings.catch_warnings():
        if strict:
            warnings.simplefilter("error", LowConfidenceWarning)
        yield


def overlap_confidence(frame: Frame, inputs: FrameInputs) -> float:
    """The mean confidence where the segments of all betas are valid; NaN if that is nowhere."""
    h, w = inputs.hw
    overlap = torch.ones(inputs.hw, dtype=torch.bool, device=frame.confidence.device)
    for beta in inputs.inputs.betas:
        if beta.field.pixels is not None:
            overlap &= beta.field.pixels.valid.reshape(beta.field.pixels.valid.shape[-2:])[:h, :w]
    return float((frame.confidence.detach() * overlap).sum(dtype=torch.float64) / overlap.sum())
