"""What is refused before a fusion begins, and what is doubtful about one that is done."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from jaxtyping import Float
from torch import Tensor

from ..networks.bandwise import BandwisePAT
from ..networks.guided import GuidedPAT
from ..networks.protocol import FusionNetwork
from .inputs import FrameInputs
from .results import Frame
from .views import Views

LOW_CONFIDENCE = 0.3
UNFIT_CONFIDENCE = 0.21
"""Mean confidences, where all views overlap, below which one is warned, and below which a rig is taken for wrong.

Measured with the shipped weights: 34 pairs with the sign of the baseline changed had .04 to .38, 29 of them below .3
and 19 below .21; the same with the right rig .35 to .79, two without texture or with strong noise .22 and .23, and
three bands at three positions .26 to .33.
"""


class LowConfidenceWarning(UserWarning):
    """The images hardly match along the rig's search segments; commands end with `exit_status`."""

    exit_status = 3


def check_bands(network: FusionNetwork, views: Views) -> None:
    """Refuse betas whose bands are not those that the network makes; warn of those whose three bands are equal.

    Raises ValueError that says which weights to take.
    """
    _refuse_bands(network, views)
    for name in views.betas:
        image = views.images[name]
        if len(image) == 3 and equal_bands(image):
            warnings.warn(f"the image of '{name}' has three equal bands: it is grey, and gives no colour", stacklevel=3)


def _refuse_bands(network: FusionNetwork, views: Views) -> None:
    wanted = network.config.bands if isinstance(network, GuidedPAT) else None
    bands = {name: len(views.images[name]) for name in views.betas}
    total = sum(bands.values())
    if wanted is None or total == wanted or wanted in bands.values():
        return
    listed = ", ".join(f"'{name}' {count}" for name, count in bands.items())
    advice = ""
    if wanted == 3 and total == 1:
        sensor = views.rig[next(iter(bands))].sensor
        said = ", and the rig says that it is in colour" if sensor.response == "rgb" else ""
        advice = f"its image is grey{said}: give one in colour, or "
    raise ValueError(
        f"the betas have {total} band{'s' if total > 1 else ''} in all ({listed}), these weights make {wanted}: "
        f"{advice}take the weights mono-spectral, which fuse any number of bands"
    )


def equal_bands(image: Float[Tensor, "c h w"]) -> bool:
    """Whether all bands are the same."""
    return all(torch.equal(image[0], band) for band in image[1:])


def warn_of_confidence(network: FusionNetwork, frame: Frame, inputs: FrameInputs) -> None:
    """Warn if the mean confidence is low where the segments of all betas are valid.

    Below `UNFIT_CONFIDENCE` by a `LowConfidenceWarning`. Only for networks whose confidence is a trained probability.
    """
    if not isinstance(network, GuidedPAT | BandwisePAT):
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
