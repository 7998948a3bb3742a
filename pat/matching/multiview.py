"""Several betas of one scene: their matches agree on one inverse depth for each pixel of alpha.

A point that one beta cannot see another can. Each beta is matched alone; of the inverse depths that they
propose for a pixel, the one that most others support is taken, and where no match is consistent it is
diffused. The pixel's positions in every beta follow from it, and, by a depth buffer, the betas that see it.
For the depth of the surface that alpha sees, the disparity chosen for each beta is proposed, and supports as
far as it is certain; for the origin of colours, the match in each. Colours of betas that stand in for each
other may be at their own matches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import Segments, depth_from_track, pixel_grid
from arraygeom.epipolar import FRONT, Track
from arraygeom.runtime.chunks import Tile, assembled, slices, spans

from ..media.colour import to_bytes
from ..media.filters import filled, numpy_of
from ..support.settings import size, tuned
from .inputs import CONSISTENT, FINE, Beta, BetaMatches, Extent, Inputs, Matches, at_matches, enlarged
from .normalisation import likeness
from .semi_global import DISPARITY_FILL


@dataclass(frozen=True)
class MultiviewSettings:
    """Settings of the agreement on depth of several betas.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    farthest: float = size(
        8.0, "Half-size pixels between disparities that are 1 in the facts, as in semi-global matching"
    )
    sampled_rows: int = size(32, "In how many pairs of alpha's rows the depths of betas are compared")
    sampled_columns: int = size(8, "Every how many columns the depths of betas are compared")
    trials: int = size(
        400, "Fits to four pixels each; that with which most agree is taken (Fischler, Bolles 1981)"
    )
    more: float = tuned(
        0.1,
        "Nine bands and rendered arrays: by how much the share of pixels that agree has to rise "
        "for betas' depths to be brought together: above that of the depths as they are, and above "
        "that of a plane, which is what wrong matches and a flat background agree with",
    )


SETTINGS = MultiviewSettings()
NEAR = CONSISTENT * SETTINGS.farthest
"""Distance in its pixels from a beta's own match within which it supports an inverse depth."""

STRIP = 1 << 16
"""Number of alpha's pixels compared at a time, in rows: intermediate results stay in a core's cache."""


class Ambiguity(NamedTuple):
    """Projective ambiguity between two betas' inverse depths of alpha's pixels.

    The inverse depth by one beta is `scale` times that by the other, plus the plane at alpha's pixel (x, y).
    The geometry of two views is known up to this from images alone (Hartley, Zisserman 2004, chapter 10), so
    cameras that were calibrated in pairs agree on depth only after it is applied.

    Attributes:
        scale: factor of the other's inverse depth.
        plane: coefficients of x, y and 1, for pixels of alpha.
    """

    scale: float
    plane: tuple[float, float, float]

    def applied(self, track: Track, x: Float[Tensor, "*n 2"]) -> Track:
        """Return a beta's tracks as functions of the other's inverse depth, of alpha's pixels `x`."""
        px, py, p = self.plane
        return Track(track.a + (px * x[..., :1] + py * x[..., 1:] + p) * track.b, self.scale * track.b)


