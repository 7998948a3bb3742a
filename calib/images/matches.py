"""Points matched between two images, and the rough map and depth range of a rig that follow from them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from contextlib import suppress
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor

from arraygeom import Link, Pair, Rig, apply_homography, epipolar_distance, epipolar_lines, triangulate
from arraygeom.pixels import shift_matrix
from arraygeom.runtime.chunks import chunked
from arraygeom.runtime.progress import log_step

from .patch_matching import refine_points

LOG = logging.getLogger(__name__)

RATIO = 0.75
"""Largest distance of the best match as a share of the second best one's (Lowe 2004, section 7.1)."""
FEATURES = 6000
MATCHED_AT_ONCE = 1024
"""Number of features whose distances from all of the other image are held at once."""
ENOUGH = 20
"""Least number of consistent matches for any conclusion."""
FEWEST = 4
"""Least number of matches, clicked by hand say, that a homography is fitted to."""
CLICKED, BENT = 2.0, 0.02
"""Standard deviations of such points, pixels, and of how far the homography is from a similarity: shear,
aspect and perspective across the points' spread."""
LOCALISED = 1 / 3
"""A matched point's standard deviation, pixels, for its depth to be known: the middle of the bounds below."""
LOCALISATION_BOUNDS = (0.15, 0.2, 0.3, np.inf)
"""Bounds of the standard deviation of points, pixels, estimated from the residuals of patches around them."""
WELL_LOCALISED = 40
"""Number of points that must meet a bound for the others to be left out."""
MANY = 60
"""Number of consistent matches below which mirrored images are tried."""
AGREE = 5.0
"""Largest distance, in pixels, of a consistent match from its line: lenses distort lines."""
MATCHING_SHARE = 0.8
"""Rough share of the time that matching takes before something is fitted to the points."""
STILL = 0.05
"""Motion in pixels of nine points in ten below which two images are the same image."""


class PointMatches(NamedTuple):
    """Matched points of two images.

    Attributes:
        alpha: points (x, y) of alpha, pixels.
        beta: their positions in beta, pixels.
    """

    alpha: Float[Tensor, "n 2"]
    beta: Float[Tensor, "n 2"]

    def only(self, mask: Bool[Tensor, " n"]) -> PointMatches:
        """Return the matches selected by a mask."""
        return PointMatches(self.alpha[mask], self.beta[mask])


Pairs = Mapping[tuple[str, str], PointMatches]
"""Matches of pairs of cameras, by their names (alpha, beta)."""
Images = Mapping[str, Float[Tensor, "_ _ _"]]
"""One image (C, H, W) per camera, by name."""


def cameras_of(rig: Rig, pairs: Iterable[tuple[str, str]]) -> list[str]:
    """List the cameras of these pairs, in the rig's order."""
    among = {name for pair in pairs for name in pair}
    return [name for name in rig.names if name in among]


def image_sizes(images: Mapping[str, Tensor]) -> dict[str, tuple[int, int]]:
    """Check images for matching, and return their sizes.

    Returns:
        Height and width by camera.

    Raises:
        ValueError: in one line, for fewer than two images, and for one that is no float image (C, H, W).
    """
    if len(images) < 2:
        raise ValueError("matching needs the images of two cameras or more: give an image of each")
    for name, image in images.items():
        if image.ndim != 3 or 0 in image.shape or not image.is_floating_point():
            got = f"{str(image.dtype).removeprefix('torch.')} of shape {tuple(image.shape)}"
            raise ValueError(f"the image of '{name}' is {got}: wanted float32 (C, H, W) in 0..1")
    return {name: (image.shape[1], image.shape[2]) for name, image in images.items()}


def match_points(alpha: Float[Tensor, "_ h w"], beta: Float[Tensor, "_ hb wb"]) -> PointMatches:
    """Match mutually nearest SIFT features of both images' luminance that pass the ratio test.

    Images are compared as `contrast_equalised` makes them. Where patches around them correlate, beta's points
    are refined by least squares; if that gives `WELL_LOCALISED` points, the others are left out.

    Args:
        alpha: image (C, H, W) in 0..1.
        beta: image (C, H, W) in 0..1.

    Returns:
        The matches, in double precision; not yet checked against epipolar lines, possibly none.
    """
    return _match(detect_features(alpha), detect_features(beta))


