"""Depth from positions in beta, for any cameras: along the curve that the pair's rays have in beta."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float, Real
from torch import Tensor

from ..epipolar import Depth
from ..homography import TransformedPoints, apply_homography
from ..pair import Pair
from ..pixels import floating
from ..runtime.chunks import chunked
from .curved import Curved, RayCurve
from .default import natural_bounds

ROWS = 1 << 12
"""Number of pixels that are searched at once."""
NODES, FINER = 65, 17
"""Number of points at which the curve is followed, and then again between the neighbours of the nearest."""
PART = 0.005
"""Share of the curve, to either side, over which differences are taken."""


def ray_depth(
    pair: Pair,
    x: Real[Tensor, "n 2"],
    x_beta: Real[Tensor, "n 2"],
    bounds: Literal["depth", "distance"] = "depth",
    *,
    deviation: Float[Tensor, " n"] | None = None,
) -> Depth:
    """Compute the depth, or distance along the ray, of matched pixels, within the pair's depth range.

    It is the depth of the point of alpha's ray whose image is nearest to the position in beta, through any
    lenses, however far off the position is.

    Args:
        pair: one pair, not a batch.
        x: pixels of alpha.
        x_beta: positions in beta.
        bounds: "depth" along alpha's axis or "distance" along the ray, also of the pair's depth range.
        deviation: standard deviation of x_beta along the curve, pixels; None for 0.

    Returns:
        Depth in the rig's unit (metres) with its standard deviation to first order and validity. Not valid,
        and 0, are NaN and infinite positions, rays that beta does not see within the range, and infinite
        depths.

    Raises:
        ValueError: for pairs without a depth range, other `bounds`, and as `Pair.beta_from_alpha`.
    """
    pair.cameras  # noqa: B018  (raises for an uncalibrated pair)
    near, far = pair.depth_range

    def of(x: Tensor, x_beta: Tensor, deviation: Tensor) -> tuple[Tensor, ...]:
        finite = x.isfinite().all(-1) & x_beta.isfinite().all(-1)
        x, x_beta = (torch.where(finite[:, None], p, 0.0) for p in (x, x_beta))
        curve = RayCurve.from_pixels(pair, near, far, x, bounds)
        fraction = curve.nodes(NODES)
        for finer in (FINER, FINER, FINER, 0):
            apart, last = _apart(curve, fraction, x_beta), fraction.shape[-1] - 1
            best = apart.argmin(-1, keepdim=True)
            low, high = (fraction.gather(-1, (best + step).clamp(0, last)) for step in (-1, 1))
            if finer:
                fraction = torch.lerp(low, high, torch.linspace(0, 1, finer).to(x))
        there = _nearest(curve, fraction.gather(-1, best).detach(), x_beta)
        inverse = curve.inverse_depth(there)[:, 0]
        valid = finite & curve.valid & apart.gather(-1, best)[:, 0].isfinite() & (inverse > 0)
        depth = torch.where(valid, 1 / torch.where(valid, inverse, 1.0), 0.0)
        return (
            depth,
            torch.where(valid, deviation * _inverse_depth_per_pixel(curve, there), 0.0) * depth.square(),
            valid,
        )

    x = floating(x)
    sigma = torch.zeros_like(x[:, 0]) if deviation is None else deviation.to(x)
    return Depth(*chunked(of, x, floating(x_beta), sigma, rows=ROWS, axis=0))


def _nearest(
    curve: RayCurve, fraction: Float[Tensor, "n 1"], x_beta: Float[Tensor, "n 2"]
) -> Float[Tensor, "n 1"]:
    """Return the fraction one Gauss-Newton step nearer to positions, through which gradients flow."""
    with torch.no_grad():
        ends = torch.cat([(fraction + step).clamp(0, 1) for step in (-PART, PART)], -1)
        along = curve.at(ends)[0].diff(dim=-2)[:, 0] / ends.diff(dim=-1)
        squared = along.square().sum(-1, keepdim=True)
        moves = squared.isfinite() & (squared > 1e-12)
    off = ((x_beta.to(fraction) - curve.at(fraction)[0][:, 0]) * along).sum(-1, keepdim=True)
    step = torch.where(moves, off, 0.0) / torch.where(moves, squared, 1.0)
    return (fraction + step.clamp(-PART, PART)).clamp(0, 1)


def _inverse_depth_per_pixel(curve: RayCurve, fraction: Float[Tensor, "n 1"]) -> Float[Tensor, " n"]:
    """Compute the inverse depth per pixel of beta along the curve, by differences over a part of it."""
    ends = torch.cat([(fraction + step).clamp(0, 1) for step in (-PART, PART)], -1)
    xy, _ = curve.at(ends)
    pixels = (xy[:, 1] - xy[:, 0]).norm(dim=-1)
    return curve.inverse_depth(ends).diff(dim=-1)[:, 0].abs() / pixels.clamp(min=1e-6)


def rough_transfer(pair: Pair, x: Real[Tensor, "n 2"]) -> TransformedPoints:
    """Map pixels of alpha roughly to beta: by the pair's homography as if there were no lenses, or to the
    middles of their curves if a view has no pinhole view.

    Returns:
        Positions in beta's pixels, without gradient to the pair, with their validity; 0 where not valid.
        Those by the homography may be off beta's image.

    Raises:
        ValueError: as `Curved` where curves are needed, else as `Pair.homography`.
    """
    if pair.alpha.has_pinhole_view and pair.beta.has_pinhole_view:
        return apply_homography(pair.homography.detach().to(x), x)
    with torch.no_grad():
        locations = Curved(3, bounds=natural_bounds(pair))(pair, x)
    return TransformedPoints(locations.xy[:, 1], locations.mask[:, 1])


def _apart(
    curve: RayCurve, fraction: Float[Tensor, "n l"], x_beta: Float[Tensor, "n 2"]
) -> Float[Tensor, "n l"]:
    """Return squared pixels from positions to the points at fractions; infinite where beta sees none."""
    xy, visible = curve.at(fraction)
    return torch.where(visible, (xy - x_beta[:, None].to(xy)).square().sum(-1), torch.inf)
