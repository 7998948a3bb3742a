"""Whether a rig fits the images that it is used with: a quick look before fusing or drawing."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig

from .matches import match_cameras
from .refinement import line_distances
from .residuals import own_distance, related

LARGEST_SIDE = 1000
"""Images are reduced to this many pixels."""
MOST_CAMERAS = 4
BADLY, OF_OWN = 1.5, 3.0
"""A rig fits badly whose points lie farther from their lines than this, in pixels of the reduced images (median), and
than this many times their distance from the lines of an F fitted to them."""


def misfit_warning(rig: Rig, images: Mapping[str, Float[Tensor, "_ _ _"]]) -> str | None:
    """A sentence if the rig fits one image (C, H, W) of each of two or more of its cameras badly; else None.

    None too where nothing can be said: too few matched points, images of another size, cameras that are not related.
    """
    some = dict(list(images.items())[:MOST_CAMERAS])
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
    off = float(line_distances(rig, pairs).abs().median())
    if off <= max(BADLY, OF_OWN * own_distance(rig, pairs)):
        return None
    points = sum(len(matches.alpha) for matches in pairs.values())
    at = "" if all(reduced[name] is some[name] for name in some) else f", in images reduced to {LARGEST_SIDE} px"
    return (
        f"the rig fits these images badly: {points} matched points lie {off:.1f} px from their lines (median{at}); "
        "`pat rig doctor` finds usual mistakes, `pat rig refine` improves a rig that has drifted"
    )
