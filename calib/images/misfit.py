"""Whether a rig fits the images that it is used with: a quick look before fusing or drawing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig

from .doctor import diagnose_matches
from .held_out import line_distances
from .matches import Matches, match_cameras
from .residuals import match_depths, own_distance, related

LARGEST_SIDE = 1000
"""Images are reduced to this many pixels."""
MOST_CAMERAS = 4
BADLY, OF_OWN = 1.5, 3.0
"""A rig fits badly whose points lie farther from their lines than this, in pixels of the reduced images (median), and
than this many times their distance from the lines of an F fitted to them."""
OUTSIDE = 0.5
"""And a rig is wrong that has more than this share of the points behind the cameras or outside its depth range..."""
BEYOND = 1.5
"""... by more than this factor."""
FEW = 10
"""Least number of points for a share."""


class Misfit(NamedTuple):
    """How badly a rig fits.

    off: distance of the matched points from their lines (median, pixels of the reduced images). outside: the share of
    them behind the cameras or outside the depth range. mistaken: the doctor names a mistake, not a drift. text: a
    sentence on all this, with the doctor's.
    """

    off: float
    outside: float
    mistaken: bool
    text: str


def misfit_warning(rig: Rig, images: Mapping[str, Float[Tensor, "_ _ _"]]) -> str | None:
    """The sentence of `find_misfit`, if any."""
    found = find_misfit(rig, images)
    return None if found is None else found.text


def find_misfit(rig: Rig, images: Mapping[str, Float[Tensor, "_ _ _"]]) -> Misfit | None:
    """What is wrong if the rig fits one image (C, H, W) of each of two or more of its cameras badly; else None.

    None too where nothing can be said: too few matched points, images of another size, cameras that are not related.
    """
    some = {name: images[name] for name in list(images.keys())[:MOST_CAMERAS]}
    if len(some) < 2 or any(rig[name].hw != tuple(image.shape[1:]) for name, image in some.items()):
        return None
    reduced = {}
    for name, image in some.items():
        h, w = image.shape[1:]
        scale = min(1.0, LARGEST_SIDE / max(h, w))
        hw = round(h * scale), round(w * scale)
        rig = rig.resize(name, hw)
        reduced[name] = torch.nn.functional.interpolate(image[None], hw, mode="area")[0] if scale < 1 else image
    try:
        pairs = related(rig, match_cameras(reduced))
    except ValueError:
        return None
    off, outside = float(line_distances(rig, pairs).abs().median()), share_outside(rig, pairs)
    if off <= max(BADLY, OF_OWN * own_distance(rig, pairs)) and outside <= OUTSIDE:
        return None
    points = sum(len(matches.alpha) for matches in pairs.values())
    at = "" if all(reduced[name] is some[name] for name in some) else f", in images reduced to {LARGEST_SIDE} px"
    text = f"the rig fits these images badly: {points} matched points lie {off:.1f} px from their lines (median{at})"
    if outside > OUTSIDE:
        text += f", {outside:.0%} of them behind the cameras or outside the depth range"
    found = diagnose_matches(rig, {name: rig[name].hw for name in some}, pairs)
    verdict = "" if found.healthy else f"; `pat rig doctor` says: {found.verdict}"
    return Misfit(off, outside, found.named.kind != "nothing", text + verdict)


def share_outside(rig: Rig, pairs: Mapping[tuple[str, str], Matches]) -> float:
    """The share of points of observable depth that are behind the cameras or outside the rig's depth range; 0 for few.

    Points of calibrated pairs only; the depth range counts with a margin.
    """
    near, far = (0.0, math.inf) if rig.depth is None else (float(rig.depth[0]) / BEYOND, float(rig.depth[1]) * BEYOND)
    outside = []
    for names, matches in pairs.items():
        if (found := match_depths(rig.pair(*names), matches)) is not None:
            inside = found.front & (found.depth >= near) & (found.depth <= far)
            outside.append(~inside[found.observable])
    joined = torch.cat(outside) if outside else torch.zeros(0)
    return float(joined.double().mean()) if len(joined) >= FEW else 0.0
