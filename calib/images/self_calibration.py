"""Calibrated pairs from images alone: focal lengths given or assumed, poses and the rest from matches.

Points determine the epipolar lines, which are as good as with a calibration. They do not determine the scale
of the scene, and focal lengths only poorly: depths are multiples of the baseline, and proportional to the
assumed focal length.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, LensView, Link, Pair, Pose, Rig, View, intrinsics, rotation_from_vector
from arraygeom.pixels import map_homogeneous
from arraygeom.runtime.text import UNSCALED, angle
from arraygeom.runtime.threads import torch_in_one_thread

from .lenses import with_lens_of
from .matches import (
    ENOUGH,
    Images,
    PointMatches,
    contrast_equalised,
    depths_near_lines,
    line_distance,
    near_lines,
    undistort_matches,
)
from .patch_matching import refine_points
from .refinement import refine_matches
from .residuals import median_off

LOG = logging.getLogger(__name__)

FOCAL_SHARE = 1.2
"""Assumed focal length as a share of the image's longer side: that of a view 45 degrees wide."""
SIGMA = {"rotation": math.radians(3), "translation": 0.3, "focal": 0.05}
CENTRE_SHARE = 0.05
"""Standard deviation of the principal point, as a share of the longer side. Those in `SIGMA` are radians, a
share of the baseline, and a share of the focal length."""
SHORTEST = 1e-12
"""Least length of a baseline of 1 after refinement: the direction of a shorter one is rounding."""
NEAR_LINE = 2.0
"""Distance in pixels from their lines up to which points are used."""
AS_GOOD = 1.5
SLACK = 0.1
"""Pixels of tolerance: a calibrated pair is accepted if points are at most `AS_GOOD` times as far from its
lines as from those of F alone, and `SLACK` pixels more."""
ALIKE = 8.0
ALIKE_SLACK = 0.03
"""Pixels of tolerance: poses count as equal whose points are farther from their lines than those of the best
by at most the share `ALIKE` / sqrt(number of points), and `ALIKE_SLACK` more. Points do not distinguish a
rotation from a translation where they are few or far, nor the side that beta is on. Of those with most points
in front of the cameras, the smallest rotation is taken."""
OUTLYING = 8.0
"""Distance from the median inverse depth, in median deviations, beyond which a match is wrong."""
MARGIN, LEAST_MARGIN = 1.0, 0.12
"""Share of the range of inverse depths by which depth bounds extend it, and the least extension as a
disparity, a share of beta's longer side: points may all be on one surface, and too wide a range hardly costs
quality."""
DENSE_POINTS = 2000
SPACING = 4
"""Least distance of dense points, pixels; `DENSE_POINTS` is their largest number."""
LEAST_CONFIDENCE = 0.5
WELL_LOCALISED = 0.3
"""Largest standard deviation of a dense point, pixels."""


class RefinedPair(NamedTuple):
    """A calibrated pair as a rig of two cameras, with the depth range of the points that determine it.

    Attributes:
        rig: the two cameras, alpha at the origin, with the depth range of the points.
        points: number of the points by which the depth range and `distance` are measured.
        distance: their median distance from the rig's lines, pixels of beta.
        exact: True if these lines fit as well as those of F alone; if False, the rig serves for rough depths,
            and the lines should be those of F.
    """

    rig: Rig
    points: int
    distance: float
    exact: bool = True