class SiftFeatures(NamedTuple):
    """SIFT features of one image.

    Attributes:
        points: positions (n, 2), (x, y) in pixels.
        sizes: diameters (n), pixels.
        directions: orientations (n), radians.
        descriptors: descriptors (n, 128).
        image: luminance (h, w) with equalised contrast in which they were detected.
    """

    points: NDArray[np.float64]
    sizes: NDArray[np.float64]
    directions: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    image: NDArray[np.uint8]


def detect_features(image: Float[Tensor, "_ h w"]) -> SiftFeatures:
    """Detect SIFT features of an image as `contrast_equalised` makes it.

    Args:
        image: image (C, H, W) in 0..1.

    Returns:
        The strongest features, about `FEATURES` at most, possibly none.
    """
    even = contrast_equalised(image)
    sift = cv2.SIFT.create(FEATURES, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(even, np.empty(0, np.uint8))
    points = np.array([p.pt for p in keypoints], np.float64).reshape(-1, 2)
    sizes, angles = (
        np.array([getattr(p, name) for p in keypoints], np.float64) for name in ("size", "angle")
    )
    described = np.asarray(descriptors, np.float32) if len(keypoints) else np.zeros((0, 128), np.float32)
    return SiftFeatures(points, sizes, np.radians(angles), described, even)


def contrast_equalised(image: Float[Tensor, "_ h w"]) -> UInt8[NDArray, "h w"]:
    """Compute an image's luminance (without three bands, their mean) with equalised contrast (CLAHE).

    Args:
        image: image (C, H, W); values are clipped to 0..1.

    Returns:
        Bytes (H, W), on the CPU.
    """
    values = image.detach().cpu().movedim(0, -1).float().contiguous().numpy()
    grey = cv2.cvtColor(values, cv2.COLOR_RGB2GRAY) if image.shape[0] == 3 else values.mean(-1)
    return cv2.createCLAHE(3, (8, 8)).apply(np.rint(grey.clip(0, 1) * 255).astype(np.uint8))


def _match(a: SiftFeatures, b: SiftFeatures) -> PointMatches:
    """Match the mutually nearest features, beta's points refined by patches around them."""
    if len(a.points) < 2 or len(b.points) < 2:
        return PointMatches(*torch.zeros(2, 0, 2, dtype=torch.float64))
    forward, backward = _nearest(a.descriptors, b.descriptors), _nearest(b.descriptors, a.descriptors)
    mutual = (forward >= 0) & (backward[forward] == torch.arange(len(forward)))
    i, j = mutual.nonzero()[:, 0].numpy(), forward[mutual].numpy()
    ratio, angle = b.sizes[j] / a.sizes[i], b.directions[j] - a.directions[i]
    c, s = ratio * np.cos(angle), ratio * np.sin(angle)
    maps = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)
    y, deviation = refine_points(a.image, b.image, a.points[i], b.points[j], maps)
    kept = torch.from_numpy(_well_localised(deviation))
    return PointMatches(torch.from_numpy(a.points[i]), torch.from_numpy(y)).only(kept)


