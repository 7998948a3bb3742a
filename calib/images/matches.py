"""Points seen in two images, and what they tell of a rig that is known only in part: a rough map, a depth range."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from kornia.color import rgb_to_grayscale
from numpy.typing import NDArray
from torch import Tensor

from arraygeom import Link, Pair, apply_homography, epipolar_distance, epipolar_lines, triangulate
from arraygeom.pixels import shift_matrix

from .patch_matching import sharpened

RATIO = 0.75
"""The best match must be this much nearer than the second best (Lowe 2004, section 7.1)."""
FEATURES = 6000
ENOUGH = 20
"""Matches that must agree before anything is concluded from them."""
LOCATED = (0.15, 0.2, 0.3, np.inf)
"""Points are to be known this well, one standard deviation in pixels by what patches around them leave over."""
PLENTY = 40
"""So many points that are located well are enough, and others are left out."""
MANY = 60
"""With fewer matches that agree, the images may be mirrored."""
AGREE = 5.0
"""How far from its line, in pixels, a match may be that agrees: lenses bend lines."""
STILL = 0.05
"""Images whose points move less than this are one image."""


class Matches(NamedTuple):
    """Points (x, y) of alpha, and where beta sees them."""

    alpha: Float[Tensor, "n 2"]
    beta: Float[Tensor, "n 2"]

    def only(self, kept: Bool[Tensor, " n"]) -> Matches:
        """Some of them."""
        return Matches(self.alpha[kept], self.beta[kept])


def match_points(alpha: Float[Tensor, "_ h w"], beta: Float[Tensor, "_ hb wb"]) -> Matches:
    """SIFT features of both images' luminance, contrast evened, that choose each other and pass the ratio test.

    Where patches around them are alike, beta's are moved to where those fit best.
    """
    return _sharp(detect(alpha), detect(beta))


class Features(NamedTuple):
    """SIFT features of one image: points (x, y), sizes (pixels) and directions (radians), their descriptors.

    image: its luminance, contrast evened, in which they were found.
    """

    points: NDArray[np.float64]
    sizes: NDArray[np.float64]
    directions: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    image: NDArray[np.uint8]


def detect(image: Float[Tensor, "_ h w"]) -> Features:
    """SIFT features of an image's luminance, its contrast evened."""
    grey = rgb_to_grayscale(image)[0] if image.shape[0] == 3 else image[0]
    even = cv2.createCLAHE(3, (8, 8)).apply(np.rint(grey.clamp(0, 1).numpy() * 255).astype(np.uint8))
    sift = cv2.SIFT.create(FEATURES, enable_precise_upscale=True)
    found, descriptors = sift.detectAndCompute(even, np.empty(0, np.uint8))
    points = np.array([p.pt for p in found], np.float64).reshape(-1, 2)
    sizes, angles = (np.array([getattr(p, name) for p in found], np.float64) for name in ("size", "angle"))
    known = np.asarray(descriptors, np.float32) if len(found) else np.zeros((0, 128), np.float32)
    return Features(points, sizes, np.radians(angles), known, even)


def _chosen(a: Features, b: Features) -> tuple[list[int], list[int]]:
    """The features, by their numbers in both, that choose each other and pass the ratio test."""
    if len(a.points) < 2 or len(b.points) < 2:
        return [], []
    there, back = _nearest(a.descriptors, b.descriptors), _nearest(b.descriptors, a.descriptors)
    pairs = [(i, j) for i, j in there.items() if back.get(j) == i]
    return [i for i, _ in pairs], [j for _, j in pairs]


def _sharp(a: Features, b: Features) -> Matches:
    """Those features' points; beta's where patches around them fit best."""
    i, j = _chosen(a, b)
    ratio, turn = b.sizes[j] / a.sizes[i], b.directions[j] - a.directions[i]
    c, s = ratio * np.cos(turn), ratio * np.sin(turn)
    maps = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)
    y, deviation = sharpened(a.image, b.image, a.points[i], b.points[j], maps)
    kept = torch.from_numpy(_good_enough(deviation))
    return Matches(torch.from_numpy(a.points[i]), torch.from_numpy(y)).only(kept)


def _good_enough(deviation: NDArray[np.float64]) -> NDArray[np.bool_]:
    """The points that are located best, by the first bound that leaves `PLENTY` of them; all, if none does."""
    for bound in LOCATED:
        if (kept := deviation < bound).sum() >= PLENTY:
            return kept
    return np.ones_like(deviation, dtype=np.bool_)