@torch_in_one_thread()
def self_calibrated(
    views: Mapping[str, View], link: Link, matches: PointMatches, *, focal: Mapping[str, float]
) -> RefinedPair | None:
    """Calibrate alpha and beta so that their epipolar lines are as near those of `link` as possible.

    Alpha is at the origin with the principal point in the middle, and the baseline is 1. Cameras have the
    lenses of their views; the pair then is not `exact`.

    Args:
        views: alpha's and beta's view, by name, alpha first; a lens must be a `Distortion`.
        link: F between the undistorted views, not 0, and H if known: the ratio of focal lengths, and a
            rotation by quarter turns.
        matches: points of the images as recorded, distorted.
        focal: focal lengths in pixels by camera; a missing one follows from the other and H, or is assumed.

    Returns:
        The pair, with the depth range of the points; None for points without parallax by any pose, and fewer
        than `ENOUGH` within `NEAR_LINE` pixels of their lines.

    Raises:
        ValueError: for another number of views than two, and points that are all in one spot.
    """
    alpha, beta = views
    lenses = {
        n: view for n, view in views.items() if isinstance(view, LensView) and view.distortion is not None
    }
    matches = undistort_matches(Pair(views[alpha], views[beta]), matches)
    lengths = _focal_lengths(views, link, focal)
    K = {name: intrinsics(length, views[name].hw) for name, length in lengths.items()}
    near = near_lines(matches, link.F, within=NEAR_LINE)
    if len(near.alpha) < ENOUGH:
        return None
    best = AS_GOOD * float(line_distance(near, link.F).median()) + SLACK
    trials: list[RefinedPair] = []
    for beta_from_alpha in initial_poses(near, link, K[alpha], K[beta]):
        cameras = {
            name: Camera(hw=view.hw, sensor=view.sensor, K=K[name], cam_from_world=pose)
            for (name, view), pose in zip(views.items(), (Pose.identity(), beta_from_alpha))
        }
        LOG.info("calibrating %s and %s, pose %d", alpha, beta, len(trials) + 1)
        trial = _refined_pair(Rig(cameras), matches, near, fixed=("centre",) if lenses else ())
        if trial is not None:
            trials.append(trial)
    if not trials:
        return None
    least = min(trial.distance for trial in trials)
    fitting = [t for t in trials if t.distance <= (1 + ALIKE / math.sqrt(t.points)) * least + ALIKE_SLACK]
    in_front = [len(depths_near_lines(_pair(t.rig), near, within=NEAR_LINE)) for t in fitting]
    fitting = [t for t, count in zip(fitting, in_front) if 2 * count > max(in_front)]
    upright = _upright(link)
    upright_trial = min(fitting, key=lambda t: float(angle(_pair(t.rig).beta_from_alpha.R.T @ upright)))
    rig = upright_trial.rig
    for name, view in lenses.items():
        rig = rig.with_camera(name, with_lens_of(rig[name], view))
    return upright_trial._replace(rig=rig, exact=upright_trial.distance <= best and not lenses)


@torch_in_one_thread()
def refined_by_depth(
    pair: RefinedPair, images: Images, depth: Float[Tensor, "h w"], confidence: Float[Tensor, "h w"]
) -> RefinedPair:
    """Refine a pair by dense matches: alpha's pixels at the places that a fusion gave them, improved by least
    squares.

    Args:
        images: one image (C, H, W) in 0..1 per camera, of the pair's sizes, by name.
        depth: depth of all of alpha's pixels, in the pair's unit; NaN where unknown.
        confidence: confidence of these, 0..1.

    Returns:
        The refined pair, always marked `exact`; the same pair if there are fewer than 5 `ENOUGH` matches, or
        it has no parallax.

    Raises:
        ValueError: for points that are all in one spot.
        KeyError: for a camera without an image.
    """
    matches = dense_matches(pair.rig, images, depth, confidence)
    if len(matches.alpha) < 5 * ENOUGH:
        return pair
    LOG.info("refining %s and %s by %d points", *pair.rig.names, len(matches.alpha))
    return _refined_pair(pair.rig, matches, matches) or pair


