"""Quantities of C3 attention for losses, without its weights: log of the sum of exponentials, mean score, and
position of the largest weight.

Nothing is gathered: memory is that of the query, the key and one image of alpha's size. The weight of a
sample with the score s is exp(s - log_sum).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from arraygeom.segments import Segments

from . import reference, torch_op
from .attend import Interpolation, Locations, attend, attend_with_statistics, chosen_backend, sample_positions
from .reference import Attended, AttentionInputs

SHARPENED = 1e4
"""Factor of queries that gives nearly all weight to the largest score."""


class Compared(NamedTuple):
    """Features under comparison, in the form that `attend` takes.

    Attributes:
        query: (b, d, ha, wa).
        key: (b, d, hb, wb).
        value: (b, dv, hb, wb).
        locations: segments, or a function that returns locations.
        samples: samples of each segment.
        interpolation: "bilinear" or "nearest".
        border: pixels within which samples fade towards beta's border.
    """

    query: Tensor
    key: Tensor
    value: Tensor
    locations: Segments | Callable[[Tensor], Locations]
    samples: int
    interpolation: Interpolation
    border: float = 0.0

    def attended(self) -> Attended:
        """Compute C3 attention with its statistics."""
        return attend_with_statistics(
            *(self.query, self.key, self.value, self.locations),
            samples=self.samples,
            interpolation=self.interpolation,
            border=self.border,
        )

    @property
    def segments(self) -> Segments:
        """Locations as segments (b or 1, ha, wa).

        Raises:
            ValueError: for a function.
        """
        if not isinstance(self.locations, Segments):
            raise ValueError("a loss on attention needs straight segments: choose a straight field")
        return self.locations

    def strided(self, stride: int) -> Compared:
        """Keep every `stride`-th row and column of alpha, from the first on.

        Returns:
            The features with fewer queries and segments, views of these; all else is as it was.

        Raises:
            ValueError: for `locations` that are a function, or a stride below 1.
        """
        sparse = (..., slice(None, None, stride), slice(None, None, stride))
        start, end, valid = self.segments.start, self.segments.end, self.segments.valid
        few = Segments(start[(*sparse, slice(None))], end[(*sparse, slice(None))], valid[sparse])
        return self._replace(query=self.query[sparse], locations=few)


def log_sum(compared: Compared) -> Float[Tensor, "b ha wa"]:
    """Compute log sum_l exp(query . key(x_l)) over the samples that count; `border` is not applied.

    Returns:
        Log sums (b, ha, wa); meaningless where no sample counts. Differentiable once by query and key. If the
        segments require a gradient, or the device has no compiled backend, the formula is used, which gathers
        all keys, and is differentiable by segments too and any number of times.

    Raises:
        ValueError: for `locations` that are a function, and `locations` or a key that do not fit the query.
    """
    query, key, value, _, _, interpolation, _ = compared
    if query.shape[:2] != key.shape[:2]:
        shapes = f"query {tuple(query.shape)}, key {tuple(key.shape)}"
        raise ValueError(f"query and key must agree in batch and channels, got {shapes}")
    positions = sample_positions(compared.segments, query, compared.samples)
    nearest = interpolation == "nearest"
    compiled = chosen_backend("auto", query.device.type) != "reference"
    if torch_op.wants_gradient(positions.points) or not compiled:
        return reference.log_sum(AttentionInputs(query, key, value, positions, None, nearest))
    return _LogSum.apply(query, key, positions, nearest)


def mean_score(compared: Compared) -> Float[Tensor, "b ha wa"]:
    """Compute the mean score (query . key) of a pixel's samples that count; `border` is not applied.

    Returns:
        Scores (b, ha, wa), differentiable; 0 where no sample counts.
    """
    query, key, _, locations, samples, interpolation, _ = compared
    nothing = torch.zeros_like(query), torch.zeros_like(key)
    return (query * attend(*nothing, key, locations, samples=samples, interpolation=interpolation)).sum(1)


@torch.no_grad()
def peak_position(compared: Compared) -> Float[Tensor, "b 2 ha wa"]:
    """Compute the position of the largest weight, as the mean under a much sharper softmax.

    Scores are multiplied by `SHARPENED`; samples whose scores are nearly equal are averaged; `border` is not
    applied. Errors as `attend`.

    Returns:
        Positions (x, y) in beta's pixels, (b, 2, ha, wa), float32, without gradient; 0 where no sample
        counts.
    """
    query, key, _, locations, samples, interpolation, _ = compared
    sharp = query.float() * SHARPENED
    arguments = sharp, key.float(), key[:, :1].float(), locations
    return attend_with_statistics(*arguments, samples=samples, interpolation=interpolation).position


class _LogSum(Function):
    """Log of the sum of exponentials. Gradient by the query: the attended key; by the key: that of attended
    values for the query times upstream."""

    @staticmethod
    def forward(
        ctx: Any, query: Tensor, key: Tensor, positions: reference.SamplePositions, nearest: bool
    ) -> Tensor:
        ctx.inputs = AttentionInputs(query.detach(), key.detach(), key.detach(), positions, None, nearest)
        kernels = torch_op.compiled(chosen_backend("auto", query.device.type))
        value, statistics, total, best = kernels.forward(ctx.inputs, False)
        ctx.saved = statistics, total, best, value
        return total.clone()

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, Tensor, None, None]:
        inputs, (_, _, _, value) = ctx.inputs, ctx.saved
        weighted = upstream[:, None].to(inputs.query)
        cotangents = (weighted * inputs.query, upstream.new_zeros(0))
        kernels = torch_op.compiled(chosen_backend("auto", inputs.query.device.type))
        by_key = kernels.backward(inputs, ctx.saved, cotangents, [False, False, True, False, False])[2]
        return weighted * value, by_key, None, None
