"""An uncalibrated rig from images alone: fundamental matrices and rough maps between cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Link, Rig, View, intrinsics
from arraygeom.runtime.progress import part, stage
from arraygeom.runtime.text import OPEN
from arraygeom.runtime.threads import torch_in_one_thread

from .explanations import Explanation, explain, registration
from .lenses import describe_lenses
from .matches import (
    AGREE,
    ENOUGH,
    MATCHING_SHARE,
    FittedLink,
    Pairs,
    PointMatches,
    agreeing_pairs,
    fit_fundamental,
    fit_homography,
    fit_link,
    image_sizes,
    line_distance,
    match_cameras,
    undistort_matches,
    with_map,
)
from .refinement import refine_matches
from .residuals import median_off, split


class UncalibratedRig(NamedTuple):
    """An uncalibrated rig, with statistics of each of its links by the names (alpha, beta).

    Attributes:
        rig: views related by links; named `OPEN` if the points of some link leave its lines undetermined.
        fits: links with the points that agree (undistorted), and their reach along the lines from a
            similarity, perhaps not the link's map; for points too few for lines all of them, with reach 0.
        distance: median distance of held-out points from their lines, pixels of beta; an empty dict for
            points too few for lines.
        by_focal: True where F was fitted with the given focal lengths.
        explained: simplest explanation of the points, lines or one homography.
        matches: the matches that were used, in pixels as recorded.
    """

    rig: Rig
    fits: dict[tuple[str, str], FittedLink]
    distance: dict[tuple[str, str], float]
    by_focal: dict[tuple[str, str], bool]
    explained: dict[tuple[str, str], Explanation]
    matches: dict[tuple[str, str], PointMatches]

    def as_text(self) -> str:
        """Return one line per link, and one on lenses if there are any."""
        lines = [f"{a} > {b}: {self.describe(a, b)}" for a, b in self.fits]
        return "\n".join([*lines, *filter(None, [describe_lenses(self.rig)])])

    def describe(self, a: str, b: str) -> str:
        """Return a sentence on a link: its explanation, what that leaves undetermined, and how well its lines
        fit, if it has any.

        Raises:
            KeyError: unless (a, b), in this order, is a key of `fits`.
        """
        explained = self.explained[a, b].as_text(focal_lengths=self.by_focal[a, b])
        if not self.explained[a, b].has_lines:
            return explained
        return (
            f"{explained}; held-out points lie {self.distance[a, b]:.2f} px from their lines, and all within "
            f"{self.fits[a, b].displacement:.0f} px of a homography"
            + (", with the given focal lengths" if self.by_focal[a, b] else "")
        )


@torch_in_one_thread()
@stage()
def rig_from_images(
    images: Mapping[str, Float[Tensor, "_ _ _"]],
    *,
    focal: Mapping[str, float] | None = None,
    alpha: str | None = None,
    matches: Pairs | None = None,
) -> UncalibratedRig:
    """Make an uncalibrated rig of the cameras that took these images, good enough to fuse with.

    For every two cameras with a common field of view, F is fitted by MAGSAC++ (Barath et al. 2020) and a
    rough map by the points. With the focal lengths of both an essential matrix is fitted too, with five
    degrees of freedom instead of seven; it is used where it fits held-out points better. All F are then
    fitted jointly, with lenses, and accepted on the same condition. Points that one homography explains leave
    the lines undetermined (`Explanation`): that homography is then the map.

    Args:
        images: one image (C, H, W) in 0..1 per camera, by name.
        focal: rough focal lengths in pixels by camera; None or missing ones are unknown.
        alpha: match only this camera with each other one; None for every two cameras.
        matches: points by pair of images used instead of matching these, None to match them; if every pair
            has fewer than `ENOUGH` (20), links have a homography alone (`fit_homography`).

    Returns:
        The rig with statistics of its links; a camera that matches with none is a view without a link.

    Raises:
        ValueError: in one line, for images that `match_cameras` refuses, points of which too few agree, all
            in one spot, or of a camera without an image, and a focal length that is not positive and finite
            or of no camera.
    """
    focal = dict(focal or {})
    for name, length in focal.items():
        if name not in images or not 0 < length < math.inf:
            raise ValueError(f"focal: '{name}={length:g}' is no camera with an image, or not positive")
    sizes = image_sizes(images)
    K = {name: intrinsics(length, sizes[name]) for name, length in focal.items()}
    with part(0, MATCHING_SHARE):
        given = None if matches is None else usable_matches(matches, alpha=alpha)
        matched = match_cameras(images, alpha=alpha) if given is None else given
    if all(len(points.alpha) < ENOUGH for points in matched.values()):
        return _registered(Rig({name: View(hw=hw) for name, hw in sizes.items()}), matched)
    distance, by_focal, links = {}, {}, {}
    for names, points in matched.items():
        F, distance[names], by_focal[names] = _fundamental(points, *(K.get(name) for name in names))
        links[names] = fit_link(points, F, within=AGREE).link
    rig = Rig({name: View(hw=hw) for name, hw in sizes.items()}, links=links)
    with part(MATCHING_SHARE, 1):
        refined = refine_matches(rig, [matched])
    if refined.accepted:
        rig = refined.rig
        _, held_out = split([matched])
        distance |= {names: median_off(rig, {names: m}) for names, m in held_out.items()}
    fits, explained = {}, {}
    for names, points in matched.items():
        pair = rig.pair(*names)
        fits[names] = with_map(pair, points)
        explained[names] = explain(undistort_matches(pair, points), pair)
        if not explained[names].has_lines:
            link = fits[names].link.replace(H=explained[names].H)
            fits[names] = fits[names]._replace(link=link)
    rig = rig.replace(links={names: fit.link for names, fit in fits.items()})
    if not all(explanation.has_lines for explanation in explained.values()):
        rig = rig.replace(name=OPEN)
    return UncalibratedRig(rig, fits, distance, by_focal, explained, matched)


def usable_matches(matches: Pairs, *, alpha: str | None = None) -> dict[tuple[str, str], PointMatches]:
    """Select matches from elsewhere that agree, or, where no pair has enough for lines, all.

    Args:
        matches: points by pair of cameras.
        alpha: the camera whose pairs are wanted, turned so that it comes first; None for all as they are.

    Returns:
        By pair, the matches that agree, of pairs with `ENOUGH` of them; or if every pair has fewer than
        `ENOUGH` in all, all matches.

    Raises:
        ValueError: for no (such) pairs, and if no pair has enough that agree.
    """
    if alpha is not None:
        turned = {(b, a): PointMatches(*points[::-1]) for (a, b), points in matches.items()}
        matches = {names: points for names, points in {**turned, **matches}.items() if names[0] == alpha}
    few = matches and all(len(points.alpha) < ENOUGH for points in matches.values())
    return dict(matches) if few else agreeing_pairs(matches)


def _registered(rig: Rig, matches: Pairs) -> UncalibratedRig:
    """Return the rig of views whose images a homography by a few points registers."""
    fitted = {names: link_of_points(rig, names, points) for names, points in matches.items()}
    links = {names: link for names, (link, _) in fitted.items()}
    explained = {names: explanation for names, (_, explanation) in fitted.items()}
    fits = {names: FittedLink(link, matches[names], 0.0) for names, link in links.items()}
    rig = rig.replace(links=links, name=OPEN)
    return UncalibratedRig(rig, fits, {}, dict.fromkeys(links, False), explained, dict(matches))


def link_of_points(rig: Rig, pair: tuple[str, str], points: PointMatches) -> tuple[Link, Explanation]:
    """Fit F and a rough map of a pair to its points, which are taken as undistorted.

    Args:
        rig: rig with the two views, whose sizes are used.
        pair: names (alpha, beta).
        points: matched points of the two.

    Returns:
        The link, of the homography alone if the points show no lines beside it, or are fewer than `ENOUGH`;
        and the explanation taken.

    Raises:
        ValueError: for points that no F fits, or of which fewer than `ENOUGH` agree with it; where there are
            fewer than `ENOUGH`, for points that no homography fits: under four, or all at one spot.
    """
    if len(points.alpha) < ENOUGH:
        explained = registration(fit_homography(points), points)
        return Link.from_homography(explained.H, explained.noise), explained
    link = fit_link(points, fit_fundamental(points), within=AGREE).link
    explained = explain(points, rig.replace(links={pair: link}).pair(*pair))
    spread = registration(explained.H, points).noise
    return link if explained.has_lines else Link.from_homography(explained.H, spread), explained


def _fundamental(
    matches: PointMatches, K: Tensor | None, K_beta: Tensor | None
) -> tuple[Tensor, float, bool]:
    """Fit F to all points, by focal lengths if held-out points are nearer then.

    Returns F, the median distance of held-out points from that of the rest, and True for focal lengths.
    """
    (used,), (held_out,) = (list(pairs.values()) for pairs in split([{("", ""): matches}]))
    fits: dict[bool, Callable[[PointMatches], Tensor]] = {False: fit_fundamental}
    if K is not None and K_beta is not None:
        fits[True] = partial(_by_focal, K=K, K_beta=K_beta)
    distance = {by: float(line_distance(held_out, fit(used)).median()) for by, fit in fits.items()}
    best = min(distance, key=lambda by: distance[by])
    return fits[best](matches), distance[best], best


def _by_focal(matches: PointMatches, K: Tensor, K_beta: Tensor) -> Tensor:
    x, y = (points.numpy() for points in matches)
    no_lens = np.zeros(5)
    E, _ = cv2.findEssentialMat(
        x, y, K.numpy(), no_lens, K_beta.numpy(), no_lens, method=cv2.RANSAC, threshold=1.0
    )
    if E is None or E.shape != (3, 3):
        return fit_fundamental(matches)
    return torch.linalg.inv(K_beta).T @ torch.from_numpy(E) @ torch.linalg.inv(K)
