"""Detection of a rig that its images contradict: warn, or refine it for them if they determine it
far better."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from arraygeom import Rig
from arraygeom.runtime.warned import warn
from calib.images.depth_change import share_outside
from calib.images.matches import Pairs, match_cameras
from calib.images.refinement import refine_matches
from calib.images.residuals import own_distance, related
from calib.images.rig_check import OUTSIDE, find_misfit
from calib.images.self_calibration import depth_bounds

from ..fusion.checks import LowConfidenceWarning
from ..fusion.views import ViewFiles, check_exposures
from ..support.settings import size
from .from_images import matching_factor, resized_rig, scaled


@dataclass(frozen=True)
class HealingSettings:
    """Settings for correcting a rig by the images that are fused."""

    nearer: float = size(4.0, "How many times nearer to their lines held-out points must come")
    of_own: float = size(2.0, "How many times as far as from those of their own F they may be then")
    slack: float = size(0.25, "And so many pixels of the matched images more")


SETTINGS = HealingSettings()


class Healed(NamedTuple):
    """Rig refined by its images.

    Attributes:
        rig: the refined rig, of the image files as recorded.
        text: sentence on the changes.
    """

    rig: Rig
    text: str


def checked_rig(views: ViewFiles, *, heal: bool) -> Healed | None:
    """Compare a rig with its images, and refine it, or warn that it fits badly.

    The warning is a `LowConfidenceWarning` if the rig is wrong: mistaken by the doctor's verdict, or with
    most points behind cameras or outside its depth range; else a UserWarning. Only the first four images are
    compared. Images that cannot be read are left to the fusion.

    Args:
        views: images by camera, with their rig.
        heal: True to refine the rig where it is not wrong and points determine it far better, and to warn
            otherwise; False to warn only.

    Returns:
        The refined rig; None if the rig fits, if there was a warning, and where nothing can be said, as
        with too few matched points (`find_misfit`).
    """
    try:
        images = dict(views)
        check_exposures(views.rig, images, views.alpha)
        misfit = find_misfit(views.developed, images)
    except (ValueError, OSError):  # of a file or an image: the fusion says so
        return None
    if misfit is None:
        return None
    wrong = misfit.mistaken or misfit.outside > OUTSIDE
    if heal and not wrong and (healed := healed_rig(views.rig, images, views.alpha)):
        return healed
    warn(misfit.text, LowConfidenceWarning if wrong else UserWarning)
    return None


def healed_rig(rig: Rig, images: Mapping[str, Tensor], alpha: str) -> Healed | None:
    """Refine a rig by points matched between alpha and the betas, however far its parameters have to move.

    The stated depth range is widened where matched points lie beyond it.

    Args:
        rig: rig of the image files.
        images: images (c, h, w) of alpha and betas, by camera; other cameras stay as they are.
        alpha: name of alpha.

    Returns:
        The refined rig; None for too few points, and unless held-out points then lie about as near to their
        lines as to those of an F fitted to them, far nearer than before, and most within the depth range.
    """
    small = {name: scaled(image, matching_factor(image)) for name, image in images.items()}
    reduced = resized_rig(rig.replace(cameras={name: rig[name] for name in (alpha, *small)}), small)
    try:
        pairs = related(reduced, match_cameras(small, alpha=alpha))
        refined = refine_matches(reduced, [pairs], force=True)
    except ValueError:  # too few points, nothing to refine
        return None
    before, after = (statistics.median for statistics in refined.held_out)
    best = SETTINGS.of_own * own_distance(reduced, pairs) + SETTINGS.slack
    far = after > best or after * SETTINGS.nearer > before
    if not refined.accepted or far or share_outside(refined.rig, pairs) > OUTSIDE:
        return None
    cameras = dict(rig.cameras)
    for name in small:
        cameras[name] = refined.rig.resize(name, rig[name].hw)[name].replace(sensor=rig[name].sensor)
    text = f"the rig is healed by these images: points lay {before:.1f} px from their lines, now {after:.2f}"
    if refined.depth is not None:
        text += f"; depth changes by {refined.depth.change:.0%} (median), and is rough"
    depth = _depth_range(refined.rig, pairs)
    if depth is not None and [*depth] != [float(bound) for bound in rig.depth or ()]:
        text += f"; the stated depth range becomes {depth[0]:.3g} to {depth[1]:.3g}, as points are beyond it"
    healed = rig.replace(cameras=cameras, depth=depth)
    return Healed(healed, f"{text} (--misfit warn leaves the rig as it is)")


def _depth_range(rig: Rig, pairs: Pairs) -> tuple[float, float] | None:
    """Depth range of the rig, extended to that of the matched points: a rotation that images correct moves
    all depths along the segments."""
    every = [depth_bounds(Rig({n: rig[n] for n in names}), matches) for names, matches in pairs.items()]
    ranges = [bounds for bounds in every if bounds is not None]
    if rig.depth is None or not ranges:
        return rig.depth
    recorded = [float(bound) for bound in rig.depth]
    return min(recorded[0], *(near for near, _ in ranges)), max(recorded[1], *(far for _, far in ranges))
