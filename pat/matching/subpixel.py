"""Positions of alpha's pixels in beta: semi-global matching at half size, then at full size over few labels.

At half the size an object's edge is some two pixels off and a slope is in steps. Here each pixel chooses, at
full size, between labels around the least and around the greatest disparity of its neighbourhood at half the
size. A step of least squares and planes through the surfaces give a fraction of a pixel: for every second
pixel a plane, whose moments are gathered by the domain transform (Gastal and Oliveira 2011), to which a point
beyond an edge of the guide is far away.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from arraygeom import Segments
from arraygeom.pixels import HW

from ..media.filters import box_mean, numpy_of
from ..support.settings import size, tuned
from . import kernels
from .inputs import CONSISTENT, FINE, Extent, Inputs, Matches, at_matches, match_positions
from .normalisation import ComparedViews
from .semi_global import SemiGlobalSettings, Windows, geometry_of, matched_by_labels

FULL_SIZE = SemiGlobalSettings(step=20.0, jump=80.0, margin=48)
"""Penalties chosen on Middlebury's tune half; half the size, where a label is two pixels, has others."""


@dataclass(frozen=True)
class SubpixelSettings:
    """Settings of matching at full size, and to a fraction of a pixel.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    run: int = size(5, "Labels in a run, of which each pixel has two")
    neighbourhood: int = size(5, "Side of the neighbourhood at half the size, pixels")
    same: float = size(
        0.7, "Nearer matches at both sizes are of one surface, pixels; half or twice as much does as well"
    )
    step_radius: int = size(2, "Window of the step to a fraction of a pixel, where both views are sharp")
    gradient_radius: int = size(6, "Window around a pixel whose brightness moves its match, in gradients")
    most_step: float = size(0.25, "The most pixels of that step, there; half or twice as much does as well")
    flat: float = size(
        3e-6,
        "Slope of brightness (its square) along the segment at which that step is half as long, "
        "and a match weighs half in its surface; and across it, at which a displacement of beta counts half; "
        "half or twice as much does as well",
    )
    reach: float = size(24.0, "Pixels to which a surface's matches count; half or twice as much does as well")
    edge: float = tuned(
        0.5, "Middlebury, tune half, of .5 to 1: change of disparity as far as `reach`, where views are sharp"
    )
    surfaces: int = size(2, "How often surfaces are fitted, the second time within the first ones")
    level: float = size(
        0.005,
        "Variance of position, over reach^2, below which planes are level; "
        "half or twice as much does as well",
    )


SETTINGS = SubpixelSettings()


def matched_at_full_size(
    views: ComparedViews, segments: Segments, half: Float[Tensor, "b 1 h2 w2"]
) -> tuple[Float[Tensor, "b 1 h w"], Float[Tensor, "b 1 h2 w2"]]:
    """Match semi-globally at full size around the disparities at half the size, to a fraction of a pixel.

    Where the left-right check fails, disparity is diffused from where it passes.

    Args:
        views: alpha and beta at full size, equally bright and sharp.
        segments: segments of alpha's pixels.
        half: disparity at half the size, pixels of the full-size beta.

    Returns:
        Disparity in pixels of beta, and the left-right error, 0 to 1 (for 8 pixels), at half the size;
        detached.
    """
    alpha, beta = views.alpha, views.beta
    geometry = geometry_of(segments, len(alpha), (beta.shape[-2], beta.shape[-1]), factor=1)
    windows = Windows(np.stack([_runs(plane) for plane in numpy_of(half[:, 0])]), SETTINGS.run)
    labelled, measured = matched_by_labels(views, geometry, windows, FULL_SIZE, facts=1)
    disparity, unlike = labelled[:, None].to(alpha), measured.movedim(-1, 1).to(alpha)
    near = interpolate(half, scale_factor=FINE, mode="bilinear")
    return _precise(views, segments, disparity, unlike < CONSISTENT, near), avg_pool2d(unlike, FINE)


def _precise(
    views: ComparedViews, segments: Segments, disparity: Tensor, consistent: Tensor, rough: Tensor
) -> Float[Tensor, "b 1 h w"]:
    """Refine disparity to a fraction of a pixel.

    Where that of half the size (`rough`) is near, the mean of both; from there a step of least squares of the
    brightness around each pixel (Lucas and Kanade 1981); and the result on planes within surfaces. The less
    sharp beta is, the wider are windows, and the farther may steps be.
    """
    alpha, beta, guides, blurs = views
    near = consistent & ((disparity - rough).abs() < SETTINGS.same)
    start = torch.where(near, (disparity + rough) / 2, disparity)
    rise, rest = _compared(alpha, beta, segments, start)
    positions = []
    for i, blur in enumerate(blurs):
        one = slice(i, i + 1)
        common, slope = _agreement(rise[one], rest[one], round(SETTINGS.step_radius * (1 + blur)))
        step = (common / (slope + SETTINGS.flat) / (1 + blur)).clamp(-SETTINGS.most_step, SETTINGS.most_step)
        moved = start[one] + near[one] * (1 + blur) * step
        weight = torch.where(consistent[one], slope / (slope + SETTINGS.flat), 0.0) + 1e-5
        planes = numpy_of(moved[0, 0]), numpy_of(weight[0, 0]), guides[i]
        positions.append(_surfaces(*planes, SETTINGS.edge * (1 + blur)))
    return torch.from_numpy(np.stack(positions))[:, None].to(disparity)


def _surfaces(disparity: Plane, weight: Plane, brightness: NDArray[np.uint8], edge: float) -> Plane:
    """Return disparity on planes through it, parted by edges of alpha and by such a change of disparity."""
    (h, w), every, whole = disparity.shape, (slice(None, None, FINE),) * 2, disparity
    for _ in range(SETTINGS.surfaces):
        guide = np.stack([brightness[every] / np.float32(255), whole[every] / np.float32(edge)], -1)
        whole = Planes.through(disparity[every], weight[every], guide, SETTINGS.reach).at_pixels((h, w))
    return whole


def following(inputs: Inputs, matches: Matches) -> Matches:
    """Give `disparity` and `chosen` of matches gradients by the images and segments that require some.

    Returns:
        Matches of the same values; in a beta the given ones if alpha, its image and segments require none.

    Raises:
        ValueError: for a beta whose field is not of straight segments.
    """
    betas, alpha = [], inputs.alpha
    for beta, one in zip(inputs.betas, matches.betas):
        segments = beta.field.straight
        if any(x.requires_grad for x in (alpha, beta.image, segments.start, segments.end)):
            views = one.comparison.views(alpha, beta.image)
            chosen = None if one.chosen is None else with_gradients(views, segments, one.chosen)
            one = replace(one, disparity=with_gradients(views, segments, one.disparity), chosen=chosen)
        betas.append(one)
    return Matches(tuple(betas))


def with_gradients(
    views: ComparedViews, segments: Segments, disparity: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 1 h w"]:
    """Give a disparity the gradients of the best photometric agreement along the segments at each pixel.

    By the implicit function theorem: at the best agreement the least squares' step is zero, and stays so if
    the match moves by as much as images and segments move the step.

    Returns:
        The same disparity, pixels of beta, differentiable by images and segments.
    """
    step = _step(views, segments, disparity)
    return disparity + (step - step.detach())


def _step(views: ComparedViews, segments: Segments, disparity: Tensor) -> Float[Tensor, "b 1 h w"]:
    """Return one step towards the best agreement, pixels; its gradients hold where it is zero."""
    rise, rest = _compared(views.alpha, views.beta, segments, disparity)
    common, slope = _agreement(rise.detach(), rest, SETTINGS.gradient_radius)
    return common / (slope.detach() + SETTINGS.flat)


def _agreement(rise: Tensor, rest: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Return means within squares of rise times rest, and of the rise squared, both less means around."""
    rise, rest = (values - box_mean(values, 2 * radius) for values in (rise, rest))
    common, slope = box_mean(torch.cat([rise * rest, rise.square()], 1), radius).split(1, 1)
    return common, slope


