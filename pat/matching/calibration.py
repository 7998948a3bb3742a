"""What a confidence means: the probability that a match is right, and how far from it the true one may be.

A network's confidence orders its matches; how often those of some confidence are right is measured on pairs
with true disparity, by isotonic regression (Zadrozny and Elkan 2002): a map that rises and assumes nothing
else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression
from torch import Tensor

SHARE = 0.9
"""Of true positions that an interval is to cover."""
KNOTS = 33
"""Confidences at which a calibration is known, quantiles of those it was fitted to. *size*"""
BINS = 15
"""Bins of probability by which the calibration error is measured, as is usual (Guo et al. 2017)."""


@dataclass(frozen=True)
class ConfidenceCalibration:
    """At rising confidences: the probability that the match is right, and the half-width of the interval
    (pixels of alpha) in which the true position is in 9 of 10 cases."""

    confidence: tuple[float, ...]
    probability: tuple[float, ...]
    half_width: tuple[float, ...]

    def __post_init__(self) -> None:
        columns = self.confidence, self.probability, self.half_width
        if len({len(column) for column in columns}) != 1 or len(self.confidence) < 2:
            lengths = [*map(len, columns)]
            raise ValueError(f"a calibration has three lists of one length, 2 or more, got {lengths}")
        if any(b <= a for a, b in zip(self.confidence, self.confidence[1:])):
            raise ValueError("the confidences of a calibration must rise: fit it again")

    def probabilities(self, confidence: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The probability that each match is within a pixel of the point that alpha sees."""
        return self._between(confidence, self.probability)

    def half_widths(self, confidence: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Pixels to either side of each match within which the true position is in 9 of 10 cases."""
        return self._between(confidence, self.half_width)

    def _between(self, confidence: Tensor, column: Sequence[float]) -> Tensor:
        """Linear between the knots, constant beyond them."""
        found = np.interp(confidence.detach().cpu().double().numpy(), self.confidence, column)
        return torch.from_numpy(np.asarray(found)).to(confidence)


def fit_calibration(
    confidence: Float[Tensor, " n"],
    error: Float[Tensor, " n"],
    same: Bool[Tensor, " n"],
    *,
    within: float = 1.0,
) -> ConfidenceCalibration:
    """The calibration of matches whose error (pixels of alpha) is known; `same`: beta sees the point at all.

    A match is right if it is `within` a pixel and of the same point. Raises ValueError for fewer than two
    confidences.
    """
    c, e = (x.detach().cpu().double().numpy() for x in (confidence, error))
    edges = np.unique(np.quantile(c, np.linspace(0, 1, KNOTS + 1)))
    if len(edges) < 2:
        raise ValueError("a calibration needs matches of different confidence: give more pixels")
    which = np.clip(np.searchsorted(edges, c, side="right") - 1, 0, len(edges) - 2)
    right = same.cpu().numpy() & (e <= within)
    bins = [which == i for i in range(len(edges) - 1) if (which == i).any()]
    count = np.array([b.sum() for b in bins], float)
    rate = np.array([right[b].mean() for b in bins])
    width = np.array([np.quantile(e[b], SHARE) for b in bins])
    middle = np.array([c[b].mean() for b in bins])
    rising = isotonic_regression(rate, weights=count).x
    falling = isotonic_regression(width, weights=count, increasing=False).x
    return ConfidenceCalibration(*(tuple(x.tolist()) for x in _distinct(middle, rising, falling)))


def _distinct(confidence: NDArray, *columns: NDArray) -> tuple[NDArray, ...]:
    """The knots whose confidence is more than that of the one before; two at least."""
    kept = np.concatenate([[True], np.diff(confidence) > 1e-9])
    if kept.sum() < 2:
        raise ValueError("a calibration needs matches of different confidence: give more pixels")
    return tuple(column[kept] for column in (confidence, *columns))


class Reliability(NamedTuple):
    """By bins of stated probability: its mean, the share that is right, and the share of matches in the
    bin."""

    stated: Float[Tensor, " bins"]
    right: Float[Tensor, " bins"]
    share: Float[Tensor, " bins"]

    @property
    def error(self) -> float:
        """The expected calibration error: the mean difference of what is stated and what is right."""
        return float(((self.stated - self.right).abs() * self.share).sum())


def reliability(
    probability: Float[Tensor, " n"],
    right: Bool[Tensor, " n"],
    *,
    bins: int = BINS,
) -> Reliability:
    """How often matches are right, by the probability stated for them."""
    which = (probability * bins).long().clamp(0, bins - 1)
    count = torch.bincount(which, minlength=bins).double()
    sums = (torch.bincount(which, x.double(), minlength=bins) for x in (probability, right))
    return Reliability(*(total / count.clamp(min=1) for total in sums), count / count.sum())


def depth_interval(
    depth: Float[Tensor, "*n"], parallax: Float[Tensor, "*n"], half_width: Float[Tensor, "*n"]
) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"]]:
    """The nearest and farthest depth (metres) of points so many pixels from a match. Farthest is infinite
    where the interval reaches beyond it.

    parallax: pixels that a point moves in beta for each 1 / metre of inverse depth. A rectified pair with a
    focal length of 500 px and a baseline of .1 m has 50: at 5 m the disparity is 10 px, and a pixel more or
    less means 4.545 to 5.556 m.
    """
    inverse, step = 1 / depth, half_width / parallax
    far = inverse - step
    return 1 / (inverse + step), torch.where(far > 0, 1 / far.clamp(min=1e-12), torch.inf)
