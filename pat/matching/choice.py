"""Choice of a pixel's disparity, that matched there or one of a pixel beside it; and its confidence.

Semi-global matching is wrong beside edges of depth, in regions that beta does not see, and where there is no
texture; and nearly always the right disparity is that of a pixel not far off. So each pixel has candidates:
its own, those of pixels around it at fixed distances, and the nearest consistent ones in its row and its
column. A U-Net computes their scores from alpha, the results of matching, and the similarity of alpha and
beta at each. It was trained on matches of pairs with true disparity (`experiments.choice`), all with alpha on
the left: there surfaces hide points of beta to their left. Elsewhere planes are turned first, so that it is
to their left, too.

Confidence is the probability of a match, and the likely distance of the true position from it. A small
network, fitted to pairs with true disparity (`python -m experiments certainty`), computes both from the
results of matching at a pixel and around it, the statements of the choice, the differences of disparities,
the blur by which one image had to be made comparable, and the pair's consistent matches. It uses nothing of
the image but by the choice, so it holds for any network that uses the matches.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, pad, pixel_shuffle

from arraygeom import Segments
from arraygeom.runtime.chunks import ROWS, Tile, assembled, spans, tiles_of
from arraygeom.runtime.threads import in_parallel

from ..media.filters import box_mean, nearest_known, numpy_of
from ..support.blocks import UNet
from ..support.convolutions import convolutions_in_parallel
from ..support.settings import size
from ..support.tensor_files import with_weights
from . import kernels
from .inputs import CONSISTENT, FINE, BetaMatches, Extent, Inputs, Matches, enlarged
from .normalisation import ComparedViews


@dataclass(frozen=True)
class ChoiceSettings:
    """Settings of the candidate disparities of a pixel, of the network that scores them, and of confidence.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    around: tuple[int, ...] = size((2, 5, 10), "Distances, in pixels, of those around a pixel")
    scales: tuple[float, float] = size(
        (6.0, 1 / 6), "Differences of disparity, pixels, and of brightness that count as a half"
    )
    widths: tuple[int, int, int] = size((32, 48, 64), "Channels at 1/2, 1/4 and 1/8 of the size")
    multiple: int = size(8, "Images are padded to multiples of this")
    blur: float = size(6.375, "A blur, in pixels, of this counts as 1")
    averaged: tuple[int, int] = size((2, 6), "Radii, at half the size, in which facts are averaged")
    apart: tuple[int, int] = size((1, 4), "Radii, at full size, in which disparities are compared")
    width: int = size(16, "Numbers in each of the confidence network's two hidden layers")
    least: float = size(1e-3, "The least probability where a segment is: what is chosen there gives depth")
    covered: float = size(0.9, "The share of true positions that an interval is to cover")


SETTINGS = ChoiceSettings()
AROUND = [(s * y, s * x) for s in SETTINGS.around for y, x in ((0, 1), (0, -1), (1, 0), (-1, 0))]
CANDIDATES = 1 + 4 + len(AROUND)
STRIP = 16
"""Size: number of rows, at half the size, that a thread compares at a time."""
FACTS = 7
"""Number of facts at half the size: of matching (3), typical of the pair (2), and its views' blurs (2)."""


class Choice(nn.Module):
    """U-Net that scores a pixel's candidate disparities; a new one is not trained.

    From `features` it computes planes (B, `CANDIDATES` + 2, 4, h2, w2), 2 x 2 pixels row by row: a score for
    each candidate, the logit of the probability that beta sees the point and the best one is right to a
    pixel, and the natural logarithm of an error, pixels of beta, that 9 of 10 of those do not exceed.

    Args:
        widths: three numbers, channels at 1/2, 1/4 and 1/8 of alpha's size.
    """

    def __init__(self, widths: tuple[int, ...] = SETTINGS.widths) -> None:
        super().__init__()
        self.unet = UNet(FACTS + 4 * (1 + 2 * CANDIDATES), widths, 4 * (CANDIDATES + 2))
        nn.init.zeros_(self.unet.last.weight)

    def forward(self, inputs: Float[Tensor, "b i h2 w2"]) -> Float[Tensor, "b n 4 h2 w2"]:
        """Compute scores, logit and logarithm of the error from `features`, for 2 x 2 pixels at a time."""
        return self.unet(inputs).unflatten(1, (CANDIDATES + 2, FINE * FINE))