def _well_localised(deviation: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the best localised points, by the first bound that leaves `WELL_LOCALISED`; or all."""
    for bound in LOCALISATION_BOUNDS:
        if (kept := deviation < bound).sum() >= WELL_LOCALISED:
            return kept
    return np.ones_like(deviation, dtype=np.bool_)


def match_cameras(images: Images, *, alpha: str | None = None) -> dict[tuple[str, str], PointMatches]:
    """Match the images of every two cameras, and keep matches consistent with some fundamental matrix.

    Where there are fewer than `MANY`, the second image is tried mirrored: features are not invariant to it.

    Args:
        images: one image (C, H, W) in 0..1 per camera, by name.
        alpha: match only this camera's image with each of the others, alpha first; None for every two.

    Returns:
        Matches by pair of names; pairs with fewer than `ENOUGH` are left out.

    Raises:
        ValueError: in one line, for fewer than two images, one that is no float image (C, H, W), hardly any
            texture, two nearly equal images, no image of `alpha`, or if no pair is left.
    """
    image_sizes(images)
    if alpha is not None and alpha not in images:
        raise ValueError(f"no image of alpha, '{alpha}', only of {', '.join(images)}")
    pairs = list(
        combinations(images, 2) if alpha is None else ((alpha, name) for name in images if name != alpha)
    )
    total, features = len(images) + len(pairs), {}
    for i, (name, image) in enumerate(images.items()):
        log_step(LOG, i / total, "features of %s", name)
        features[name] = detect_features(image)
        if len(features[name].points) < ENOUGH:
            raise ValueError(
                f"the image of '{name}' has hardly any texture to match: take one in focus, with detail"
            )
    by_pair = {}
    for i, (a, b) in enumerate(pairs, len(images)):
        log_step(LOG, i / total, "matching %s and %s", a, b)
        by_pair[a, b] = _agreeing(features[a], features[b], images[b])
    consistent = {names: matches for names, matches in by_pair.items() if len(matches.alpha) >= ENOUGH}
    for (a, b), matches in consistent.items():
        displacement = float((matches.alpha - matches.beta).norm(dim=-1).quantile(0.9))
        if images[a].shape[1:] == images[b].shape[1:] and displacement < STILL:
            raise ValueError(f"the images of '{a}' and '{b}' are the same image: give each camera its own")
    if not consistent:
        (a, b), most = max(by_pair.items(), key=lambda item: len(item[1].alpha))
        raise ValueError(
            f"only {len(most.alpha)} points seen in both '{a}' and '{b}' agree, {ENOUGH} are needed: "
            "do the cameras see the same things, at the same time and in focus?"
        )
    return consistent


def _agreeing(a: SiftFeatures, b: SiftFeatures, image: Tensor) -> PointMatches:
    """Return the consistent matches; those of the mirrored image if they are more."""
    unmirrored = agreeing(_match(a, b))
    if len(unmirrored.alpha) >= MANY:
        return unmirrored
    x, y = agreeing(_match(a, detect_features(image.flip(-1))))
    mirrored = PointMatches(x, torch.stack([image.shape[-1] - 1 - y[:, 0], y[:, 1]], -1))
    return max(unmirrored, mirrored, key=lambda m: len(m.alpha))


def agreeing(matches: PointMatches) -> PointMatches:
    """Select matches that some fundamental matrix puts within `AGREE` pixels of their lines.

    Returns:
        The consistent matches, which may be few; none if fewer than `ENOUGH` are given or no matrix fits.
    """
    if len(matches.alpha) >= ENOUGH:
        with suppress(ValueError):
            return near_lines(matches, fit_fundamental(matches), within=AGREE)
    return matches.only(torch.zeros(len(matches.alpha), dtype=torch.bool))


def agreeing_pairs(pairs: Pairs) -> dict[tuple[str, str], PointMatches]:
    """Select matches of another source that agree with some fundamental matrix.

    Returns:
        Consistent matches by pair of names; pairs with fewer than `ENOUGH` are left out.

    Raises:
        ValueError: if no pair has `ENOUGH`.
    """
    agreed = {names: agreeing(matches) for names, matches in pairs.items()}
    consistent = {names: matches for names, matches in agreed.items() if len(matches.alpha) >= ENOUGH}
    if not consistent:
        most = max((len(matches.alpha) for matches in agreed.values()), default=0)
        raise ValueError(
            f"only {most} of the given matches agree with any rig, "
            f"{ENOUGH} are needed: are they of these images?"
        )
    return consistent


def near_lines(matches: PointMatches, F: Float[Tensor, "3 3"], *, within: float) -> PointMatches:
    """Select the matches within so many pixels of their epipolar line in beta."""
    return matches.only(line_distance(matches, F) <= within)


def line_distance(matches: PointMatches, F: Float[Tensor, "3 3"]) -> Float[Tensor, " n"]:
    """Compute the distance of each match from its epipolar line, in beta's pixels."""
    return epipolar_distance(F.to(matches.alpha), *matches).abs()


class FittedLink(NamedTuple):
    """Link of two views that is fitted to matches.

    Attributes:
        link: F, and as H a similarity from which the matches lie as far to one side along their lines as to
            the other (in an `UncalibratedRig` perhaps a homography).
        matches: the consistent matches, of the undistorted images if there are lenses.
        displacement: pixels of beta along the lines, to either side of H x, within which 98 % of the matches
            lie.
    """

    link: Link
    matches: PointMatches
    displacement: float


def fit_link(matches: PointMatches, F: Float[Tensor, "3 3"], *, within: float = 6.0) -> FittedLink:
    """Improve F, and fit a rough map H, by the matches near their epipolar lines.

    F is fitted as by `fit_fundamental`.

    Args:
        matches: undistorted points.
        F: fundamental matrix to start from, beta from alpha.
        within: pixels of beta from its line up to which a match is used.

    Returns:
        The link with the matches within 3 px of its lines.

    Raises:
        ValueError: for fewer than `ENOUGH` matches within `within`, or then within 3 px of the new lines, or
            no F or no similarity that fits them.
    """
    near = near_lines(matches, F, within=within)
    fitted = fit_fundamental(near) if len(near.alpha) >= ENOUGH else F
    return _with_rough_map(near_lines(near, fitted, within=3), fitted)


def with_map(pair: Pair, matches: PointMatches) -> FittedLink:
    """Fit a rough map of points near their lines to the pair's F, which stays.

    Args:
        matches: distorted points; those within 3 px of their lines are used.

    Returns:
        The link with these matches, undistorted.

    Raises:
        ValueError: for fewer than `ENOUGH` of these, no similarity that fits them, or a pair without F or
            cameras.
    """
    F = pair.fundamental
    return _with_rough_map(near_lines(undistort_matches(pair, matches), F, within=3), F)


def _with_rough_map(matches: PointMatches, F: Tensor) -> FittedLink:
    """Fit H by RANSAC to 30 px, then shift it along the lines' mean direction into the points' middle."""
    if len(matches.alpha) < ENOUGH:
        raise ValueError(
            f"only {len(matches.alpha)} points seen in both images agree with F: does it belong to them?"
        )
    x, y = (points.numpy() for points in matches)
    affine, _ = cv2.estimateAffinePartial2D(x, y, ransacReprojThreshold=30)
    if affine is None:
        raise ValueError("no similarity fits the points seen in both images")
    H = torch.from_numpy(np.vstack([affine, [0, 0, 1]]))
    line = epipolar_lines(F, matches.alpha)
    along = torch.stack([-line[:, 1], line[:, 0]], -1)

    def extent(H: Tensor) -> tuple[float, float]:
        return _percentiles(((matches.beta - apply_homography(H, matches.alpha).x) * along).sum(-1), 0.01)

    shift = along.mean(0) * sum(extent(H)) / 2
    H = shift_matrix(*(-shift).tolist()).to(H) @ H
    low, high = extent(H)
    return FittedLink(Link(F, H), matches, max(-low, high))


def undistort_matches(pair: Pair, matches: PointMatches) -> PointMatches:
    """Return the undistorted points, without those outside the domain of the lens models."""
    (x, x_valid), (y, y_valid) = pair.alpha.undistort(matches.alpha), pair.beta.undistort(matches.beta)
    return PointMatches(x, y).only(x_valid & y_valid)


def depths_near_lines(pair: Pair, matches: PointMatches, *, within: float) -> Float[Tensor, " m"]:
    """Triangulate the depths in alpha of those points that are within so many pixels of their lines and in
    front.

    Args:
        pair: calibrated pair.
        matches: points of the images as recorded, distorted.
        within: pixels of the undistorted beta.

    Returns:
        Depths (m) in the rig's unit, float64, of these points alone, possibly none; points too far for their
        depth to be known are left out.

    Raises:
        ValueError: for an uncalibrated pair.
    """
    undistorted = PointMatches(pair.alpha.undistort(matches.alpha)[0], pair.beta.undistort(matches.beta)[0])
    near = matches.only(line_distance(undistorted, pair.fundamental) <= within)
    cameras = [camera.to(torch.float64) for camera in pair.cameras]
    triangulated = triangulate(cameras, torch.stack(near), deviation=LOCALISED, residual=within)
    return cameras[0].cam_from_world.apply(triangulated.X)[triangulated.valid, 2]


def seen_depths(pair: Pair, matches: PointMatches) -> tuple[float, float]:
    """Estimate the depth bounds of matched points, in the rig's unit, in front of alpha.

    Points within 3 px of their lines count, that are in front and near enough for their depth to be known.

    Returns:
        (near, far): 0.9 of the nearest and 1.25 of the farthest depth, without the outermost 2 % of the
        points to either side.

    Raises:
        ValueError: for fewer than `ENOUGH` such points, or an uncalibrated pair.
    """
    depth = depths_near_lines(pair, matches, within=3.0)
    if len(depth) < ENOUGH:
        raise ValueError(
            f"only {len(depth)} points seen in both images fit the calibration: does it belong to them?"
        )
    low, high = _percentiles(depth, 0.02)
    return 0.9 * low, 1.25 * high


def depth_seen(rig: Rig, pairs: Pairs) -> tuple[float, float] | None:
    """Estimate the depth bounds of the matched points of all calibrated pairs together.

    Pairs with a link are left out.

    Returns:
        Near and far along the axis of each pair's alpha, in the rig's unit, with the margins of
        `seen_depths`; None if no pair is calibrated and has enough points.

    Raises:
        ValueError: for a camera that the rig lacks.
    """
    depths = []
    for names, matches in pairs.items():
        if (pair := rig.pair(*names)).calibrated and pair.link is None:
            with suppress(ValueError):
                depths.append(seen_depths(pair, matches))
    return (min(near for near, _ in depths), max(far for _, far in depths)) if depths else None


def fit_fundamental(matches: PointMatches) -> Float[Tensor, "3 3"]:
    """Fit F, beta from alpha, by MAGSAC++ (Barath et al. 2020) to 1 px, or else by RANSAC.

    Returns:
        F with y^T F x = 0 for pixels x of alpha and y of beta, in double precision.

    Raises:
        ValueError: if none fits.
    """
    x, y = (points.numpy() for points in matches)
    F = None
    for method in (cv2.USAC_MAGSAC, cv2.FM_RANSAC):
        with suppress(cv2.error):
            F, _ = cv2.findFundamentalMat(x, y, method, 1.0, 0.999, 10_000)
        if F is not None and F.shape == (3, 3):
            return torch.from_numpy(F)
    raise ValueError("no fundamental matrix fits the points seen in both images")


def fit_homography(matches: PointMatches) -> Float[Tensor, "3 3"]:
    """Fit H to a few points, as near to a similarity as they allow; wrong ones among them count little.

    Returns:
        H with beta ~ H alpha, float64, without gradient.

    Raises:
        ValueError: for fewer than `FEWEST` points, points in one spot, and points that no similarity fits.
    """
    from scipy.optimize import least_squares  # here, as it takes long to import

    if len(matches.alpha) < FEWEST:
        raise ValueError(
            f"only {len(matches.alpha)} points are given for two images: give {FEWEST} or more; {ENOUGH} say "
            "where lines are"
        )
    (to_x, x), (to_y, y) = (_evened(points.double().numpy()) for points in matches)
    similarity, _ = cv2.estimateAffinePartial2D(x, y, method=cv2.LMEDS)
    if similarity is None:
        raise ValueError("no similarity maps the given points to one another: are they of these images?")

    def homography(h: NDArray[np.float64]) -> NDArray[np.float64]:
        a, b, p, q, tx, ty, g, k = h
        return np.array([[a + p, q - b, tx], [b + q, a - p, ty], [g, k, 1]])

    def errors(h: NDArray[np.float64]) -> NDArray[np.float64]:
        projected = np.c_[x, np.ones(len(x))] @ homography(h).T
        residual = (projected[:, :2] / projected[:, 2:] - y) / (CLICKED * to_y[0, 0])
        return np.concatenate([residual.ravel(), h[[2, 3, 6, 7]] / BENT])

    (a, _, tx), (b, _, ty) = similarity
    H = homography(least_squares(errors, [a, b, 0, 0, tx, ty, 0, 0], loss="cauchy").x)
    return torch.from_numpy(np.linalg.inv(to_y) @ H @ to_x)


def _evened(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A map of pixels to a mean of 0 and a spread of 1, and the points (n, 2) by it."""
    spread = float(points.std(0).max())
    if spread < 1:
        raise ValueError("all given points are in one spot: give some all over the images")
    x, y = points.mean(0)
    return np.array([[1, 0, -x], [0, 1, -y], [0, 0, spread]]) / spread, (points - [x, y]) / spread


def _percentiles(values: Tensor, share: float) -> tuple[float, float]:
    low, high = values.quantile(values.new_tensor([share, 1 - share])).tolist()
    return low, high


def _nearest(a: NDArray[np.float32], b: NDArray[np.float32]) -> Int[Tensor, " n"]:
    """Return for each row of `a` the index of the nearest of `b` if it passes the ratio test, else -1.

    By matrix products, as they are several times faster than OpenCV's matcher; for SIFT's whole numbers they
    are exact.
    """
    others = torch.from_numpy(b)
    power = others.square().sum(1)

    def nearest_of(rows: Tensor) -> Tensor:
        squared = power - 2 * rows @ others.T + rows.square().sum(1, keepdim=True)
        least, nearest = squared.min(1)
        second = squared.scatter_(1, nearest[:, None], torch.inf).amin(1)
        return torch.where(least.clamp(min=0) < RATIO**2 * second, nearest, -1)

    return chunked(nearest_of, torch.from_numpy(a), rows=MATCHED_AT_ONCE, axis=0)
