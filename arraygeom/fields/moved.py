"""The field of moving points, for a beta that records at another time than alpha."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Real
from torch import Tensor

from ..checks import check_field
from ..pixels import HW, floating
from ..rig import Pair
from ..sampling import sample
from .protocol import ReceptiveField, SamplingLocations, answered


@dataclass(frozen=True, eq=False)
class Moved:
    """Any field, for cameras that are not synchronised, evaluated where alpha's pixels are when beta records.

    `displacement` (2, H, W) says by how many pixels of alpha each of its pixels moves from alpha's exposure
    to beta's, in x and y, for instance by optical flow between alpha's own frames. It is interpolated
    bilinearly, and extended by the nearest pixel outside alpha's image. `Widened` allows for its error.
    """

    field: ReceptiveField
    displacement: Float[Tensor, "2 h w"]

    def __post_init__(self) -> None:
        check_field(self.field)
        if self.displacement.ndim != 3 or len(self.displacement) != 2:
            raise ValueError(
                f"displacement has shape {tuple(self.displacement.shape)}; wanted (2, height, width)"
            )

    def __call__(self, pair: Pair, x: Real[Tensor, "*n 2"]) -> SamplingLocations:
        """The field's sampling locations for the points where alpha's pixels x will be.

        Raises ValueError if alpha has another size than the displacement.
        """
        self.require(pair.alpha.hw)
        return answered(self.field, pair, self.points(x))

    def require(self, hw: HW) -> None:
        """Raise ValueError unless the displacement is of an alpha of this size."""
        if tuple(self.displacement.shape[1:]) != tuple(hw):
            (h, w), (height, width) = self.displacement.shape[1:], hw
            raise ValueError(
                f"displacement is of {w}x{h} pixels, alpha has {width}x{height}: give it at alpha's pixels"
            )

    def points(self, x: Real[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
        """Where alpha's pixels are when beta records."""
        x = floating(x)
        h, w = self.displacement.shape[-2:]
        inside = torch.minimum(x.clamp(min=0), x.new_tensor([w - 1, h - 1]))
        step = sample(self.displacement[None].to(x), inside.reshape(1, -1, 2)).values[0]
        return x + step.mT.reshape(x.shape)
