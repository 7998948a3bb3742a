"""What the fusion hands to a network, and what it gets back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

from torch import Tensor

from arraygeom.fields.grid import Box

from ..matching.inputs import Inputs


@runtime_checkable
class State(Protocol):
    """What a network has found out about whole images before parts of them are fused; opaque to the fusion."""

    @property
    def nbytes(self) -> int:
        """Memory held."""
        ...

    def cut(self, box: Box) -> State:
        """What belongs to a part of alpha."""
        ...


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
        top, bottom, left, right = box
        part = (..., slice(top, bottom), slice(left, right))
        position, deviation, confidence = ([t[part] for t in tensors] for tensors in self[1:4])
        overall = None if self.overall is None else self.overall[part]
        return FusionOutput(self.image[part], position, deviation, confidence, overall)


JoinsBands = Literal["no", "neighbours", "all"]


@runtime_checkable
class FusionNetwork(Protocol):
    """What `fuse` asks of a network."""

    halo: int
    """How far around a pixel alpha's image, and the fields of its pixels, can matter, pixels."""
    beta_halo: int
    """How far around the segments beta's image can matter, pixels."""
    multiple: int
    """Images are padded to multiples of this, and cut at them."""
    equal_resolution: bool
    """Whether betas are to be resized to about alpha's angular resolution."""
    joins_bands: JoinsBands
    """Which co-located betas are to come as one of several bands: none, those that follow each other (where the order
    of the bands matters), or all."""

    def working_bytes(self, alpha: int, betas: Sequence[int]) -> float:
        """Memory that fusing so many pixels of alpha with so many of each beta takes, beside the inputs, measured."""
        ...

    def prepare(self, inputs: Inputs) -> State | None:
        """What must be known of whole images (of whole multiples) before parts of them are fused, if anything."""
        ...

    def __call__(self, inputs: Inputs, state: Any = None) -> FusionOutput:
        """Fuse; without a state, one is prepared from these inputs."""
        ...
