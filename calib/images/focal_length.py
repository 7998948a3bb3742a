"""A common focal length of two cameras of one kind, from matched points alone, where these determine it.

F has seven degrees of freedom and a pose five, so that two views determine a focal length unless their axes
are nearly parallel or meet at equal distances (Hartley and Zisserman, section 19.3.1). The unknown rest of
the cameras takes its share of the residuals: principal points, a radial term, what it leaves of the lenses,
and the ratio of the focal lengths. Parameters are in units of their prior standard deviations, as in
`least_squares`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, Link, Pose, Rig, View, intrinsics, rotation_from_vector
from arraygeom.pixels import HW
from arraygeom.runtime.threads import torch_in_one_thread

from .depth_change import share_outside
from .least_squares import cost, most_probable, noise_scale, posterior_covariance, shifts_left_out
from .matches import PointMatches
from .residuals import HELD_OUT, PARTS, displacements, held_out_parts, nearer, parts_of
from .self_calibration import FOCAL_SHARE, initial_poses

SIGMA = {"focal": 0.5, "ratio": 0.01, "pose": 3.0, "centre": 0.03, "radial": 0.1, "systematic": 0.3}
"""Prior standard deviations: of the logarithm of the focal length relative to the assumed one, and of the
ratio of both; of the pose in radians, with a baseline of 1; of principal points as a share of the longer
side; of the radial term at half the longer side; of the smooth displacements that it leaves, pixels at the
image's corner."""
SEARCHED = (0.5, 1.0, 2.0)
"""Multiples of the assumed focal length from which the fit starts, each from its two best poses."""
STEPS = 30
POINTS = 500
"""Number of points used at most: more hardly determine it better."""
LARGEST_DEVIATION = 0.25
"""Largest relative standard deviation of a focal length that is determined."""
SIGNIFICANT = 3.0
"""Least difference from the assumed focal length, in standard deviations, of one that is determined; held-out
points must also be nearer their lines with it."""
BEHIND = 0.5
"""Largest share of points behind a camera: of mirrored poses all are."""


@torch_in_one_thread()
def common_focal_length(views: Mapping[str, View], link: Link, matches: PointMatches) -> FocalFit | None:
    """Estimate the focal length that two cameras (alpha, beta) of one image size share, if the points
    determine it.

    Pixels are taken to be square. Lenses of the views are not applied: the fit has a radial term.

    Args:
        views: the two views by name, alpha first; only their sizes are used.
        link: F between the views, and H if known, from which poses start.
        matches: matched points, pixels; ten at least, which is not checked.

    Returns:
        The fit; None where the points do not distinguish it from the assumed focal length, or not well, and
        where `fit_focal_length` returns None.

    Raises:
        ValueError: for another number of views than two.
    """
    fit = fit_focal_length(views, link, matches)
    return fit if fit is not None and fit.found else None


def fit_focal_length(views: Mapping[str, View], link: Link, matches: PointMatches) -> FocalFit | None:
    """Fit a common focal length from several starts, whether or not the points determine it.

    At most `POINTS` points are used, the same ones for the same number of matches.

    Args:
        views: the two views, as `common_focal_length` takes them; so are `link` and `matches`.

    Returns:
        The most probable fit; None for views of different sizes, a mirrored one, or points of which no pose
        has half in front of both cameras.

    Raises:
        ValueError: for another number of views than two.
    """
    hw, hw_beta = (view.hw for view in views.values())
    if hw != hw_beta or _is_mirrored(matches):
        return None
    kept = torch.randperm(len(matches.alpha), generator=torch.Generator().manual_seed(0))[:POINTS]
    points = PointMatches(*(x[kept].double() for x in matches))
    fits: list[FocalFit] = []
    for factor in SEARCHED:
        K = intrinsics(factor * FOCAL_SHARE * max(hw), hw).double()
        starts = [TwoViews(hw, pose, points) for pose in initial_poses(points, link, K, K)]
        z = torch.zeros(len(starts[0].sigma), dtype=torch.float64)
        z[0] = math.log(factor) / SIGMA["focal"]
        ahead = [start for start in starts if start.is_ahead(z)]
        best = sorted(ahead, key=lambda start: cost(start.distances(z), z, 1.0))[:2]
        fits += [FocalFit(start, start.fitted(z)) for start in best]
    fits = [fit for fit in fits if fit.views.is_ahead(fit.z)]
    if not fits:
        return None
    left = [fit.views.distances(fit.z) for fit in fits]
    scale = min(noise_scale(r) for r in left)
    return min(zip(fits, left), key=lambda pair: cost(pair[1], pair[0].z, scale))[0]


