"""The homography-based approximation of a calibrated pair."""

from __future__ import annotations

import dataclasses
from typing import Literal

from ..homography import fit_homography, fit_similarity
from ..pixels import coarse_grid
from ..rig import Link, Pair
from ..tracing import needs_numbers
from .straight import Epipolar


def approximated(pair: Pair, kind: Literal["homography", "similarity"] = "homography") -> Pair:
    """The pair with its exact F and the H that fits best to the middles of its depth-bounded segments.

    Least squares in pixels of beta, over the segments that beta's image holds of every 16th alpha pixel:
    what the paper calls the homography-based approximation. `HomographyDisplacement()` on the result takes
    the displacement that covers near to far. Differentiable. Raises ValueError for uncalibrated or batched
    pairs and where beta sees nothing between the bounds.
    """
    alpha, _ = pair.cameras
    if alpha.K.ndim > 2:
        raise ValueError("fitting works on one pair at a time: take one of the batch")
    x = coarse_grid(pair.alpha.hw).to(alpha.K)
    segments = Epipolar()(pair, x)
    valid = segments.valid
    needs_numbers("which pixels an approximation is fitted to", segments.start)
    if int(valid.sum()) < 4:
        raise ValueError(
            "beta sees next to nothing of alpha's image between near and far: nothing to fit a map to"
        )
    fit = fit_homography if kind == "homography" else fit_similarity
    H = fit(x[valid], (0.5 * (segments.start + segments.end))[valid])
    return dataclasses.replace(pair, link=Link(pair.fundamental, H))
