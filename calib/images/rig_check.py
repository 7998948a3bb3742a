"""Quick check whether a rig fits the images that it is used with, before fusing or drawing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Pair, Rig, apply_homography

from .depth_change import share_outside
from .matches import Images, Pairs, PointMatches, match_cameras, undistort_matches
from .residuals import match_depths, median_off, own_distance, related, share

LARGEST_SIDE = 1000
"""Longer side in pixels to which images are reduced..."""
ROUGH_SIDE = 500
"""... after a first look at this size: a rig that fits then is not compared again. That takes a fourth of the
time."""
MOST_CAMERAS = 4
BADLY, OF_OWN = 1.5, 3.0
"""Least median distance of points from their lines, in pixels of the reduced images, and as a multiple of
their distance from the lines of an F fitted to them; a rig beyond both fits badly."""
OUTSIDE = 0.5
"""Share of points outside (`share_outside`) above which a rig is wrong."""


class Misfit(NamedTuple):
    """Measures of a rig that fits badly.

    Attributes:
        off: median distance of the matched points from their lines, pixels of the reduced images.
        outside: share of those of observable depth that are behind the cameras or outside the depth range
            (`share_outside`, which says when it is 0 or NaN).
        mistaken: True if the doctor names a mistake, not a drift.
        text: a sentence on all this, with the doctor's verdict unless that is that the rig is healthy.
    """

    off: float
    outside: float
    mistaken: bool
    text: str


def misfit_warning(rig: Rig, images: Images) -> str | None:
    """Return the sentence of `find_misfit`; None if the rig fits or nothing can be said."""
    misfit = find_misfit(rig, images)
    return None if misfit is None else misfit.text


def find_misfit(rig: Rig, images: Images) -> Misfit | None:
    """Compare a rig with one image (C, H, W) of each of two or more of its cameras.

    Only the first `MOST_CAMERAS` images are used.

    Returns:
        The misfit if the rig fits badly; None if it fits, and where nothing can be said: fewer than two
        images, one of another size, images that `match_cameras` refuses, cameras that are not related, or at
        one place by the points too.

    Raises:
        ValueError: for a camera that the rig lacks, of two images or more.
    """
    chosen = {name: images[name] for name in list(images.keys())[:MOST_CAMERAS]}
    if len(chosen) < 2 or any(rig[name].hw != tuple(image.shape[1:]) for name, image in chosen.items()):
        return None
    scales = {
        side: min(_scale(image, side) for image in chosen.values()) for side in (ROUGH_SIDE, LARGEST_SIDE)
    }
    limit = BADLY * scales[ROUGH_SIDE] / scales[LARGEST_SIDE]
    rough = _matched(rig, chosen, ROUGH_SIDE)
    if rough is not None and median_off(*rough) <= limit and share_outside(*rough) <= OUTSIDE:
        return None
    if (matched := _matched(rig, chosen, LARGEST_SIDE)) is None:
        return None
    rig, pairs = matched
    off, outside = median_off(rig, pairs), share_outside(rig, pairs)
    if off <= max(BADLY, OF_OWN * own_distance(rig, pairs)) and not outside > OUTSIDE:
        return None
    points = sum(len(matches.alpha) for matches in pairs.values())
    reduced = "" if scales[LARGEST_SIDE] == 1 else f", in images reduced to {LARGEST_SIDE} px"
    text = (
        "the rig fits these images badly: "
        f"{points} matched points lie {off:.3g} px from their lines (median{reduced})"
    )
    if outside > OUTSIDE:
        text += f", {outside:.0%} of them behind the cameras or outside the depth range"
    from .doctor import diagnose_matches  # here, as SciPy's statistics take long to import

    diagnosis = diagnose_matches(rig, {name: rig[name].hw for name in chosen}, pairs)
    verdict = "" if diagnosis.healthy else f"; `pat rig doctor` says: {diagnosis.verdict}"
    return Misfit(off, outside, diagnosis.named.kind != "nothing", text + verdict)


def share_unlike(
    rig: Rig, images: Images, alpha: str, depth: Float[Tensor, "h w"], tolerance: float
) -> float:
    """Compare a depth map with the depths of points matched between the images.

    Args:
        images: one image (C, H, W) in 0..1 per camera, by name; images of another size than the rig states
            count as resized.
        alpha: camera at whose pixels the map is.
        depth: depth along alpha's axis, in the rig's unit; it may have another size than alpha's image.
            Points where it is not finite are left out.
        tolerance: tolerance relative to depth.

    Returns:
        Share of the points, 0..1, at which the map is off by more than the tolerance; NaN for too few points,
        or none that match with alpha.

    Raises:
        KeyError: without an image of alpha.
        ValueError: for a camera that the rig lacks.
    """
    if (matched := _matched(rig, {alpha: images[alpha], **images}, LARGEST_SIDE)) is None:
        return math.nan
    rig, pairs = matched
    if not (pairs := {names: points for names, points in pairs.items() if names[0] == alpha}):
        return math.nan
    depths = match_depths(rig, pairs)
    (h, w), x = depth.shape, torch.cat([points.alpha for points in pairs.values()]).double()
    scale = x.new_tensor([w / rig[alpha].hw[1], h / rig[alpha].hw[0]])
    column, row = ((x + 0.5) * scale - 0.5).round().long().clamp(min=0).unbind(-1)
    measured = depth[row.clamp(max=h - 1), column.clamp(max=w - 1)]
    wrong = (measured / depths.depth - 1).abs() > tolerance
    return share(wrong[depths.observable & depths.front & measured.isfinite()])


def _scale(image: Tensor, largest: int) -> float:
    """Return the factor, at most 1, by which an image is reduced."""
    return min(1.0, largest / max(image.shape[1:]))


def _matched(rig: Rig, images: Mapping[str, Tensor], largest: int) -> tuple[Rig, Pairs] | None:
    """Match points between images with sides reduced to so many pixels at most; None if too few."""
    reduced = {}
    for name, image in images.items():
        scale = _scale(image, largest)
        hw = round(image.shape[1] * scale), round(image.shape[2] * scale)
        rig = rig.resize(name, hw)
        reduced[name] = interpolate(image[None], hw, mode="area")[0] if scale < 1 else image
    try:
        pairs = related(rig, match_cameras(reduced), by_lines=True)
    except ValueError:
        return None
    pairs = {names: points for names, points in pairs.items() if not _registered(rig.pair(*names), points)}
    return (rig, pairs) if pairs else None


def _registered(pair: Pair, matches: PointMatches) -> bool:
    """Return True if cameras are at one place, by the rig, and the points are where that puts them."""
    if not pair.at_one_place:
        return False
    x, y = undistort_matches(pair, matches)
    return float((apply_homography(pair.homography, x).x - y).norm(dim=-1).median()) <= BADLY
