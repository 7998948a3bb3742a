"""What a network is given and gives back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from arraygeom.runtime.chunks import Box, slices

from ..attention.scores import Compared
from ..matching.inputs import Inputs
from ..matching.match import match
from ..matching.matches import Matches


class FusionOutput(NamedTuple):
    """A network's result at alpha's view.

    image: (B, C, s H, s W), the fused image.
    position: one (B, 2, H, W) for each beta, where its pixels were found, in beta's pixels.
    deviation: one (B, H, W) for each beta, the standard deviation of that position, in beta's pixels.
    confidence: one (B, H, W) for each beta, 0 to 1: that beta sees the point and that its position is right.
    overall: (B, H, W), the confidence of the image; None: the least of the betas'.
    """

    image: Tensor
    position: list[Tensor]
    deviation: list[Tensor]
    confidence: list[Tensor]
    overall: Tensor | None = None

    def cut(self, box: Box) -> FusionOutput:
        """The part at (top, bottom, left, right); of an image that is not enlarged."""
        index = (..., *slices(box))
        position, deviation, confidence = ([t[index] for t in tensors] for tensors in self[1:4])
        overall = None if self.overall is None else self.overall[index]
        return FusionOutput(self.image[index], position, deviation, confidence, overall)


JoinsBands = Literal["no", "neighbours", "all"]


@runtime_checkable
class FusionNetwork(Protocol):
    """What `fuse` asks of a network: what bands it makes, whether it uses matches, and to be called.

    The rest says in what form the images are to come.
    """

    bands: int | None
    """The bands of its image; None: whatever the betas have."""
    uses_matches: bool
    """Whether it is called with matches; then its confidence is a trained probability."""
    learned: bool
    """Whether matching's trained networks take part in its matches."""
    keeps_luminance: bool
    """Whether the luminance of its image is alpha's."""
    halo: int
    """How far around a pixel alpha's image, and the fields of its pixels, can matter, pixels."""
    beta_halo: int
    """How far around the segments beta's image can matter, pixels."""
    multiple: int
    """Images are padded to multiples of this, and cut at them."""
    equal_resolution: bool
    """Whether betas are to be resized to about alpha's angular resolution."""
    joins_bands: JoinsBands
    """Which co-located betas are to come as one of several bands: none, those that follow each other (where
    the order of the bands matters), or all."""

    def working_bytes(self, alpha: int, betas: Sequence[int]) -> float:
        """Memory to fuse so many pixels of alpha with so many of each beta, beside the inputs, measured."""
        ...

    def __call__(self, inputs: Inputs, matches: Matches | None = None) -> FusionOutput:
        """Fuse. Raises ValueError without matches if it uses them."""
        ...


@runtime_checkable
class Comparing(Protocol):
    """A network with C3 attention over its inputs' segments, which training can supervise by geometry."""

    betas: int
    """The number it is made for: one in all bands, or several with a band each."""

    def compare(self, inputs: Inputs) -> tuple[FusionOutput, list[Compared]]:
        """Fuse, and what attention compares in each beta."""
        ...


def matched_for(network: FusionNetwork, inputs: Inputs) -> Matches | None:
    """The matches that a network wants of these inputs, if any."""
    return match(wanted(network, inputs)) if network.uses_matches else None


def wanted(network: FusionNetwork, inputs: Inputs) -> Inputs:
    """Inputs that say what a network wants of its matches."""
    return replace(inputs, bands=network.bands, learned=network.learned)


def fused_at_once(network: FusionNetwork, inputs: Inputs) -> FusionOutput:
    """Whole inputs matched, if the network wants that, and fused."""
    return network(inputs, matched_for(network, inputs))


def required(matches: Matches | None, inputs: Inputs) -> Matches:
    """The matches, if they are of these inputs. Raises ValueError if there are none, or others."""
    if matches is None:
        raise ValueError("this network fuses by matches: call it as network(inputs, match(inputs))")
    matches.check(inputs)
    return matches