def match_cameras(images: Mapping[str, Float[Tensor, "_ _ _"]]) -> dict[tuple[str, str], Matches]:
    """Points seen in both images of every two cameras, those alone that some fundamental matrix agrees with.

    Where few agree, the second image is tried mirrored: features do not survive that. Pairs with fewer than 20
    are left out. Raises ValueError, one line, if no pair is left, for fewer than two images, and for equal ones.
    """
    if len(images) < 2:
        raise ValueError("matching needs the images of two cameras or more: give --image NAME=FILE for each")
    features = {name: detect(image) for name, image in images.items()}
    found = {(a, b): _agreeing(features[a], features[b], images[b]) for a, b in combinations(images, 2)}
    kept = {names: matches for names, matches in found.items() if len(matches.alpha) >= ENOUGH}
    for (a, b), matches in kept.items():
        if images[a].shape[1:] == images[b].shape[1:] and float(_movement(matches)) < STILL:
            raise ValueError(f"the images of '{a}' and '{b}' are the same image: give each camera its own")
    if not kept:
        (a, b), most = max(found.items(), key=lambda item: len(item[1].alpha))
        raise ValueError(
            f"only {len(most.alpha)} points seen in both '{a}' and '{b}' agree, {ENOUGH} are needed: do the cameras "
            "see the same things, at the same time and in focus?"
        )
    return kept


def _agreeing(a: Features, b: Features, image: Tensor) -> Matches:
    """Matches that some F puts within `AGREE` pixels of their lines; of the mirrored image if those are more."""
    straight = agreeing(_sharp(a, b))
    if len(straight.alpha) >= MANY:
        return straight
    x, y = agreeing(_sharp(a, detect(image.flip(-1))))
    mirrored = Matches(x, torch.stack([image.shape[-1] - 1 - y[:, 0], y[:, 1]], -1))
    return max(straight, mirrored, key=lambda m: len(m.alpha))


def agreeing(matches: Matches, *, within: float = AGREE) -> Matches:
    """The matches that some fundamental matrix puts within some pixels of their lines; none if there are few."""
    if len(matches.alpha) < ENOUGH:
        return matches.only(torch.zeros(len(matches.alpha), dtype=torch.bool))
    try:
        F = fit_fundamental(matches)
    except ValueError:
        return matches.only(torch.zeros(len(matches.alpha), dtype=torch.bool))
    return near_lines(matches, F, within=within)


def _movement(matches: Matches) -> Tensor:
    """How far most points are from one image to the other: the 90th percentile, pixels."""
    return (matches.alpha - matches.beta).norm(dim=-1).quantile(0.9)


def near_lines(matches: Matches, F: Float[Tensor, "3 3"], *, within: float) -> Matches:
    """The matches within some pixels of their epipolar line in beta."""
    return matches.only(line_distance(matches, F) <= within)


def line_distance(matches: Matches, F: Float[Tensor, "3 3"]) -> Float[Tensor, " n"]:
    """How far each match is from its epipolar line, in beta's pixels."""
    return epipolar_distance(F.to(matches.alpha), *matches).abs()


class FittedLink(NamedTuple):
    """What matches tell of a pair known by F.

    link: F fitted to the matches, and a similarity H in the middle of where points are along their lines.
    matches: those that agree.
    displacement: pixels of beta to either side of H x that hold 98% of them.
    """

    link: Link
    matches: Matches
    displacement: float


def fit_link(matches: Matches, F: Float[Tensor, "3 3"], *, within: float = 6.0) -> FittedLink:
    """A better F than `F`, and a rough map, from matches that `F` puts within some pixels of their lines.

    F by MAGSAC++ (Barath et al. 2020) to 1 px; H as of `rough_map`. Raises ValueError for fewer than 20 matches that
    agree.
    """
    near = near_lines(matches, F, within=within)
    fitted = fit_fundamental(near) if len(near.alpha) >= ENOUGH else F
    kept = near_lines(near, fitted, within=3)
    if len(kept.alpha) < ENOUGH:
        raise ValueError(f"only {len(kept.alpha)} points seen in both images agree with F: check that it is theirs")
    H, displacement = rough_map(kept, fitted)
    return FittedLink(Link(fitted, H), kept, displacement)


