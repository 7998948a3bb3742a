"""Undistortion: pinhole cameras in place of cameras with lenses, and images resampled to them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .camera import AnyLensView, Camera, LensView, View
from .checks import check_plane
from .pixels import HW, coarse_grid, map_homogeneous, pixel_coordinates, product
from .runtime.chunks import chunked
from .runtime.tracing import needs_numbers
from .sampling import Interpolation, Sampled, sample

WIDEST = math.radians(62)
"""Largest angle off axis of a pinhole view, where it stretches outwards 4.5 times as in the middle."""
AT_ONCE = 1 << 18
"""Pixels that are resampled at once."""


def pinhole_view(camera: AnyLensView) -> AnyLensView:
    """Make the pinhole camera that covers an image with a lens, up to `WIDEST` off axis.

    Position, orientation and K stay except for the principal point: pixels in the middle keep their size.
    Rays that do not meet in a point are taken to. Links follow by `rig.transformed(name, view.K @
    camera.K^-1, view.hw)`.

    Returns:
        The camera without its lens, usually of another size.

    Raises:
        ValueError: for a batch of cameras, and an image without a pixel inside its lens's range.
        NotImplementedError: within `torch.func.vmap`.
    """
    needs_numbers("the size of a pinhole view", camera.K)
    if camera.batch_shape:
        raise ValueError("a pinhole view is made of one camera at a time: take one of the batch")
    with torch.no_grad():
        rays, valid = camera.rays(coarse_grid(camera.hw).to(camera.K))
    near_axis = valid & (rays[..., 2] >= math.cos(WIDEST) * rays.norm(dim=-1))
    if not near_axis.any():
        raise ValueError(
            "no pixel of the image is within its lens's range: check the distortion's coefficients"
        )
    kept_rays = rays[near_axis]
    x = product(kept_rays[:, :2] / kept_rays[:, 2:], camera.K[:2, :2].mT) + camera.K[:2, 2]
    low, high = x.detach().amin(0).floor(), x.detach().amax(0).ceil()
    K = camera.K.clone()
    K[:2, 2] = K[:2, 2] - low
    w, h = (int(n) + 1 for n in (high - low).tolist())
    return camera.replace(K=K, hw=(h, w), distortion=None)


def pixels_between(
    source: LensView, target: LensView, x: Float[Tensor, "h w 2"] | None = None
) -> tuple[Float[Tensor, "h w 2"], Bool[Tensor, "h w"]]:
    """Compute the positions in `source` of the pixels of a co-located `target`.

    Views that are not calibrated count as having the same orientation.

    Args:
        source: one view, not a batch, as `target`; rays of either that do not meet in a point are taken to.
        x: pixels of target, float64; None for all.

    Returns:
        Positions in source's image, float64, and True where both lenses are valid and the position is on the
        image; others mean nothing.

    Raises:
        ValueError: for a batch of views.
    """
    if source.batch_shape or target.batch_shape:
        raise ValueError("pixels are mapped between single views: take one of the batch")
    if x is None:
        return _by_rows(lambda x: pixels_between(source, target, x), target.hw, axis=0)
    source, target = source.to(torch.float64), target.to(torch.float64)
    rays, valid = target.rays(x)
    if isinstance(source, Camera) and isinstance(target, Camera):
        rays = rays @ (source.R @ target.R.mT).mT
    projected = source.project_local(rays)
    return projected.x, valid & projected.valid & source.contains(projected.x)


def _by_rows(function: Callable[[Tensor], Any], hw: HW, *, axis: int) -> Any:
    """Apply a function to an image's pixels (h, w, 2), some rows at a time: 300 bytes a pixel."""
    x, y = pixel_coordinates(hw, dtype=torch.float64)
    rows = max(AT_ONCE // hw[1], 1)
    return chunked(lambda x, y: function(torch.stack([x, y], -1)), x, y, rows=rows, axis=axis)


def recorded_pixels(
    x: Float[Tensor, "*n 2"], now: View, recorded: LensView
) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
    """Map pixels of a view that was cropped, resized, rotated or undistorted to the image as recorded.

    K of both views says how pixels were changed: x ~ K_now K_recorded^-1 x_recorded, apart from the lens; a
    view `now` with a lens was not undistorted, and no lens is applied.

    Returns:
        Pixels of the recorded image, and True within the lens model's range.

    Raises:
        ValueError: for a view `now` without K.
    """
    x = map_homogeneous(_between(recorded, now)[:2], x)
    return _lens_taken(recorded, now).distort(x)


def straight_pixels(
    x: Float[Tensor, "*n 2"], now: View, recorded: LensView
) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
    """Map pixels of the image as recorded to the view as it is now: the inverse of `recorded_pixels`.

    Returns:
        Pixels, and True within the lens model's range.

    Raises:
        ValueError: for a view `now` without K.
    """
    x, valid = _lens_taken(recorded, now).undistort(x)
    return map_homogeneous(torch.linalg.inv(_between(recorded, now))[:2], x), valid


def _lens_taken(recorded: LensView, now: View) -> LensView:
    """Recorded view, float64, with the lens that it no longer has; without one if it still has it."""
    kept = isinstance(now, LensView) and now.distortion is not None
    return (recorded.replace(distortion=None) if kept else recorded).to(torch.float64)


def _between(recorded: LensView, now: View) -> Float[Tensor, "3 3"]:
    """Matrix K_recorded K_now^-1."""
    if not isinstance(now, LensView):
        raise ValueError(
            "which pixels were recorded views without K do not say: give them one (`with_pixels`)"
        )
    return product(recorded.K.double(), torch.linalg.inv(now.K.double()))


def resampled(
    image: Float[Tensor, "c h w"],
    source: LensView,
    target: LensView,
    *,
    interpolation: Interpolation = "bicubic",
    extended: bool = False,
) -> Sampled:
    """Resample an image of one view, `source`, to a co-located `target`, neither of them a batch.

    The baseline between the two is ignored; uncalibrated views count as having the same orientation.

    Args:
        extended: True to fill pixels that source does not see from its nearest pixel; they are still not
            valid.

    Returns:
        Values (1, C, H, W) of target's size, 0 where source sees nothing unless `extended`, and validity (1,
        H, W).

    Raises:
        ValueError: for an image of another size than source's, a batch of views, and as `sample`.
    """
    check_plane("the image", image, source.hw)

    def part(x: Tensor) -> Sampled:
        return sampled_between(
            image, source, pixels_between(source, target, x), interpolation, extended=extended
        )

    return Sampled(*_by_rows(part, target.hw, axis=-2))


def sampled_between(
    image: Float[Tensor, "c h w"],
    source: LensView,
    pixels: tuple[Float[Tensor, "ht wt 2"], Tensor],
    interpolation: Interpolation,
    *,
    extended: bool = False,
) -> Sampled:
    """Resample an image as `resampled`, at known positions, which several images of one camera can share.

    Args:
        source: camera of the image.
        pixels: result of `pixels_between`: positions in `source`, and their mask.
        extended: True to fill pixels that source does not see from its nearest pixel.

    Returns:
        Values (1, C, Ht, Wt), 0 where not valid unless `extended`, and validity (1, Ht, Wt).

    Raises:
        ValueError: as `sample`.
    """
    x, defined = pixels
    h, w = source.hw
    nearest = torch.minimum(x.clamp(min=0), x.new_tensor([w - 1, h - 1]))
    inside = torch.where(defined[..., None], x, nearest if extended else 0.0)
    values, valid = sample(image[None], inside[None].to(image), interpolation=interpolation)
    return Sampled(values * (defined | extended), valid & defined)