def _compared(
    alpha: Float[Tensor, "b 1 h w"], beta: Float[Tensor, "b 1 hb wb"], segments: Segments, disparity: Tensor
) -> tuple[Float[Tensor, "b 1 h w"], Float[Tensor, "b 1 h w"]]:
    """Return beta's rise per pixel along its segment at each match, and alpha's excess over beta there."""
    across, down = (torch.gradient(beta, dim=side)[0] for side in (3, 2))
    still = Segments(segments.start.detach(), segments.end.detach(), segments.valid)
    extent = Extent.from_segments(segments)
    fixed = Extent(*(tensor.detach() for tensor in extent))
    there = at_matches(torch.cat([beta, across, down], 1), still, disparity, fixed)[0]
    sampled, across, down = there.split(1, 1)
    if segments.end.requires_grad or segments.start.requires_grad:
        # Along these slopes: those of bicubic sampling itself are half as much again at whole pixels.
        x, y = match_positions(segments, disparity, extent=extent).to(beta)[:, None].unbind(-1)
        sampled = sampled + across.detach() * (x - x.detach()) + down.detach() * (y - y.detach())
    towards = fixed.towards.movedim(-1, 1).to(beta)
    return across * towards[:, :1] + down * towards[:, 1:], alpha - sampled


def _runs(half: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return first labels (h, w, 2) of both runs at full size, from disparity at half the size.

    They are around the least of its neighbourhood and around the greatest, or, where these are near each
    other, one beside the other.
    """
    window, run = np.ones((SETTINGS.neighbourhood,) * 2, np.uint8), SETTINGS.run
    extremes = (f(half, window).repeat(FINE, 0).repeat(FINE, 1) for f in (cv2.erode, cv2.dilate))
    low, high = (np.rint(plane).astype(np.int32) - run // 2 for plane in extremes)
    low = np.maximum(np.where(high < low + run, (low + high) // 2 - run // 2, low), 0)
    return np.stack([low, np.maximum(high, low + run)], -1)


Plane = NDArray[np.float32]
"""Numbers of the pixels (h, w)."""


class Planes(NamedTuple):
    """Planes fitted around every second pixel in each direction, each attribute (h, w), float32.

    Attributes:
        value: value at the pixel.
        right: slope per full-size pixel to the right.
        down: slope per full-size pixel downwards.
        around: mean weight of the values around.
    """

    value: Plane
    right: Plane
    down: Plane
    around: Plane

    @classmethod
    def through(cls, values: Plane, weight: Plane, guide: NDArray[np.float32], reach: float) -> Planes:
        """Fit a plane around every pixel by weighted least squares, within edges of a guide.

        Args:
            values: values (h, w) of every second pixel.
            weight: their weights, at least 0.
            guide: image (h, w, c), float32; a change of 1 in it counts as far as `reach`.
            reach: full-size pixels to which values count.

        Returns:
            The planes; where no value reaches, `around` is about 0 and the rest means nothing.
        """
        reach /= FINE
        values, weight = (np.ascontiguousarray(plane, np.float32) for plane in (values, weight))
        centre = float(np.average(values, weights=weight + np.finfo(np.float32).tiny))  # for small numbers
        terms = np.empty((3, *values.shape, 4), np.float32)
        kernels.weighted_terms(values, weight, centre, reach, terms)
        over = cv2.ximgproc.createDTFilter(guide, reach, 1.0, cv2.ximgproc.DTF_RF)
        sums = (over.filter(term) for term in terms)
        planes = np.empty((4, *values.shape), np.float32)
        kernels.planes_through(*sums, centre, reach, SETTINGS.level, planes)
        return cls(*planes)

    def at_pixels(self, hw: HW) -> Plane:
        """Return the values at all pixels."""
        out = np.empty(hw, np.float32)
        kernels.at_pixels(*self[:3], out)
        return out


def repeated(plane: Plane, hw: HW) -> Plane:
    """Repeat a plane of every second pixel for those to its right and below it, too.

    Returns:
        The plane at all pixels.
    """
    return plane.repeat(FINE, 0).repeat(FINE, 1)[: hw[0], : hw[1]]
