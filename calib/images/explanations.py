"""Explanations of the points matched between two images, and what these leave undetermined.

Points that one homography and smooth lenses explain fit an F through any epipole: those on one plane, those
of cameras at one place, however different their focal lengths, and those of a scene far away (Hartley and
Zisserman, section 11.9; Chum, Werner and Matas 2005). Their lines and depth would be an arbitrary choice.
Where points do move along lines beyond any homography, lines are determined, but lengths only as multiples of
the baseline, and without focal lengths not the proportions of depth either: the bas-relief ambiguity
(Belhumeur, Kriegman and Yuille 1999).
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Pair, Rig, View, apply_homography, epipolar_lines
from arraygeom.pixels import to_homogeneous
from arraygeom.robust import cauchy, normal_deviation, robust_least_squares

from .matches import LOCALISED, Pairs, PointMatches, fit_fundamental, fit_link, undistort_matches
from .residuals import FEW, displacements

OFF = 4.0
"""Distance, in standard deviations of the points' noise, beyond which a point is off an explanation."""
LEAST_SHARE = 0.02
"""Least share of points off a homography for lines: wrong matches that happen to lie along lines pass for
right ones."""
STEPS = 20
"""Weightings of the fit of a homography and lenses."""


class Explanation(NamedTuple):
    """The simplest explanation of a pair's points within their noise, with its evidence.

    Attributes:
        H: homography nearest to most points, beta from alpha, undistorted pixels.
        points: number of the points.
        beyond: number of points off H, even with smooth lenses, along the lines of F; for few points
            (`registration`) in any direction.
        wrong: number of points off these lines; for few points the same as `beyond`.
        noise: standard deviation of the distances from the lines, or for few points from their places by H;
            pixels of beta.
    """

    H: Float[Tensor, "3 3"]
    points: int
    beyond: int
    wrong: int
    noise: float

    @property
    def has_lines(self) -> bool:
        """True if the points determine epipolar lines: many move along them, far more than lie off them."""
        return self.beyond >= max(self.wrong + FEW, 2 * self.wrong, LEAST_SHARE * self.points)

    def as_text(self, *, focal_lengths: bool = False) -> str:
        """Return the explanation taken and what it leaves undetermined, as a phrase without a full stop.

        Args:
            focal_lengths: True if focal lengths are known, which fixes the proportions of depth.
        """
        if not self.has_lines:
            return (
                f"one homography fits {self.points - self.beyond} of {self.points} matched points to "
                f"{self.noise:.2f} px (a plane, cameras at one place, or a far scene); unknown: epipolar "
                "lines and depth"
            )
        bas_relief = "" if focal_lengths else " and, without focal lengths, the proportions of depth"
        return (
            f"{self.beyond} of {self.points} matched points show depth (they lie off any one homography), so "
            f"epipolar lines are used; unknown: scale{bas_relief}"
        )


def explain(matches: PointMatches, pair: Pair) -> Explanation:
    """Compare one homography with the pair's F as explanations of undistorted points.

    Points off the homography along the lines of F are counted against those off the lines, where noise and
    wrong matches put as many.

    Args:
        matches: undistorted points, of which F fits most.
        pair: the pair, with F or cameras; an F of 0 gives a `noise` of NaN.

    Returns:
        The explanation; H is the identity if no homography fits.

    Raises:
        ValueError: for a pair without F or cameras.
        cv2.error: for fewer than four points.
    """
    x, y = (points.double() for points in matches)
    H = _fit_to_most(x, y)
    line = epipolar_lines(pair.fundamental.to(x), x)
    line = line / line[:, :2].norm(dim=-1, keepdim=True)
    distance = ((line[:, :2] * y).sum(-1) + line[:, 2]).abs()
    along = (_beyond(H, x, y, pair) * torch.stack([-line[:, 1], line[:, 0]], -1)).sum(-1).abs()
    noise = normal_deviation(distance, LOCALISED / OFF)
    beyond, wrong = (int((off > OFF * noise).sum()) for off in (along, distance))
    return Explanation(H, len(x), beyond, wrong, noise)


def undetermined(rig: Rig, pairs: Pairs) -> tuple[str, ...]:
    """Describe the pairs whose points determine no lines, with an F of their own instead of the rig's.

    Returns:
        A sentence a pair, without a full stop; none for pairs whose points determine lines, or of which no F
        fits `ENOUGH`.

    Raises:
        ValueError: for a camera that the rig lacks.
    """
    sentences = []
    for names, matches in pairs.items():
        points = undistort_matches(rig.pair(*names), matches)
        with suppress(ValueError):  # no F fits them, and none is needed
            link = fit_link(points, fit_fundamental(points)).link
            alpha, beta = (View(hw=rig[name].hw) for name in names)
            explained = explain(points, Pair(alpha, beta, link=link))
            if not explained.has_lines:
                sentences.append(f"by the points of {' and '.join(names)} alone, {explained.as_text()}")
    return tuple(sentences)


def registration(H: Float[Tensor, "3 3"], matches: PointMatches) -> Explanation:
    """Return the explanation of a few points by a homography alone: how many are off it, and their noise."""
    off = (apply_homography(H, matches.alpha.to(H)).x - matches.beta.to(H)).norm(dim=-1)
    noise = normal_deviation(off, LOCALISED / OFF)
    wrong = int((off > OFF * noise).sum())
    return Explanation(H, len(off), wrong, wrong, noise)


def _fit_to_most(x: Float[Tensor, "n 2"], y: Float[Tensor, "n 2"]) -> Float[Tensor, "3 3"]:
    H = None
    for method in (cv2.USAC_MAGSAC, 0):
        H, _ = cv2.findHomography(x.numpy(), y.numpy(), method, 1.0)
        if H is not None:
            break
    return torch.eye(3, dtype=torch.float64) if H is None else torch.from_numpy(H).double()


def _beyond(H: Tensor, x: Tensor, y: Tensor, pair: Pair) -> Float[Tensor, "n 2"]:
    """Compute displacements of beta's points that no homography near H and no smooth lenses explain."""
    moved = to_homogeneous(x) @ H.T
    there, w = moved[:, :2] / moved[:, 2:], moved[:, 2:, None]
    J = (H[:2, :2] - there[:, :, None] * H[2:, :2]) / w
    ones = to_homogeneous((x - x.mean(0)) / max(pair.alpha.hw))
    relative = (there - there.mean(0)) / max(pair.beta.hw)
    terms = (
        torch.cat(
            [
                torch.stack([ones, 0 * ones], 1),
                torch.stack([0 * ones, ones], 1),
                relative[:, :, None] * ones[:, None, :2],
                displacements(pair.beta.hw, y),
                J @ displacements(pair.alpha.hw, x),
            ],
            -1,
        )
        .flatten(0, 1)
        .T
    )

    def weigh(rest: Tensor) -> Tensor:
        size = rest.reshape(-1, 2).norm(dim=-1)
        return cauchy(size, normal_deviation(size, LOCALISED)).repeat_interleave(2)

    off = (y - apply_homography(H, x).x).flatten()
    return robust_least_squares(terms, off, terms.new_zeros(len(terms)), weigh, steps=STEPS).rest.view(-1, 2)