@cache
def fitted_choice() -> Choice:
    """Return the network that ships, loaded once."""
    return with_weights(Choice(), Path(__file__).with_name("choice.safetensors"))


@torch.no_grad()
def chosen(inputs: Inputs, matches: Matches, network: Choice | None = None) -> Matches:
    """Choose each pixel's candidate disparity of the highest score, in each beta.

    Where each segment is around a known depth of its own pixel (`Beta.around`), candidates from other pixels
    mean nothing: there `chosen` is None, and only `stated` is estimated.

    Args:
        network: network that scores the candidates; None for the one that ships.

    Returns:
        The matches with detached `chosen` and `stated`, else as given.

    Raises:
        ValueError: for a beta whose field is not of straight segments.
    """
    best = network or fitted_choice()
    return Matches(tuple(_chosen(*one, best) for one in zip(inputs.by_beta, matches.betas)))


def _chosen(inputs: Inputs, matches: BetaMatches, network: Choice) -> BetaMatches:
    """Choose the candidate of the highest score at each pixel, in pieces."""
    typical = typical_facts(matches)
    weight = network.unet.last.weight
    if (weight.dtype, weight.device) != (matches.facts.dtype, matches.facts.device):
        network = deepcopy(network).to(matches.facts)  # another thread may need it as it is

    def of(piece: Inputs, of_piece: BetaMatches) -> tuple[Tensor, ...]:
        (beta,), segments = piece.betas, piece.betas[0].field.straight
        views, turns = matches.comparison.views(piece.alpha, beta.image), quarter_turns(segments)
        first, *others = turns[segments.valid].unique().tolist() or [0]
        made = _answered(first, views, segments, of_piece, typical, network)
        for k in others:
            answer, there = _answered(k, views, segments, of_piece, typical, network), (turns != k)[:, None]
            made = made[0].where(there, answer[0]), made[1].where(there[..., ::FINE, ::FINE], answer[1])
            del answer
        return made

    disparity, stated = inputs.in_pieces(of, replace(matches, colours=None, certainty=None))
    return replace(matches, chosen=None if inputs.betas[0].around else disparity, stated=stated)


