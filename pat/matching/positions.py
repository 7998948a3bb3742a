"""Positions of matches: along search segments, from their far ends, and the bands of beta there."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Segments
from arraygeom.sampling import on_image, sample

FINE = 2
"""Factor by which images are reduced for matching."""


class Extent(NamedTuple):
    r"""Lengths and directions of segments.

    Attributes:
        length: lengths (*n), pixels.
        towards: unit vectors (x, y) from end to start (*n, 2); zero where a segment is a point.
    """

    length: Tensor
    towards: Tensor

    @classmethod
    def from_segments(cls, segments: Segments) -> Extent:
        """Compute the lengths and directions of segments."""
        length = segments.length
        return cls(length, (segments.start - segments.end) / torch.where(length > 0, length, 1.0)[..., None])


def reduced(segments: Segments, factor: int) -> Segments:
    """Return the same segments in pixels of a beta that is `factor` times smaller."""
    start, end = ((x + 0.5) / factor - 0.5 for x in (segments.start, segments.end))
    return Segments(start, end, segments.valid)


def match_positions(
    segments: Segments,
    disparity: Float[Tensor, "b 1 _ _"],
    *,
    beyond_edge: bool = False,
    extent: Extent | None = None,
) -> Float[Tensor, "b h w 2"]:
    """Compute the positions of matches in beta.

    Args:
        segments: segments (B or 1, H, W) of alpha's pixels.
        disparity: distance of the match from the segment's end, pixels of beta: (B, 1, H, W), or of half the
            size, and interpolated.
        beyond_edge: True to allow positions beyond the segments' starts; else they are moved onto the start.
        extent: extent of the segments; None to compute it.

    Returns:
        Positions (x, y) in beta's pixels, in the type of the segments, never beyond their ends; those of
        invalid segments mean nothing.
    """
    length, towards = extent or Extent.from_segments(segments)
    if disparity.shape[-2:] != length.shape[-2:]:
        disparity = interpolate(disparity, scale_factor=FINE, mode="bilinear")
    far = disparity[:, 0].to(length).clamp(min=0)
    return torch.addcmul(segments.end, (far if beyond_edge else far.minimum(length))[..., None], towards)


def at_matches(
    beta: Float[Tensor, "b c hb wb"],
    segments: Segments,
    disparity: Float[Tensor, "b 1 _ _"],
    extent: Extent | None = None,
) -> tuple[Float[Tensor, "b c h w"], Bool[Tensor, "b 1 h w"]]:
    """Sample beta bicubically at the matches, kept on their segments; beyond beta's edge, at the edge.

    Args:
        disparity: distance of the match from the segment's end, as for `match_positions`.
        extent: extent of the segments; None to compute it.

    Returns:
        Bands at alpha's pixels, and a mask of the matches that are on beta: False for invalid segments, whose
        bands mean nothing.
    """
    hw, middle = (
        (beta.shape[-2], beta.shape[-1]),
        match_positions(segments, disparity, extent=extent).to(beta),
    )
    position = middle.reshape(len(beta), -1, 2)
    inside = position.clamp(min=0).minimum(position.new_tensor([hw[1] - 1, hw[0] - 1]))
    values = sample(beta, inside, interpolation="bicubic").values
    return values.reshape(*beta.shape[:2], *middle.shape[1:3]), (segments.valid & on_image(middle, hw))[
        :, None
    ]


def normals(segments: Segments) -> Float[Tensor, "*n 2"]:
    """Compute unit vectors across the segments; zero where a segment is a point."""
    direction = Extent.from_segments(segments).towards
    return torch.stack([-direction[..., 1], direction[..., 0]], -1)


def enlarged(x: Tensor) -> Tensor:
    """Enlarge planes (*b, h, w) of half the size to full size: each value four times."""
    return x.repeat_interleave(FINE, -1).repeat_interleave(FINE, -2)
