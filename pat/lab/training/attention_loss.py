"""Attention loss supervised by geometry: weights along the segment classify the true position.

For an alpha pixel whose point beta sees between the samples l and l + 1 of its segment, a share u of the way,
the true weights are 1 - u at l and u at l + 1; where beta does not see it, equal ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Segments, sample
from pat.attention.scores import Compared, log_sum, mean_score

UNSEEN = 0.1
"""Weight of pixels that beta does not see, against 1 for visible ones. Not tuned."""
OFF = 1.5
"""Distance from the segment, in samples along or pixels across it, above which a true position is ignored."""


class Target(NamedTuple):
    """Samples around true positions, for each pixel of alpha.

    Attributes:
        first: position (x, y) of the sample before it, pixels of beta.
        second: position of the sample after it; the same for a segment of one sample.
        share: weight of the second, 0..1.
        on_segment: True if the true position is within `OFF` of the segment.
    """

    first: Float[Tensor, "b h w 2"]
    second: Float[Tensor, "b h w 2"]
    share: Float[Tensor, "b h w"]
    on_segment: Bool[Tensor, "b h w"]


def attention_loss(
    compared: Sequence[Compared],
    position: Sequence[Float[Tensor, "b h w 2"]],
    visible: Sequence[Bool[Tensor, "b h w"]],
    *,
    stride: int = 2,
) -> Tensor:
    """Compute the cross-entropy of the attention weights against the true positions, as a mean over betas.

    For each beta it is the mean over visible points plus `UNSEEN` times the mean over known points that beta
    does not see, there against equal weights. Pixels without a valid segment, and visible points off it
    (`OFF`) or off beta, do not count; a mean over none is 0.

    Args:
        compared: features and segments of each of one or more betas; a `border` is not applied.
        position: true positions (x, y) of all pixels of alpha, pixels of each beta; (0, 0) where unknown.
        visible: True where that beta sees the point.
        stride: only every `stride`-th row and column of alpha counts.

    Returns:
        A scalar, with gradient.

    Raises:
        ValueError: for a field of explicit positions, not segments.
    """
    sparse = (slice(None), slice(None, None, stride), slice(None, None, stride))
    losses = [
        _of_beta(one.strided(stride), where[sparse], mask[sparse])
        for one, where, mask in zip(compared, position, visible)
    ]
    return torch.stack(losses).mean()


def _of_beta(compared: Compared, position: Tensor, visible: Tensor) -> Tensor:
    target = target_of(compared.segments, compared.samples, position.to(compared.segments.start))
    valid, has_position = compared.segments.valid.expand_as(visible), (position != 0).any(-1)
    scores, inside = _true_scores(compared, target)
    total = log_sum(compared)
    visible_loss = _mean(total - scores, visible & valid & inside & target.on_segment)
    return visible_loss + UNSEEN * _mean(total - mean_score(compared), ~visible & valid & has_position)


def target_of(segments: Segments, samples: int, position: Float[Tensor, "b h w 2"]) -> Target:
    """Find the samples around true positions on segments.

    Args:
        segments: segments (b or 1, h, w) of alpha's pixels.
        samples: number of samples on each segment.
        position: true positions (x, y), pixels of beta.

    Returns:
        The targets, clamped to the segment; meaningless where it is not valid.
    """
    along = segments.end - segments.start
    squared = along.square().sum(-1).clamp(min=1e-12)
    share = ((position - segments.start) * along).sum(-1) / squared
    across = (position - segments.start - share[..., None] * along).norm(dim=-1)
    number = share * (samples - 1)
    on_segment = (across <= OFF) & (number >= -OFF) & (number <= samples - 1 + OFF)
    number = number.clamp(0, samples - 1)
    lower = number.floor().clamp(max=max(samples - 2, 0))

    def at(index: Tensor) -> Tensor:
        return segments.start + (index / max(samples - 1, 1))[..., None] * along

    return Target(at(lower), at((lower + 1).clamp(max=samples - 1)), number - lower, on_segment)


def _true_scores(compared: Compared, target: Target) -> tuple[Tensor, Tensor]:
    """Score at the true position (b, h, w), and True if both samples around it lie on beta."""
    query, key, how = compared.query, compared.key, compared.interpolation
    first, second = (sample(key, xy.to(key), interpolation=how) for xy in (target.first, target.second))
    share = target.share[:, None].to(key)
    return (query * ((1 - share) * first.values + share * second.values)).sum(1), first.valid & second.valid


def _mean(values: Tensor, where: Tensor) -> Tensor:
    """Mean over the pixels in a mask; 0 for none."""
    return torch.where(where, values, 0).sum() / where.sum().clamp(min=1)