def _answered(
    k: int, views: ComparedViews, segments: Segments, matches: BetaMatches, typical: Tensor, network: Choice
) -> tuple[Float[Tensor, "b 1 h w"], Float[Tensor, "b 2 h2 w2"]]:
    """Return the disparity chosen, and the statements about it, all turned for the network and back."""

    def turned(x: Tensor, by: int = k, sides: tuple[int, int] = (-2, -1)) -> Tensor:
        return x.rot90(by, sides) if k else x  # turned by nothing it would be a copy

    one = replace(matches, disparity=turned(matches.disparity), facts=turned(matches.facts))
    (h, w), ends = one.hw, (segments.start, segments.end, segments.valid)
    with convolutions_in_parallel():
        planes = features(
            views._replace(alpha=turned(views.alpha)),
            Segments(*(turned(x, sides=(1, 2)) for x in ends)),
            one,
            candidates(one),
            typical,
        )
        answer = network(planes)
        del planes  # most of the memory; candidates are made twice for the same reason
        scores, stated = answer.split([CANDIDATES, 2], 1)
        best = pixel_shuffle(scores.max(1).indices.float(), FINE)[..., :h, :w].long()
    chosen, stated = candidates(one).gather(1, best), stated.mean(2)[..., : h // FINE, : w // FINE]
    return turned(chosen, -k), turned(stated, -k)


def quarter_turns(segments: Segments) -> Int[Tensor, "b h w"]:
    """Compute the quarter turns (`Tensor.rot90`), 0 to 3, that bring a segment's start left of its end.

    That is the order of rectified views whose alpha is on the left.
    """
    x, y = Extent.from_segments(segments).towards.unbind(-1)
    return (torch.atan2(0 - y, 0 - x) / (math.pi / 2)).round().to(torch.int8) % 4  # not -0: points are 0


def candidates(matches: BetaMatches) -> Float[Tensor, "b n h w"]:
    """Compute the disparities of each pixel's candidates; the first is its own."""
    disparity = matches.disparity
    consistent = enlarged(matches.facts[:, :1] < CONSISTENT)
    along = [nearest_known(disparity, consistent, axis, back) for axis in (-2, -1) for back in (False, True)]
    (h, w), most = disparity.shape[-2:], max(SETTINGS.around)
    wide = pad(disparity, (most,) * 4, mode="replicate")
    beside = [wide[..., most + y : most + y + h, most + x : most + x + w] for y, x in AROUND]
    return torch.cat([disparity, *along, *beside], 1)


def features(
    views: ComparedViews,
    segments: Segments,
    matches: BetaMatches,
    options: Float[Tensor, "b n h w"],
    typical: Float[Tensor, "b 2"],
) -> Float[Tensor, "b i h2 w2"]:
    """Compute the choice network's inputs; sides are padded to multiples of `SETTINGS.multiple` alpha pixels.

    Args:
        views: alpha and beta, equally bright and sharp.
        segments: segments of alpha's pixels.
        matches: semi-global matches.
        options: disparities of the `CANDIDATES`, pixels of beta.
        typical: `typical_facts` of the whole frame.

    Returns:
        Channels at half the size: the `FACTS`, then the numbers of `kernels.compared`, four for the 2 x
        2 pixels of each plane.
    """
    extent, (h, w) = Extent.from_segments(segments), options.shape[-2:]
    half = _at_half(matches, typical)
    sides = [-(-n // SETTINGS.multiple) * SETTINGS.multiple // FINE for n in (h, w)]
    stacked_planes = torch.empty(len(options), *sides, FACTS + 4 * (1 + 2 * CANDIDATES))
    padded = pad(half, (0, sides[1] - half.shape[-1], 0, sides[0] - half.shape[-2]), mode="replicate")
    stacked_planes[..., :FACTS] = padded.movedim(1, -1)
    for i, image in enumerate(stacked_planes):
        one = min(i, len(segments.end) - 1)
        parts = views.alpha[i, 0], views.beta[i, 0], segments.end[one], extent.towards[one], options[i]
        alpha, beta, end, towards, each = map(numpy_of, parts)
        tasks = []
        for top, bottom in spans(sides[0], STRIP):
            rows, out = slice(FINE * top, FINE * bottom), image[top:bottom, :, FACTS:].numpy()
            planes = alpha[rows], beta, end[rows], towards[rows], each[:, rows]
            tasks.append(partial(kernels.compared, *planes, SETTINGS.scales, out))
        in_parallel(tasks)
    return stacked_planes.movedim(-1, 1).to(views.alpha)


def _at_half(matches: BetaMatches, typical: Tensor) -> Float[Tensor, "b 7 h2 w2"]:
    """Return the `FACTS` of each pixel, about -.4 to .6."""
    blurs = torch.tensor(matches.comparison.whole.blurs).T.to(typical) / SETTINGS.blur
    same = torch.cat([typical, blurs], 1)[..., None, None].expand(-1, -1, *matches.facts.shape[-2:])
    return torch.cat([matches.facts, same], 1) - 0.4


MEASURED = 3 * (1 + len(SETTINGS.averaged)) + len(SETTINGS.apart) + 4 + 2
"""Number of inputs of a pixel."""


class CertaintyNetwork(nn.Sequential):
    """Network of a match's confidence, from the `measured` numbers of its pixel; a new one is not trained.

    It takes them in the last axis, (..., `MEASURED`), and returns two (..., 2): the logit of the probability
    that the match is right, and the logarithm of the half-width, pixels of beta, of the interval that holds
    the true position in 9 of 10 cases.
    """

    def __init__(self) -> None:
        width = SETTINGS.width
        first, middle, last = nn.Linear(MEASURED, width), nn.Linear(width, width), nn.Linear(width, 2)
        super().__init__(first, nn.SiLU(), middle, nn.SiLU(), last)


@cache
def fitted_certainty() -> CertaintyNetwork:
    """Return the network that ships, loaded once."""
    return with_weights(CertaintyNetwork(), Path(__file__).with_name("certainty.safetensors"))


@torch.no_grad()
def with_certainty(matches: Matches) -> Matches:
    """Add the confidence of each match, by the network that ships.

    The probability is at least `SETTINGS.least`; where one was known before, the smaller of both counts.

    Returns:
        The matches with a detached `certainty`, else as given.

    Raises:
        AssertionError: for matches before the choice network has run (`stated` is None).
    """
    return Matches(tuple(replace(beta, certainty=_certainty(beta)) for beta in matches.betas))


def _certainty(matches: BetaMatches) -> Float[Tensor, "b 2 h2 w2"]:
    """Compute confidence, and half of the interval of disparity, by the fitted network, in pieces."""
    typical, (h, w) = typical_facts(matches), matches.disparity.shape[-2:]
    bare = replace(matches, colours=None, certainty=None)
    network = deepcopy(fitted_certainty()).to(matches.facts)  # another thread may need another type

    def of(tile: Tile) -> Tensor:
        numbers = measured(bare.cut(tile.outer), typical).movedim(1, -1)
        logit, half_width = network(numbers).unbind(-1)
        return torch.stack([logit.sigmoid().clamp(min=SETTINGS.least), half_width.exp()], 1)

    halo = FINE * max(SETTINGS.averaged + SETTINGS.apart)
    certainty = assembled((h, w), ((tile, of(tile)) for tile in tiles_of((h, w), (FINE * ROWS, w), halo)))
    if matches.certainty is not None:
        certainty[:, :1] = certainty[:, :1].minimum(matches.certainty[:, :1])
    return certainty


def typical_facts(matches: BetaMatches) -> Float[Tensor, "b 2"]:
    """Compute the mean margin and cost of the pair's consistent matches."""
    consistent = (matches.facts[:, :1] < CONSISTENT).to(matches.facts)
    some = consistent.mean((-2, -1)).clamp(min=1e-3)
    return (matches.facts[:, 1:] * consistent).mean((-2, -1)) / some


def measured(matches: BetaMatches, typical: Float[Tensor, "b 2"]) -> Float[Tensor, "b n h2 w2"]:
    """Compute the confidence network's inputs: `MEASURED` numbers of each pixel at half the size.

    Args:
        matches: matches in one beta, after the choice network (AssertionError before).
        typical: `typical_facts` of the whole frame.

    Returns:
        Numbers (B, `MEASURED`, H / 2, W / 2): `facts`, and their means in each radius of `SETTINGS.averaged`;
        logarithms of .1 plus the range of `surface` in each of `SETTINGS.apart`; blurs of alpha and of beta;
        `typical`; `stated`.
    """
    assert matches.stated is not None
    facts = [matches.facts, *(box_mean(matches.facts, radius) for radius in SETTINGS.averaged)]
    ranges = (max_pool2d(_range(matches.surface, radius), FINE) for radius in SETTINGS.apart)
    apart = [(spread.clamp(min=0) + 0.1).log() for spread in ranges]
    blurs = torch.tensor(matches.comparison.whole.blurs).T  # of alpha and of beta, of each of the batch
    same = torch.cat([blurs.to(typical), typical], 1)[..., None, None]
    same = same.expand(*same.shape[:2], *matches.facts.shape[-2:])
    return torch.cat([*facts, *apart, same, matches.stated], 1)


def _range(x: Float[Tensor, "b 1 h w"], radius: int) -> Float[Tensor, "b 1 h w"]:
    """Return the greatest less the least value within squares around each pixel."""
    window = np.ones((2 * radius + 1,) * 2, np.uint8)
    ranges = [cv2.dilate(plane, window) - cv2.erode(plane, window) for plane in numpy_of(x[:, 0])]
    return torch.from_numpy(np.stack(ranges))[:, None].to(x)