def _is_mirrored(matches: PointMatches) -> bool:
    """Return True if beta's points are best fitted by an affine map that mirrors: no pose has such lines."""
    x = torch.cat([matches.alpha, torch.ones_like(matches.alpha[:, :1])], -1)
    return float(torch.linalg.det(torch.linalg.lstsq(x, matches.beta).solution[:2])) <= 0


@dataclass(frozen=True)
class TwoViews:
    """Model of two uncalibrated cameras of one image size, whose parameters are changes from a start.

    A change z has the log focal length, the log ratio of both, rotation (3), direction of the baseline (2),
    principal points (4), radial terms (their mean and half their difference) and displacements (8), all in
    prior standard deviations. At z = 0 the focal length is the assumed one (`FOCAL_SHARE` of the longer
    side), and the pose is `pose`.

    Attributes:
        hw: height and width of both images, pixels.
        pose: pose at the start, beta from alpha, with a baseline of 1.
        points: matched points, pixels, float64.
    """

    hw: HW
    pose: Pose
    points: PointMatches

    @cached_property
    def sigma(self) -> Float[Tensor, " k"]:
        """Prior standard deviation of each component of z."""
        centre, pose = SIGMA["centre"] * max(self.hw), SIGMA["pose"]
        parts = [SIGMA["focal"], SIGMA["ratio"], *[pose] * 5, *[centre] * 4, SIGMA["radial"]]
        left = [SIGMA["systematic"] / math.hypot(*self.hw) * 2, *[SIGMA["systematic"]] * 8]
        return torch.tensor(parts + left, dtype=torch.float64)

    @cached_property
    def basis(self) -> Float[Tensor, "3 3"]:
        """Matrix whose columns are two directions across the baseline, and the baseline's own."""
        across = torch.linalg.svd(self.pose.t[None]).Vh[1:]
        return torch.cat([across, self.pose.t[None]]).T

    @cached_property
    def centred(self) -> list[Tensor]:
        """Points of alpha and of beta relative to the images' centres, pixels."""
        h, w = self.hw
        return [x - x.new_tensor([(w - 1) / 2, (h - 1) / 2]) for x in self.points]

    @cached_property
    def smooth(self) -> list[Tensor]:
        """Smooth displacements of the points of alpha and of beta, (n, 2, 4), pixels."""
        return [displacements(self.hw, x) for x in self.points]

    def length(self, z: Tensor) -> Tensor:
        """Compute alpha's focal length after a change, pixels."""
        return FOCAL_SHARE * max(self.hw) * (self.sigma[0] * z[0]).exp()

    def moved(self, z: Tensor) -> Pose:
        """Compute the pose after a change, with a baseline of length 1."""
        change = self.sigma * z
        t = self.basis @ torch.cat([change[5:7], torch.ones_like(change[:1])])
        return Pose(rotation_from_vector(change[2:5]) @ self.pose.R, t / t.norm())

    def residuals(self, z: Float[Tensor, " k"]) -> list[Tensor]:
        """Return the distances as a list of one part, as `least_squares` takes them."""
        return [self.distances(z)]

    def distances(self, z: Float[Tensor, " k"]) -> Float[Tensor, " n"]:
        """Compute the Sampson distances of the points from their epipolar lines after a change z.

        Returns:
            Signed distances in pixels, differentiable in z.
        """
        change, pose = self.sigma * z, self.moved(z)
        f = self.length(z)
        rays = []
        lengths = f, f * change[1].exp()
        for i, (x, smooth, length) in enumerate(zip(self.centred, self.smooth, lengths)):
            x = x - change[7 + 2 * i : 9 + 2 * i] + smooth @ change[13 + 4 * i : 17 + 4 * i]
            radial = change[11] + (change[12] if i else -change[12])
            x = x * (1 + radial * (2 * x / max(self.hw)).square().sum(-1, keepdim=True))
            rays.append(torch.cat([x / length, torch.ones_like(x[:, :1])], -1))
        a, b = rays
        rotated = a @ pose.R.T
        line = torch.linalg.cross(pose.t.expand_as(rotated), rotated)
        line_alpha = torch.linalg.cross(b, pose.t.expand_as(b)) @ pose.R
        slopes = [lines[:, :2] / length for lines, length in zip((line_alpha, line), lengths)]
        return (b * line).sum(-1) / torch.cat(slopes, -1).square().sum(-1).clamp(min=1e-24).sqrt()

    def fitted(self, z: Tensor, *, fixed: int = 0) -> Tensor:
        """Compute the most probable change, starting at z.

        Args:
            fixed: number of leading components that keep their values.
        """
        return most_probable(self.residuals, z, torch.eye(len(z), dtype=z.dtype)[:, fixed:], steps=STEPS)

    def is_ahead(self, z: Tensor) -> bool:
        """Return True unless more than `BEHIND` of the points lie behind a camera."""
        alpha = Camera(
            hw=self.hw, K=intrinsics(float(self.length(z)), self.hw), cam_from_world=Pose.identity()
        )
        rig = Rig({"alpha": alpha, "beta": alpha.replace(cam_from_world=self.moved(z))})
        return not share_outside(rig, {("alpha", "beta"): self.points}) > BEHIND


