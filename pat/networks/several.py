"""Several betas of one scene: their matches agree on one inverse depth for each pixel of alpha.

What one beta cannot see another can. Each beta is matched alone; of the inverse depths that they propose for a pixel,
the one that most others support is taken, and where no match is consistent it is diffused. From it follow where the
pixel is in every beta, and, by a depth buffer, which betas see it.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import Segments, depth_from_track, pixel_grid
from arraygeom.epipolar import Track

from ..media.colour import to_bytes
from .protocol import Beta, Inputs
from .semi_global import CONSISTENT, DISPARITY_FILL, FINE, SemiGlobalMatches, along, enlarged, filled

SUPPORT = 1.5
"""A beta supports an inverse depth that is less than this many of its pixels from its own match."""
FARTHEST = 8.0
"""A difference of disparities of this many half-size pixels is 1 in the facts, as in semi-global matching."""


class MatchedBeta(NamedTuple):
    """One beta at alpha's pixels, (h, w): segments, tracks, matches and their facts."""

    segments: Segments
    track: Track
    disparity: Float[Tensor, "h w"]
    facts: Float[Tensor, "3 h w"]
    hw: tuple[int, int]

    @classmethod
    def of(cls, beta: Beta, found: SemiGlobalMatches) -> MatchedBeta:
        """Of a beta with a track, and its own matches."""
        pixels, disparity = beta.field.straight, found.disparity[0, 0]
        segments = Segments(pixels.start[0].double(), pixels.end[0].double(), pixels.valid[0])
        assert beta.track is not None
        track = beta.track(pixel_grid((disparity.shape[0], disparity.shape[1]), dtype=torch.float64))
        size = (beta.image.shape[-2], beta.image.shape[-1])
        facts = enlarged(found.facts)[0]
        return cls(segments, track, disparity.to(segments.end), facts.to(segments.end), size)

    @property
    def inverse_depth(self) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
        """Of the matches, and where these are consistent and have one."""
        found = depth_from_track(self.track, self.segments.end + self.disparity[..., None] * along(self.segments))
        known = found.valid & self.segments.valid & (self.facts[0] < CONSISTENT)
        return torch.where(known, 1 / torch.where(known, found.depth, 1.0), 0.0), known

    def disparity_of(self, inverse_depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
        """How far along its segment from the end the point of an inverse depth is, pixels; not clipped."""
        return ((self.track.at(inverse_depth) - self.segments.end) * along(self.segments)).sum(-1)

    def differs(self, inverse_depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
        """Pixels from the match to the point of an inverse depth."""
        return (self.disparity_of(inverse_depth) - self.disparity).abs()

    def hidden(self, inverse_depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
        """By how many pixels the nearest point seen at the same pixel of beta differs; infinite outside the image.

        By a depth buffer of half of beta's size: alpha's pixels leave no holes in it.
        """
        x = self.track.at(inverse_depth)
        rows, columns = (-(-n // FINE) for n in self.hw)
        column, row = ((x[..., i] + 0.5).div(FINE).floor().long() for i in range(2))
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows) & self.segments.valid
        index = torch.where(inside, row * columns + column, rows * columns).flatten()
        nearest = inverse_depth.new_zeros(rows * columns + 1)
        nearest = nearest.scatter_reduce(0, index, inverse_depth.flatten(), "amax")[index].view_as(inverse_depth)
        return torch.where(inside, self.disparity_of(nearest) - self.disparity_of(inverse_depth), torch.inf)


def can_agree(inputs: Inputs) -> bool:
    """Whether there are several betas, all calibrated and with straight fields, of one frame."""
    betas = inputs.betas
    one = len(inputs.alpha) == 1 and all(
        b.field.pixels is not None and b.field.pixels.valid.shape[0] == 1 for b in betas
    )
    return len(betas) > 1 and one and all(beta.track is not None for beta in betas)


def agreed(inputs: Inputs, found: tuple[SemiGlobalMatches, ...]) -> list[tuple[Tensor, Tensor]]:
    """`disparity` and `facts` (at half the size) of each beta, from the inverse depths on which the matches agree."""
    views = [MatchedBeta.of(beta, matches) for beta, matches in zip(inputs.betas, found)]
    inverse_depth, facts, known = _chosen(views)
    guide = to_bytes(inputs.alpha[0, 0])
    scale = max(float(inverse_depth.max()), 1e-9)
    plane = (inverse_depth / scale).cpu().numpy().astype(np.float32)
    certain = known.cpu().numpy()
    smooth = filled(plane[None], certain.astype(np.float32) + 1e-5, guide, DISPARITY_FILL)[0]
    median = cv2.medianBlur(np.where(certain, plane, smooth), 5)
    inverse_depth = torch.from_numpy(median).to(inverse_depth) * scale
    return [_of_view(view, inverse_depth, facts, known, inputs.alpha) for view in views]


def _of_view(
    view: MatchedBeta, inverse_depth: Tensor, facts: Tensor, known: Tensor, like: Tensor
) -> tuple[Float[Tensor, "1 1 h w"], Float[Tensor, "1 3 h2 w2"]]:
    disparity = view.disparity_of(inverse_depth).clamp(min=0).minimum(view.segments.length)
    unlike = (view.hidden(inverse_depth) / (FINE * FARTHEST)).clamp(0, 1)
    unlike = torch.where(known, unlike, 1.0)
    return disparity[None, None].to(like), avg_pool2d(torch.cat([unlike[None], facts])[None].to(like), FINE)


def _chosen(views: list[MatchedBeta]) -> tuple[Float[Tensor, "h w"], Float[Tensor, "2 h w"], Bool[Tensor, "h w"]]:
    """The inverse depth that is supported best, margin and cost of its matches, and where any match is consistent."""
    proposals = [view.inverse_depth for view in views]
    weights = torch.stack([known * (0.1 + view.facts[1]) for view, (_, known) in zip(views, proposals)])
    support = torch.stack([_supported(views, weights, w) for w, _ in proposals])  # proposal, beta, h, w
    total = torch.where(torch.stack([known for _, known in proposals]), support.sum(1), -1.0)
    best = total.argmax(0)[None, None].expand(1, *support.shape[1:])
    counts = support.gather(0, best)[0]
    precise = counts * torch.stack([view.segments.length.square() + 1 for view in views])
    depths = torch.stack([w for w, _ in proposals])
    inverse_depth = (precise * depths).sum(0) / precise.sum(0).clamp(min=1e-12)
    taken = counts > 0
    margin = torch.where(taken, torch.stack([v.facts[1] for v in views]), 0.0).amax(0)
    cost = torch.where(taken, torch.stack([v.facts[2] for v in views]), 1.0).amin(0)
    return inverse_depth, torch.stack([margin, cost]), taken.any(0)


def _supported(views: list[MatchedBeta], weights: Tensor, inverse_depth: Tensor) -> Float[Tensor, "betas h w"]:
    """The weights of the betas whose matches are near a proposed inverse depth."""
    return torch.stack([w * (view.differs(inverse_depth) < SUPPORT) for view, w in zip(views, weights)])
