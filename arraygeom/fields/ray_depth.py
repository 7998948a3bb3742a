"""From positions in beta back to depth, for any cameras: along the curve that the pair's rays have in beta."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float, Real
from torch import Tensor

from ..chunks import chunked
from ..epipolar import Depth
from ..homography import TransformedPoints, apply_homography
from ..pixels import floating
from ..rig import Pair
from .curved import Curved, RayCurve
from .default import natural_bounds

ROWS = 1 << 12
"""Pixels that are searched at once."""
NODES, FINER = 65, 17
"""Points at which the curve is followed, and then again between the neighbours of the nearest."""


def ray_depth(
    pair: Pair,
    x: Real[Tensor, "n 2"],
    x_beta: Real[Tensor, "n 2"],
    bounds: Literal["depth", "distance"] = "depth",
) -> Depth:
    """Depth of what alpha's pixels see at beta's, or distance along the ray, within the pair's depth range.

    That of the nearest point of the curve on which beta sees the ray; its deviation is 0, as none is given. Raises
    ValueError for pairs that are not calibrated or have no depth range.
    """
    pair.cameras  # noqa: B018  (raises for an uncalibrated pair)
    near, far = pair.depth_range

    def of(x: Tensor, x_beta: Tensor) -> tuple[Tensor, ...]:
        curve = RayCurve.of(pair, near, far, x, bounds)
        low, high = torch.zeros_like(x[:, :1]), torch.ones_like(x[:, :1])
        for count in (NODES, FINER, FINER, FINER):
            fraction = torch.lerp(low, high, torch.linspace(0, 1, count).to(x))
            apart = _apart(curve, fraction, x_beta)
            best = apart.argmin(-1, keepdim=True)
            low, high = (fraction.gather(-1, (best + step).clamp(0, count - 1)) for step in (-1, 1))
        inverse = curve.inverse_depth(fraction.gather(-1, best))[:, 0]
        valid = curve.valid & apart.gather(-1, best)[:, 0].isfinite() & (inverse > 0)
        depth = torch.where(valid, 1 / torch.where(valid, inverse, 1.0), 0.0)
        return depth, torch.zeros_like(depth), valid

    return Depth(*chunked(of, floating(x), floating(x_beta), rows=ROWS, axis=0))


def rough_transfer(pair: Pair, x: Real[Tensor, "n 2"]) -> TransformedPoints:
    """Pixels of alpha in beta, roughly: by the pair's homography, or the middle of the curves of other cameras."""
    if pair.alpha.has_pinhole_view and pair.beta.has_pinhole_view:
        return apply_homography(pair.homography.detach().to(x), x)
    with torch.no_grad():
        found = Curved(3, bounds=natural_bounds(pair))(pair, x)
    return TransformedPoints(found.xy[:, 1], found.mask[:, 1])


def _apart(curve: RayCurve, fraction: Float[Tensor, "n l"], x_beta: Float[Tensor, "n 2"]) -> Float[Tensor, "n l"]:
    """Squared pixels from positions to the points at fractions, infinite where beta does not see these."""
    xy, seen = curve.at(fraction)
    return torch.where(seen, (xy - x_beta[:, None].to(xy)).square().sum(-1), torch.inf)
