"""Filters of images: means within squares, local regressions, blurs, and smoothing that stops at edges."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from arraygeom.fields.protocol import compilable


def blurred(images: Float[Tensor, "b 1 h w"], blurs: Sequence[float]) -> Float[Tensor, "b 1 h w"]:
    """Blur each image of a batch by its own Gaussian.

    Args:
        blurs: standard deviation for each image, pixels, as many as images; 0 leaves one as it is.

    Returns:
        Images of the same shape and type, with gradients if they have some.
    """

    def one(image: Tensor, blur: float) -> Tensor:
        if not blur:
            return image
        if image.requires_grad:
            from kornia.filters import gaussian_blur2d

            side = round(8 * blur + 1) | 1  # as OpenCV chooses it
            rows, columns = (np.pad(np.arange(n), side // 2, mode="reflect") for n in image.shape)
            padded = image[rows[:, None], columns][None, None]  # kornia mirrors no more than the image itself
            there = slice(side // 2, -(side // 2))
            return gaussian_blur2d(padded, side, (blur, blur))[0, 0, there, there]
        return torch.from_numpy(cv2.GaussianBlur(numpy_of(image), (0, 0), blur)).to(image)

    return torch.stack([one(p[0], blur) for p, blur in zip(images, blurs)])[:, None]


def box_mean(x: Tensor, radius: int) -> Tensor:
    """Compute means of planes (*b, h, w) over squares of side 2 `radius` + 1, as far as on the image."""
    side = 2 * radius + 1
    if compilable(x) and not x.requires_grad:
        return _box_mean_of_numbers(x, radius)
    rows = avg_pool2d(x, (side, 1), 1, (radius, 0), count_include_pad=False)
    return avg_pool2d(rows, (1, side), 1, (0, radius), count_include_pad=False)


def _box_mean_of_numbers(x: Tensor, radius: int) -> Tensor:
    """Compute the same by OpenCV's running sums, in a third of the time."""
    planes = x.detach().contiguous().flatten(0, -3).numpy()
    before = (np.minimum(np.arange(n), radius) for n in planes.shape[1:])
    rows, columns = (some + some[::-1] + 1 for some in before)
    share = (1 / (rows[:, None] * columns)).astype(planes.dtype)
    out, side = np.empty_like(planes), (2 * radius + 1,) * 2
    for plane, target in zip(planes, out):
        sums = cv2.boxFilter(plane, -1, side, normalize=False, borderType=cv2.BORDER_CONSTANT)
        np.multiply(sums, share, out=target)
    return torch.from_numpy(out).view(x.shape)


class LocalMoments(NamedTuple):
    """Moments of bands and an image within squares around each pixel, as far as these are on the image.

    Attributes:
        bands: means of the bands (B, C, H, W).
        image: means of the image (B, 1, H, W).
        variance_of_bands: variances of the bands (B, C, H, W).
        variance_of_image: variances of the image (B, 1, H, W).
        covariance: covariances of each band with the image (B, C, H, W).
    """

    bands: Tensor
    image: Tensor
    variance_of_bands: Tensor
    variance_of_image: Tensor
    covariance: Tensor

    @classmethod
    def within(
        cls, radius: int, bands: Float[Tensor, "b c h w"], image: Float[Tensor, "b 1 h w"]
    ) -> LocalMoments:
        """Compute the moments within squares of so many pixels to either side."""
        mean = partial(box_mean, radius=radius)
        centre, middle = mean(bands), mean(image)
        variation = (mean(bands.square()) - centre.square()).clamp(min=0)
        variance = (mean(image.square()) - middle.square()).clamp(min=0)
        return cls(centre, middle, variation, variance, mean(bands * image) - centre * middle)

    def slope(self, floor: float) -> Float[Tensor, "b c h w"]:
        """Return the slope of the bands' regression on the image, whose variance the floor regularises."""
        return self.covariance / (self.variance_of_image + floor)


def filled(planes: NDArray, weight: NDArray, guide: NDArray, how: tuple[float, float]) -> NDArray:
    """Compute the weighted mean of planes over connected regions of a guide (Min et al. 2014).

    Args:
        planes: planes (c, h, w).
        weight: weight (h, w) of each pixel, above 0; 0 gives NaN where no other weight reaches.
        guide: image (h, w), uint8, whose edges bound the regions.
        how: strength of smoothing, and 8-bit difference of an edge.

    Returns:
        Planes (c, h, w), float32.
    """
    total, *sums = smoothed([weight, *(plane * weight for plane in planes)], guide, how)
    return np.stack([plane / total for plane in sums])


def smoothed(planes: Sequence[NDArray], guide: NDArray[np.uint8], how: tuple[float, float]) -> list[NDArray]:
    """Smooth planes where the guide shows no edge, by the fast global smoother (Min et al. 2014).

    Planes are smoothed one after the other: OpenCV's smoother is not thread-safe, but has threads of its own.

    Args:
        planes: planes (h, w).
        guide: image (h, w), uint8.
        how: strength of smoothing, and 8-bit difference of an edge.

    Returns:
        The smoothed planes, float32, in order.
    """
    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, *how)
    return [smoother.filter(np.ascontiguousarray(plane, np.float32)) for plane in planes]


def nearest_known(
    x: Float[Tensor, "*b h w"], valid: Bool[Tensor, "*b h w"], axis: int, back: bool
) -> Float[Tensor, "*b h w"]:
    """Replace each unknown pixel by the nearest known one along an axis.

    Args:
        x: planes.
        valid: mask of the known pixels.
        axis: axis to search along, -1 or -2.
        back: False to search towards lower indices, True towards higher ones.

    Returns:
        Planes of the same shape; a pixel keeps its value where none is known in that direction.
    """
    if back:
        return nearest_known(x.flip(axis), valid.flip(axis), axis, False).flip(axis)
    index = torch.arange(x.shape[axis], device=x.device).view(-1, *[1] * (-1 - axis))
    last = torch.where(valid, index, -1).cummax(axis).values
    return torch.where(last >= 0, x.gather(axis, last.clamp(min=0)), x)


def numpy_of(x: Tensor) -> NDArray[np.float32]:
    """Return a contiguous float32 array on the CPU, detached."""
    return np.ascontiguousarray(x.detach().cpu().numpy(), np.float32)