NO_AMBIGUITY = Ambiguity(1.0, (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class MatchedBeta:
    """Matches of some rows of alpha's pixels (h, w) in one calibrated beta.

    Attributes:
        segments: search segments, pixels of beta.
        track: positions in beta by inverse depth in alpha (by a reference beta's, after an `Ambiguity`).
        disparity: matches, pixels of beta from the segments' ends.
        facts: left-right error, margin and cost of the matches, (3, h, w), as in `BetaMatches`.
        weight: weight with which a match votes for its inverse depth; 0 for none.
        hw: height and width of the beta.
    """

    segments: Segments
    track: Track
    disparity: Float[Tensor, "h w"]
    facts: Float[Tensor, "3 h w"]
    weight: Float[Tensor, "h w"]
    hw: tuple[int, int]

    @classmethod
    def from_matches(
        cls, beta: Beta, matches: BetaMatches, rows: tuple[int, int], ambiguity: Ambiguity = NO_AMBIGUITY
    ) -> MatchedBeta:
        """Read the matches in a beta, at some rows of alpha.

        Args:
            beta: a calibrated beta (its `track` is not None), in a field of straight segments.
            matches: its matches; the first of a batch. A chosen disparity is taken where there is one,
                weighted by its confidence (`certainty` is not None); else the match, weighted by its margin
                plus .1 where it passes the left-right check.
            rows: first row, and row after the last, both even.
            ambiguity: relation of its inverse depths to those of a reference beta.

        Returns:
            The matches at these rows, float64.

        Raises:
            AssertionError: without the track, or the certainty of a chosen disparity.
        """
        (top, bottom), pixels = rows, beta.field.straight
        half = slice(top // FINE, bottom // FINE)
        start, end = (x[0, top:bottom].double() for x in (pixels.start, pixels.end))
        assert beta.track is not None
        x = pixel_grid((bottom - top, end.shape[1]), dtype=torch.float64, device=end.device)
        x = x + end.new_tensor([0.0, top])
        size = (beta.image.shape[-2], beta.image.shape[-1])
        facts = enlarged(matches.facts[0, :, half])
        weight, disparity = (facts[0] < CONSISTENT) * (0.1 + facts[1]), matches.disparity
        if matches.chosen is not None:
            assert matches.certainty is not None
            weight, disparity = enlarged(matches.certainty[0, :1, half])[0], matches.chosen
        segments = Segments(start, end, pixels.valid[0, top:bottom])
        track = beta.track(x) if ambiguity == NO_AMBIGUITY else ambiguity.applied(beta.track(x), x)
        disparity = disparity[0, 0, top:bottom].to(end)
        return cls(segments, track, disparity, facts.to(end), weight.to(end), size)

    @cached_property
    def extent(self) -> Extent:
        """Lengths and directions of the segments."""
        return Extent.from_segments(self.segments)

    @cached_property
    def _end(self) -> Float[Tensor, "h w"]:
        """Distance of the segments' ends along their own directions from beta's first pixel."""
        (x, y), (u, v) = self.segments.end.unbind(-1), self.extent.towards.unbind(-1)
        return torch.addcmul(x * u, y, v)

    @property
    def inverse_depth(self) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
        """Inverse depths of the matches, and a mask of those that propose one."""
        x = self.segments.end + self.disparity[..., None] * self.extent.towards
        depth = depth_from_track(self.track, x)
        valid = depth.valid & self.segments.valid & (self.weight > 0)
        return torch.where(valid, 1 / torch.where(valid, depth.depth, 1.0), 0.0), valid

    def _seen(self, inverse_depth: Float[Tensor, "h w"]) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
        """Return beta's pixels as by `Track.at`, x and y apart, which takes a fraction of the time."""
        parts = zip(self.track.a.unbind(-1), self.track.b.unbind(-1))
        x, y, z = (torch.addcmul(p, inverse_depth, d) for p, d in parts)
        z = torch.where(z > FRONT, z, 1.0)
        return x / z, y / z

    def disparity_of(self, inverse_depth: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
        """Return the distance of a point from its segment's end by inverse depth, pixels; not clipped."""
        (x, y), (u, v) = self._seen(inverse_depth), self.extent.towards.unbind(-1)
        return torch.addcmul(x * u, y, v) - self._end

    def depth_buffer(self) -> Float[Tensor, " n"]:
        """Return an empty depth buffer: the nearest inverse depth at each pixel of half the size, by rows.

        Alpha's pixels leave no holes at that size. One more element is for points outside.
        """
        return self.disparity.new_zeros(math.prod(-(-n // FINE) for n in self.hw) + 1)

    def splat(self, inverse_depth: Float[Tensor, "h w"], buffer: Float[Tensor, " n"]) -> None:
        """Enter points into a depth buffer, in place."""
        buffer.scatter_reduce_(0, self._index(inverse_depth).flatten(), inverse_depth.flatten(), "amax")

    def distance_from_front(
        self, inverse_depth: Float[Tensor, "h w"], buffer: Float[Tensor, " n"]
    ) -> Float[Tensor, "h w"]:
        """Return the distance in pixels from the nearest point at beta's pixel; infinite off the image."""
        index = self._index(inverse_depth)
        (x, y), (u, v) = self._seen(buffer[index]), self._seen(inverse_depth)
        apart = torch.hypot(x - u, y - v)  # not along the segments: around a known depth they may be points
        return torch.where(index < len(buffer) - 1, apart, torch.inf)

    def _index(self, inverse_depth: Tensor) -> Tensor:
        rows, columns = (-(-n // FINE) for n in self.hw)
        column, row = ((x + 0.5).div_(FINE).floor_().long() for x in self._seen(inverse_depth))
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows) & self.segments.valid
        return torch.where(inside, row * columns + column, rows * columns)


class Agreement(NamedTuple):
    """Inverse depths on which the matches of all betas agree, at alpha's pixels.

    Attributes:
        inverse_depth: inverse depth in alpha (1, h, w), one over the rig's unit; 0 where not known.
        known: mask (1, h, w) of the pixels for which any match has a vote.
        facts: margin and cost (2, h / 2, w / 2), 0 to 1: the best of the matches that agree; 0 and 1 where
            none does.
    """

    inverse_depth: Tensor
    known: Tensor
    facts: Tensor

    @classmethod
    def from_views(cls, views: Sequence[MatchedBeta], like: Tensor) -> Agreement:
        """Compute the inverse depth with the most votes at each pixel.

        Each match proposes one; the mean of those near the best, by votes and precision, is taken.

        Args:
            views: matches in each beta, at the same rows.
            like: tensor whose type the result has.

        Returns:
            The inverse depths, and statistics of the matches that agree.
        """
        proposals = [view.inverse_depth for view in views]
        weights = torch.stack([valid * view.weight for view, (_, valid) in zip(views, proposals)])
        near = [[(v.disparity_of(w) - v.disparity).abs() < NEAR for v in views] for w, _ in proposals]
        support = torch.stack([weights * torch.stack(one) for one in near])  # proposal, beta, h, w
        total = torch.where(torch.stack([valid for _, valid in proposals]), support.sum(1), -1.0)
        best = total.argmax(0)[None, None].expand(1, *support.shape[1:])
        counts = support.gather(0, best)[0]
        precise = counts * torch.stack([view.extent.length.square() + 1 for view in views])
        depths = torch.stack([w for w, _ in proposals])
        inverse_depth = (precise * depths).sum(0) / precise.sum(0).clamp(min=1e-12)
        taken = counts > 0
        margin = torch.where(taken, torch.stack([v.facts[1] for v in views]), 0.0).amax(0)
        cost = torch.where(taken, torch.stack([v.facts[2] for v in views]), 1.0).amin(0)
        facts = avg_pool2d(torch.stack([margin, cost]), FINE)
        return cls(inverse_depth[None].to(like), taken.any(0)[None], facts.to(like))


@torch.no_grad()
def agreed(inputs: Inputs, matches: Matches) -> Matches:
    """Replace the matches in each beta by those at the inverse depths on which all betas agree.

    Occluded pixels are found with a z-buffer: the left-right error (`facts`) is the distance from the point
    in front, 1 where no match votes. `disparity` and `facts` are replaced; `chosen` too if it is known for
    every beta, by agreement of the chosen disparities, and is None otherwise.

    Args:
        inputs: inputs for which `can_agree` is True, which is not checked.
        matches: matches of each beta alone; with `certainty` if all have `chosen` (AssertionError without).

    Returns:
        The matches, consistent in all betas; what is replaced is detached.
    """
    of_betas = [replace(one, chosen=None) for one in matches.betas]
    between = ambiguities(inputs, of_betas)

    def views(of_betas: Sequence[BetaMatches]) -> list[Callable[[tuple[int, int]], MatchedBeta]]:
        given = zip(inputs.betas, of_betas)
        return [partial(MatchedBeta.from_matches, *one, ambiguity=same) for one, same in zip(given, between)]

    betas = _of_all(inputs, views(of_betas), of_betas)
    if all(one.chosen is not None for one in matches.betas):
        chosen = _of_all(inputs, views(matches.betas), of_betas)
        betas = (replace(one, chosen=other.disparity) for one, other in zip(betas, chosen))
    return Matches(tuple(betas))


@torch.no_grad()
def with_likeliest_colours(inputs: Inputs, own: Matches, agreed: Matches) -> Matches:
    """Choose where each beta's colours are taken: at its own match, or at the one on which all betas agree.

    The one at which beta is more similar to alpha is taken. This holds for betas for which `shows_all_bands`
    is True, whose colours can replace each other's; others keep the agreed match.

    Args:
        own: matches of each beta alone.
        agreed: matches on which all betas agree.

    Returns:
        The agreed matches; those in betas with all bands have a detached `disparity` where colours are taken,
        and the `facts` of the own matches.
    """
    betas = list(agreed.betas)
    for i, (one, found, same) in enumerate(zip(inputs.by_beta, own.betas, agreed.betas)):
        if inputs.shows_all_bands(inputs.betas[i]):
            betas[i] = replace(same, disparity=one.in_pieces(_likelier, found, same), facts=found.facts)
    return Matches(tuple(betas))


def _likelier(piece: Inputs, own: BetaMatches, agreed: BetaMatches) -> Float[Tensor, "b 1 h w"]:
    """Return, of a piece with one beta, each pixel's disparity at which beta is more similar to alpha."""
    (beta,) = piece.betas
    alpha, other, *_ = own.comparison.views(piece.alpha, beta.image)
    mine, theirs = (
        likeness(at_matches(other, beta.field.straight, one.disparity)[0] - alpha) for one in (own, agreed)
    )
    return torch.where(mine >= theirs, own.disparity, agreed.disparity)


def _of_all(
    inputs: Inputs, views: Sequence[Callable[[tuple[int, int]], MatchedBeta]], initial: Sequence[BetaMatches]
) -> Iterator[BetaMatches]:
    """Return the matches of each beta from the inverse depths on which `views`, by rows of alpha, agree."""
    height, width = inputs.hw
    strips = spans(height, max(STRIP // width // FINE, 1) * FINE)
    parts = [Agreement.from_views([at(rows) for at in views], inputs.alpha) for rows in strips]
    agreement = _dense(Agreement(*(torch.cat(planes, 1) for planes in zip(*parts))), inputs)
    del parts
    return (_of_beta(at, agreement, strips, one) for at, one in zip(views, initial))


def ambiguities(inputs: Inputs, of_betas: Sequence[BetaMatches]) -> list[Ambiguity]:
    """Estimate the projective ambiguity of each beta against the one with the most informative matches.

    Returns:
        One per beta, in order; `NO_AMBIGUITY` for that one, and unless clearly more pixels agree by another.
    """
    step = max(inputs.hw[0] // SETTINGS.sampled_rows // FINE, 1) * FINE
    rows = [(top, top + FINE) for top in range(0, inputs.hw[0], step)]
    sampled = [_Sampled.from_matches(inputs.betas[i], of_betas[i], rows) for i in range(len(of_betas))]
    reference = max(sampled, key=lambda one: float((one.known * one.pixels_per_w).sum()))
    columns = torch.arange(0, inputs.hw[1], SETTINGS.sampled_columns).to(reference.w)
    sampled_rows = reference.w.new_tensor([row for pair in rows for row in range(*pair)])
    y, x = torch.meshgrid(sampled_rows, columns, indexing="ij")
    return [NO_AMBIGUITY if one is reference else one.against(reference, x, y) for one in sampled]


class _Sampled(NamedTuple):
    """Inverse depths of a beta's matches at some of alpha's pixels.

    With a mask of the known ones, and beta's pixels by which a point moves per unit of inverse depth.
    """

    w: Tensor
    known: Tensor
    pixels_per_w: Tensor

    @classmethod
    def from_matches(cls, beta: Beta, matches: BetaMatches, rows: Sequence[tuple[int, int]]) -> _Sampled:
        parts = []
        for pair in rows:
            view = MatchedBeta.from_matches(beta, matches, pair)
            w, valid = view.inverse_depth
            little = 1e-3 * w + 1e-9
            rise = (view.disparity_of(w + little) - view.disparity_of(w)).abs() / little
            parts.append([plane[:, :: SETTINGS.sampled_columns] for plane in (w, valid, rise)])
        return cls(*(torch.cat(planes) for planes in zip(*parts)))

    def against(self, other: _Sampled, x: Tensor, y: Tensor) -> Ambiguity:
        """Return the ambiguity with which most of these inverse depths agree with another beta's: `scale`
        times the other's, plus the plane.

        Args:
            x: columns of alpha's sampled pixels, of the planes' shape; `y` are their rows.

        Returns:
            The ambiguity; `NO_AMBIGUITY` if few pixels are known in both, and unless its scale is above 0 and
            clearly more agree than without it or with a plane alone.
        """
        both = self.known & other.known
        measured, w, rise, x, y = (plane[both] for plane in (self.w, other.w, self.pixels_per_w, x, y))
        if len(measured) < SETTINGS.sampled_rows:
            return NO_AMBIGUITY
        terms = torch.stack([w, x, y, torch.ones_like(x)], -1)

        def share(solution: Tensor) -> float:
            return float(_agree(terms, measured, rise, solution[:, None]).mean())

        best, flat = _most_agreed(terms, measured, rise), _most_agreed(terms[:, 1:], measured, rise)
        without = max(
            share(torch.eye(4)[0].to(measured)), share(torch.cat([torch.zeros_like(flat[:1]), flat]))
        )
        if best[0] <= 0 or share(best) < without + SETTINGS.more:
            return NO_AMBIGUITY
        scale, *plane = best.tolist()
        return Ambiguity(scale, (plane[0], plane[1], plane[2]))


def _most_agreed(
    terms: Float[Tensor, "n k"], measured: Float[Tensor, " n"], rise: Tensor
) -> Float[Tensor, " k"]:
    """Return the factors of the terms with which most measured values agree, by least squares of these."""
    n, k = terms.shape
    size = terms.abs().amax(0).clamp(min=1e-12)
    scaled = terms / size
    some = torch.randint(n, (SETTINGS.trials, k), generator=torch.Generator().manual_seed(0)).to(
        measured.device
    )
    trials, _ = torch.linalg.solve_ex(scaled[some], measured[some])
    trials = torch.where(trials.isfinite().all(1, keepdim=True), trials, 0.0).T
    best = trials[:, _agree(scaled, measured, rise, trials).sum(0).argmax()][:, None]
    for _ in range(3):
        weight = rise[:, None] * _agree(scaled, measured, rise, best)
        best = torch.linalg.lstsq(scaled * weight, measured[:, None] * weight).solution
    return best[:, 0] / size


def _agree(
    terms: Tensor, measured: Tensor, rise: Tensor, solutions: Float[Tensor, "k m"]
) -> Float[Tensor, "n m"]:
    """Return 1 where a solution is less than `NEAR` pixels from the measured value."""
    return ((terms @ solutions - measured[:, None]).abs() * rise[:, None] < NEAR).to(measured)


def _dense(agreement: Agreement, inputs: Inputs) -> Agreement:
    """Diffuse inverse depth to where no match is consistent, and remove outliers."""
    guide = to_bytes(inputs.alpha[0, 0])
    plane, valid = numpy_of(agreement.inverse_depth), agreement.known.cpu().numpy()

    def of(tile: Tile) -> Tensor:
        index = (..., *slices(tile.outer))
        weight = valid[0][index].astype(np.float32) + 1e-5
        smooth = filled(plane[index], weight, guide[index], DISPARITY_FILL)
        median = cv2.medianBlur(np.where(valid[index], plane[index], smooth)[0], 5)
        return torch.from_numpy(median)[None].to(inputs.alpha)

    tiles = ((tile, of(tile)) for tile in inputs.pieces)
    return agreement._replace(inverse_depth=assembled(inputs.hw, tiles))


def _of_beta(
    view_of: Callable[[tuple[int, int]], MatchedBeta],
    agreement: Agreement,
    strips: list[tuple[int, int]],
    initial: BetaMatches,
) -> BetaMatches:
    """Return the matches of the beta whose rows `view_of` returns."""
    buffer = view_of(strips[0]).depth_buffer()
    for top, bottom in strips:
        view_of((top, bottom)).splat(agreement.inverse_depth[0, top:bottom].to(buffer), buffer)
    disparity, facts = torch.empty_like(initial.disparity), torch.empty_like(initial.facts)
    for top, bottom in strips:
        view, half = view_of((top, bottom)), slice(top // FINE, bottom // FINE)
        inverse_depth = agreement.inverse_depth[0, top:bottom].to(buffer)
        there = view.disparity_of(inverse_depth).clamp(min=0)
        disparity[0, 0, top:bottom] = there.minimum(view.extent.length)
        unlike = (view.distance_from_front(inverse_depth, buffer) / (FINE * SETTINGS.farthest)).clamp(0, 1)
        unlike = torch.where(agreement.known[0, top:bottom], unlike, 1.0)
        facts[0, :1, half] = avg_pool2d(unlike[None], FINE)
        facts[0, 1:, half] = agreement.facts[:, half]
    return replace(initial, disparity=disparity, facts=facts)