def rough_map(matches: Matches, F: Float[Tensor, "3 3"]) -> tuple[Float[Tensor, "3 3"], float]:
    """A similarity in the middle of where points are along their lines, and how far from it 98% of them are, pixels.

    By RANSAC, then moved along the lines' mean direction.
    """
    H = similarity(matches)
    low, high = _percentiles(_along_lines(matches, F, H), 0.01)
    line = epipolar_lines(F, matches.alpha)
    shift = torch.stack([-line[:, 1], line[:, 0]], -1).mean(0) * (low + high) / 2
    H = shift_matrix(*(-shift).tolist()).to(H) @ H
    low, high = _percentiles(_along_lines(matches, F, H), 0.01)
    return H, max(-low, high)


def straightened(pair: Pair, matches: Matches) -> Matches:
    """The points where cameras without lenses would see them; those that the lens models do not reach are left out."""
    (x, seen), (y, also) = pair.alpha.undistort(matches.alpha), pair.beta.undistort(matches.beta)
    return Matches(x, y).only(seen & also)


def with_map(pair: Pair, matches: Matches) -> FittedLink:
    """The pair's link with the rough map of points near their lines, its F as it is. Raises ValueError for too few."""
    F = pair.fundamental
    kept = near_lines(straightened(pair, matches), F, within=3)
    if len(kept.alpha) < ENOUGH:
        raise ValueError(f"only {len(kept.alpha)} points seen in both images agree with F: check that it is theirs")
    H, displacement = rough_map(kept, F)
    return FittedLink(Link(F, H), kept, displacement)


def seen_depths(pair: Pair, matches: Matches) -> tuple[float, float]:
    """Depth bounds, metres in front of alpha, that hold what was matched: 0.9 of the nearest to 1.25 of the farthest.

    Nearest and farthest without the outermost 2% of the points. Raises ValueError for fewer than 20 points in front.
    """
    straight = Matches(pair.alpha.undistort(matches.alpha)[0], pair.beta.undistort(matches.beta)[0])
    near = matches.only(line_distance(straight, pair.fundamental) <= 3)
    found = triangulate([camera.to(torch.float64) for camera in pair.cameras], torch.stack(near))
    depth = pair.cameras[0].cam_from_world.apply(found.X)[found.valid, 2]
    if len(depth) < ENOUGH:
        raise ValueError(f"only {len(depth)} points seen in both images fit the calibration: is it theirs?")
    low, high = _percentiles(depth, 0.02)
    return 0.9 * low, 1.25 * high


def fit_fundamental(matches: Matches) -> Float[Tensor, "3 3"]:
    """F by MAGSAC++ (Barath et al. 2020) to 1 px. Raises ValueError if none fits."""
    x, y = (points.numpy() for points in matches)
    try:
        found, _ = cv2.findFundamentalMat(x, y, cv2.USAC_MAGSAC, 1.0, 0.999, 10_000)
    except cv2.error:
        found = None
    if found is None or found.shape != (3, 3):
        raise ValueError("no fundamental matrix fits the points seen in both images")
    return torch.from_numpy(found)


def similarity(matches: Matches) -> Float[Tensor, "3 3"]:
    """The similarity that most matches follow to 30 pixels of beta."""
    x, y = (points.numpy() for points in matches)
    found, _ = cv2.estimateAffinePartial2D(x, y, ransacReprojThreshold=30)
    if found is None:
        raise ValueError("the points seen in both images follow no common map")
    return torch.from_numpy(np.vstack([found, [0, 0, 1]]))


def _along_lines(matches: Matches, F: Float[Tensor, "3 3"], H: Float[Tensor, "3 3"]) -> Float[Tensor, " n"]:
    """How far along its line each match is from the point of the line nearest to H x, pixels of beta."""
    line = epipolar_lines(F, matches.alpha)
    from_map = matches.beta - apply_homography(H, matches.alpha).x
    return (from_map * torch.stack([-line[:, 1], line[:, 0]], -1)).sum(-1)


def _percentiles(values: Tensor, share: float) -> tuple[float, float]:
    low, high = values.quantile(values.new_tensor([share, 1 - share])).tolist()
    return low, high


def _nearest(a: NDArray[np.float32], b: NDArray[np.float32]) -> dict[int, int]:
    found = cv2.BFMatcher().knnMatch(a, b, k=2)
    return {m.queryIdx: m.trainIdx for m, second in found if m.distance < RATIO * second.distance}