@dataclass(frozen=True)
class FocalFit:
    """The most probable change of two views, and the focal length that it implies.

    Attributes:
        views: model of the two views.
        z: the change, in prior deviations, as `TwoViews` lists it.
    """

    views: TwoViews
    z: Float[Tensor, " k"]

    @property
    def length(self) -> float:
        """Focal length of alpha, pixels."""
        return float(self.views.length(self.z))

    @property
    def change(self) -> float:
        """Logarithm of the focal length relative to the assumed one."""
        return float(self.views.sigma[0] * self.z[0])

    @cached_property
    def deviation(self) -> float:
        """Relative standard deviation of the focal length: by the points' noise or, if larger, a jackknife
        over parts of the image."""
        residuals, z = self.views.residuals, self.z
        covariance = posterior_covariance(residuals, z)
        shifts = shifts_left_out(residuals, z, parts_of(self.views.hw, self.views.points.alpha))[:, 0]
        jackknife = (PARTS**2 - 1) / PARTS**2 * shifts.square().sum()
        return float(self.views.sigma[0] * torch.maximum(covariance[0, 0], jackknife).sqrt())

    def is_nearer(self) -> bool:
        """Return True if held-out points are significantly nearer their lines than with the assumed focal
        length; each of `HELD_OUT` parts is held out once, and the rest fitted again."""
        points, fold = self.views.points, held_out_parts(self.views.points)
        distances = torch.zeros(2, len(fold), dtype=torch.float64)
        for held_out in range(HELD_OUT):
            out = fold == held_out
            others = replace(self.views, points=points.only(~out))
            for row, first in enumerate((0.0, float(self.z[0]))):
                z = torch.cat([self.z.new_tensor([first]), self.z[1:]])
                distances[row, out] = self.views.distances(others.fitted(z, fixed=1))[out]
        return nearer(*distances)

    @property
    def found(self) -> bool:
        """True if the points distinguish the focal length from the assumed one and determine it well."""
        well = self.deviation <= LARGEST_DEVIATION and abs(self.change) >= SIGNIFICANT * self.deviation
        return well and self.is_nearer()