def joined(pairs: Mapping[str, RefinedPair], scales: Mapping[str, float]) -> Rig:
    """Join calibrated pairs with one alpha into one rig.

    Args:
        pairs: pairs by beta's name, with depth ranges, one at least.
        scales: factor of each pair's lengths, by beta's name, for all of them.

    Returns:
        The rig named `UNSCALED`: alpha as in the first pair, then the betas, with a depth range that includes
        theirs.

    Raises:
        KeyError: for a pair without a scale.
    """
    rigs = {name: pair.rig.scaled(scales[name]) for name, pair in pairs.items()}
    first = next(iter(rigs.values()))
    rig = Rig({first.names[0]: first[first.names[0]]})
    for name, scaled in rigs.items():
        rig = rig.with_camera(name, scaled[scaled.names[1]])
    near, far = zip(*([float(bound) for bound in scaled.depth or ()] for scaled in rigs.values()))
    return rig.replace(depth=(min(near), max(far)), name=UNSCALED)


def dense_matches(
    rig: Rig, images: Images, depth: Float[Tensor, "h w"], confidence: Float[Tensor, "h w"]
) -> PointMatches:
    """Match points of texture in alpha with beta, from a depth map, refined by least squares.

    Args:
        rig: two cameras, alpha first.
        images: one image (C, H, W) in 0..1 per camera, of the rig's sizes.
        depth: depth of all of alpha's pixels, in the rig's unit; pixels without finite depth are left out.
        confidence: confidence of these, 0..1; pixels up to `LEAST_CONFIDENCE` are left out.

    Returns:
        The matches whose position is known to `WELL_LOCALISED` pixels, float64; possibly none.

    Raises:
        ValueError: for an uncalibrated rig.
        KeyError: for a camera without an image.
    """
    alpha, beta = (camera.to(torch.float64) for camera in _pair(rig).cameras)
    alpha_image, beta_image = (contrast_equalised(images[name]) for name in rig.names)
    corners = cv2.goodFeaturesToTrack(alpha_image, DENSE_POINTS, 1e-4, SPACING)
    x = torch.from_numpy(np.zeros((0, 2)) if corners is None else corners[:, 0].astype(np.float64))
    column, row = x.round().long().unbind(-1)
    z = depth[row, column].double()
    reliable = z.isfinite() & (confidence[row, column] > LEAST_CONFIDENCE)
    x, z = x[reliable], z[reliable]

    def in_beta(x: Tensor) -> Tensor:
        return beta.project(alpha.unproject(x, z)).x

    y, step = in_beta(x), torch.eye(2, dtype=torch.float64)
    maps = torch.stack([in_beta(x + step[0]) - y, in_beta(x + step[1]) - y], -1)
    refined, deviation = refine_points(alpha_image, beta_image, x.numpy(), y.numpy(), maps.numpy())
    return PointMatches(x, torch.from_numpy(refined)).only(torch.from_numpy(deviation < WELL_LOCALISED))


def depth_bounds(rig: Rig, matches: PointMatches) -> tuple[float, float] | None:
    """Estimate near and far of the matched points of a rig of two cameras, extended.

    Points more than `NEAR_LINE` pixels off their lines are left out.

    Args:
        matches: points of the rig's first camera (alpha) and its second.

    Returns:
        Depths along the first camera's axis in the rig's unit, far possibly infinite; None for fewer than
        `ENOUGH` points with parallax.

    Raises:
        ValueError: for an uncalibrated rig.
    """
    pair = _pair(rig)
    inverse = 1 / depths_near_lines(pair, matches, within=NEAR_LINE)
    if len(inverse) < ENOUGH:
        return None
    off = (inverse - inverse.median()).abs()
    inverse = inverse[off <= OUTLYING * off.median() + 1e-9]
    low, high = inverse.quantile(inverse.new_tensor([0.01, 0.99])).tolist()
    baseline = float(pair.beta_from_alpha.t.norm())
    least = LEAST_MARGIN * max(pair.beta.hw) / (float(pair.cameras[1].K[0, 0]) * baseline)
    more = max(MARGIN * (high - low), least)
    return 1 / (high + more), math.inf if low <= more else 1 / (low - more)


