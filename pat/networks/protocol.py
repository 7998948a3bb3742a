"""The protocol of fusion networks: their inputs and outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from arraygeom.runtime.chunks import Box, slices

from ..attention.scores import Compared
from ..matching.inputs import Beta, Inputs, Matches
from ..matching.match import match


class FusionOutput(NamedTuple):
    """Output of a network at alpha's view.

    Attributes:
        image: the fused image (B, C, s H, s W).
        position: by beta, (x, y) of alpha's pixels, (B, 2, H, W), beta's pixels; without meaning where the
            confidence is 0.
        deviation: by beta, standard deviation of that position, (B, H, W), beta's pixels; 1 where the network
            does not estimate it.
        confidence: by beta, confidence that it sees the point at that position, (B, H, W), 0 to 1: a trained
            probability, PAT's largest weight of attention, or 1 for a consistent classical match.
        overall: confidence of the image, (B, H, W); None where the least of the betas' counts.
    """

    image: Tensor
    position: list[Tensor]
    deviation: list[Tensor]
    confidence: list[Tensor]
    overall: Tensor | None = None

    def cut(self, box: Box) -> FusionOutput:
        """Return the part in a box (top, bottom, left, right), of an image that is not enlarged."""
        index = (..., *slices(box))
        position, deviation, confidence = ([t[index] for t in tensors] for tensors in self[1:4])
        overall = None if self.overall is None else self.overall[index]
        return FusionOutput(self.image[index], position, deviation, confidence, overall)

    def with_overall(self, betas: Sequence[Beta]) -> FusionOutput:
        """Return the same with the largest confidence as `overall`: of the betas that have all bands of the
        image, or of all betas if none has.
        """
        bands = self.image.shape[1]
        sources = [c for c, beta in zip(self.confidence, betas) if beta.image.shape[1] == bands]
        return self._replace(overall=torch.stack(sources or self.confidence).amax(0))


JoinsBands = Literal["no", "neighbours", "all"]


@runtime_checkable
class FusionNetwork(Protocol):
    """Interface of the networks that `fuse` can call: attributes, `working_bytes` and a call.

    The attributes, each described beside its name, state the image (`bands`, `keeps_luminance`), matching
    (`uses_matches`, `learned`), and inputs (`halo`, `beta_halo`, `multiple`, `equal_resolution`,
    `joins_bands`). `isinstance` looks for these names only.
    """

    bands: int | None
    """Number of bands of its image; None for all bands of the betas."""
    uses_matches: bool
    """True if it must be called with matches; its confidence is then that of the matches."""
    learned: bool
    """True if matching's trained networks take part in its matches."""
    keeps_luminance: bool
    """True if the luminance of its image is alpha's, as far as `Inputs.luminance` says."""
    halo: int
    """Pixels around a pixel within which alpha's image, and the fields of its pixels, can matter."""
    beta_halo: int
    """Pixels around the segments within which beta's image can matter."""
    multiple: int
    """Number of pixels to whose multiples images are padded, and at whose multiples they are cut."""
    equal_resolution: bool
    """True if betas are resized to about alpha's angular resolution first."""
    joins_bands: JoinsBands
    """Co-located betas that are joined to one of several bands: none ("no"), those that follow each other
    ("neighbours", where the order of the bands matters), or "all"."""

    def working_bytes(self, alpha: int, betas: Sequence[int]) -> float:
        """Return the measured memory to fuse so many pixels of alpha with so many of each beta, beside the
        inputs, bytes."""
        ...

    def __call__(self, inputs: Inputs, matches: Matches | None = None) -> FusionOutput:
        """Fuse the inputs.

        Args:
            matches: result of `match(inputs)`; None for a network without `uses_matches`.

        Returns:
            The image, with position, deviation and confidence in each beta.

        Raises:
            ValueError: without matches, if it uses them.
        """
        ...


@runtime_checkable
class Comparing(Protocol):
    """Interface of a network with attention along its inputs' segments, which can be trained by true
    positions: `betas` and `compare`."""

    betas: int
    """Number of betas that it is made for."""

    def compare(self, inputs: Inputs) -> tuple[FusionOutput, list[Compared]]:
        """Fuse, and keep the features that attention compares in each beta.

        Returns:
            The output, and the compared features of each beta.
        """
        ...


def matched_for(network: FusionNetwork, inputs: Inputs) -> Matches | None:
    """Return the matches that a network needs of these inputs; None if it uses none."""
    return match(wanted(network, inputs)) if network.uses_matches else None


def wanted(network: FusionNetwork, inputs: Inputs) -> Inputs:
    """Return the inputs with the bands and the kind of matching that a network needs."""
    return replace(inputs, bands=network.bands, learned=network.learned)


def fused_at_once(network: FusionNetwork, inputs: Inputs) -> FusionOutput:
    """Fuse whole inputs, matched first if the network uses matches.

    Returns:
        The network's output.
    """
    return network(inputs, matched_for(network, inputs))


def required(matches: Matches | None, inputs: Inputs) -> Matches:
    """Check that a network that needs matches was given some that fit its inputs.

    Args:
        matches: matches that it was called with; None if it was called without.

    Returns:
        The same matches.

    Raises:
        ValueError: for None, and matches that `Matches.check` refuses, as for another size, number of betas
            or shape of planes, or NaN. Matches of other images of the same size are not noticed.
    """
    if matches is None:
        raise ValueError("this network fuses by matches: call it as network(inputs, match(inputs))")
    matches.check(inputs)
    return matches
