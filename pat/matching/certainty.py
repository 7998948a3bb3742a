"""Certainty of matches: the probability of each, and the likely distance of the true position from it.

Both are computed from the results of matching: its facts at a pixel and around it, the statements of the
choice between disparities, the differences of disparities there, the blur by which one image had to be made
comparable, and the facts of the pair's consistent matches. A small network does it, which was fitted to pairs
with true disparity (`python -m experiments certainty`). It uses nothing of the image but by the choice, so it
holds for any network that uses the matches.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import max_pool2d

from arraygeom.runtime.chunks import ROWS, Tile, assembled, tiles_of

from ..support.settings import size
from ..support.tensor_files import with_weights
from .filters import box_mean, numpy_of
from .matches import BetaMatches, Matches
from .positions import FINE
from .semi_global import CONSISTENT

FITTED = Path(__file__).with_name("certainty.safetensors")


@dataclass(frozen=True)
class CertaintySettings:
    """Settings of the confidence network's inputs and outputs.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    around: tuple[int, int] = size((2, 6), "Radii, at half the size, in which facts are averaged")
    apart: tuple[int, int] = size((1, 4), "Radii, at full size, in which disparities are compared")
    width: int = size(16, "Numbers in each of the two hidden layers")
    least: float = size(1e-3, "The least probability where a segment is: what is chosen there gives depth")
    covered: float = size(0.9, "The share of true positions that an interval is to cover")


SETTINGS = CertaintySettings()
MEASURED = 3 * (1 + len(SETTINGS.around)) + len(SETTINGS.apart) + 4 + 2
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
def fitted_network() -> CertaintyNetwork:
    """Return the network that ships, loaded once."""
    return with_weights(CertaintyNetwork(), FITTED)


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
    network = deepcopy(fitted_network()).to(matches.facts)  # another thread may need it in another precision

    def of(tile: Tile) -> Tensor:
        numbers = measured(bare.cut(tile.outer), typical).movedim(1, -1)
        logit, half_width = network(numbers).unbind(-1)
        return torch.stack([logit.sigmoid().clamp(min=SETTINGS.least), half_width.exp()], 1)

    halo = FINE * max(SETTINGS.around + SETTINGS.apart)
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
        Numbers (B, `MEASURED`, H / 2, W / 2): `facts`, and their means in each radius of `SETTINGS.around`;
        logarithms of .1 plus the range of `surface` in each of `SETTINGS.apart`; blurs of alpha and of beta;
        `typical`; `stated`.
    """
    assert matches.stated is not None
    facts = [matches.facts, *(box_mean(matches.facts, radius) for radius in SETTINGS.around)]
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