def _focal_lengths(views: Mapping[str, View], link: Link, focal: Mapping[str, float]) -> dict[str, float]:
    """Return focal lengths in pixels: given, or by the ratio of image scales to the other's, or assumed."""
    alpha, beta = views
    ratio = (
        1.0 if link.H is None else float(torch.linalg.det(link.H[:2, :2]).abs().sqrt() / link.H[2, 2].abs())
    )
    assumed = focal[beta] / ratio if beta in focal else FOCAL_SHARE * max(views[alpha].hw)
    alpha_focal = focal.get(alpha, assumed)
    return {alpha: alpha_focal, beta: focal.get(beta, alpha_focal * ratio)}


def initial_poses(
    matches: PointMatches, link: Link, K: Float[Tensor, "3 3"], K_beta: Float[Tensor, "3 3"]
) -> list[Pose]:
    """List poses of beta, with baselines of 1, from which to fit: parallel axes, by F, by an essential
    matrix.

    With parallel axes beta is to either side along the direction in which most points differ.

    Args:
        matches: points of alpha and beta, undistorted, float64.
        link: link of the two views, F and, for a rotation by quarter turns, H.
        K: alpha's intrinsics, float64.
        K_beta: beta's intrinsics, float64.

    Returns:
        Two to four poses, beta from alpha, float64.

    Raises:
        IndexError: for no points.
    """
    R, rays = _upright(link), [torch.linalg.inv(k) for k in (K, K_beta)]
    x, y = (map_homogeneous(inverse, points)[..., :2] for inverse, points in zip(rays, matches))
    flow = y - map_homogeneous(R @ rays[0], matches.alpha)[..., :2]
    _, _, axes = torch.linalg.svd(flow - flow.median(0).values)
    t = torch.cat([axes[0], axes.new_zeros(1)])
    poses = [Pose(R, t), Pose(R, -t)]
    a, b, threshold = x.numpy(), y.numpy(), 1 / float(K_beta[0, 0])
    fitted, _ = cv2.findEssentialMat(a, b, np.eye(3), method=cv2.RANSAC, threshold=threshold)
    for E in ((K_beta.T @ link.F @ K).numpy(), fitted):
        if E is not None and E.shape == (3, 3):
            _, R_of_E, t_of_E, _ = cv2.recoverPose(E, a, b, np.eye(3))
            poses.append(Pose(torch.from_numpy(R_of_E), torch.from_numpy(t_of_E[:, 0])))
    return poses


def _upright(link: Link) -> Float[Tensor, "3 3"]:
    """Return the rotation about the axis, in steps of 90 degrees, of beta's image against alpha's."""
    H = torch.eye(3) if link.H is None else link.H
    steps = round(math.atan2(float(H[1, 0] / H[2, 2]), float(H[0, 0] / H[2, 2])) / (math.pi / 2))
    return rotation_from_vector(torch.tensor([0.0, 0.0, steps * math.pi / 2], dtype=torch.float64))


def _refined_pair(
    rig: Rig, matches: PointMatches, near: PointMatches, *, fixed: Sequence[str] = ()
) -> RefinedPair | None:
    """Refine a pair by matches, with distance and depths by `near`; None without parallax, or if the
    baseline, whose length matches do not determine, becomes shorter than `SHORTEST`."""
    alpha, beta = rig.names
    free = [f"{beta}.{kind}" for kind in (*SIGMA, "centre") if kind not in fixed]
    sigma = {**SIGMA, "centre": CENTRE_SHARE * max(rig[beta].hw)}
    refined = refine_matches(rig, [{(alpha, beta): matches}], free=free, sigma=sigma, keep_depth=False).rig
    length = float(refined[beta].t.norm())
    if not length > SHORTEST:
        return None
    refined = refined.scaled(1 / length)
    bounds = depth_bounds(refined, near)
    if bounds is None:
        return None
    off = median_off(refined, {(alpha, beta): near})
    return RefinedPair(refined.replace(depth=bounds), len(near.alpha), off)


def _pair(rig: Rig) -> Pair:
    return rig.pair(*rig.names)
