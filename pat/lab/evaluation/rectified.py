"""Comparison method for calibrated segments: warp images to rows, fuse there, warp the result back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Pair, Rectification, Rig, apply_homography, intrinsics, pixel_grid, rectify, sample
from arraygeom.pixels import HW, product
from arraygeom.sampling import Interpolation

LARGEST = 6.0
"""Largest canvas, in multiples of alpha's pixels: a camera nearly ahead stretches it without bound."""


class Warped(NamedTuple):
    """Rectified pair of images.

    Attributes:
        rig: the two rectified cameras, with the depth range's old numbers, now along the rectified axis.
        images: rectified images (c, h, w) by name, all on one canvas.
        rectification: cameras on the canvas, and homographies to it from the original images.
        original: the pair before it.
    """

    rig: Rig
    images: dict[str, Tensor]
    rectification: Rectification
    original: Pair

    def back(
        self, image: Float[Tensor, "c h w"], *, interpolation: Interpolation = "bicubic"
    ) -> Float[Tensor, "c ha wa"]:
        """Warp an image of the canvas to alpha's pixels.

        Args:
            image: image on the rectified canvas.
            interpolation: "bicubic", "bilinear" or "nearest".

        Returns:
            Image (c, ha, wa), not clipped; beyond the canvas its border repeats.

        Raises:
            ValueError: for another interpolation.
            TypeError: for an image of whole numbers.
        """
        return warped(image, self.rectification.H_alpha, self.original.alpha.hw, interpolation=interpolation)

    def depth_back(self, depth: Float[Tensor, "h w"]) -> Float[Tensor, "ha wa"]:
        """Warp a depth map of the canvas to alpha, from the nearest pixel.

        Args:
            depth: depth along the rectified camera's axis, metres.

        Returns:
            Depth (ha, wa) along alpha's axis, metres; NaN where `depth` is, possibly where it is infinite.
        """
        level, (alpha, _) = self.rectification.pair.cameras[0], self.original.cameras
        x = apply_homography(self.rectification.H_alpha, pixel_grid(alpha.hw, dtype=torch.float64)).x
        warped = self.back(depth[None], interpolation="nearest")[0].double()
        return alpha.project(level.unproject(x, warped)).depth.to(depth)


def rectified(rig: Rig, images: Mapping[str, Tensor]) -> Warped:
    """Rectify the first two cameras of a rig and their images, so that epipolar lines are rows.

    The canvas holds all of alpha at alpha's focal length: alpha loses only what resampling costs.

    Args:
        rig: rig of two cameras or more, with a depth range; its first camera is alpha.
        images: images (c, h, w) of these two cameras in 0..1, by name; their sizes are not checked.

    Returns:
        The rectified pair; images clipped to 0..1.

    Raises:
        ValueError: as `whole_alpha`; for fewer than two cameras or images of them, and no depth range.
    """
    named = [name for name in rig.names[:2] if name in images]
    if len(named) < 2:
        raise ValueError(f"two cameras are rectified, with their images: got those of {named}")
    first, second = named
    pair = rig.pair(first, second)
    plane = whole_alpha(pair)
    views = (first, plane.H_alpha), (second, plane.H_beta)
    canvas = plane.pair.alpha.hw
    made = {name: warped(images[name], torch.linalg.inv(H), canvas).clamp(0, 1) for name, H in views}
    near, far = (float(d) for d in pair.depth_range)
    return Warped(Rig(dict(zip((first, second), plane.pair.cameras)), depth=(near, far)), made, plane, pair)


def whole_alpha(pair: Pair) -> Rectification:
    """Rectify a pair at alpha's focal length, onto the canvas that alpha's image fills.

    Returns:
        The rectification: homographies from each image to the canvas, and the cameras there.

    Raises:
        ValueError: as `rectify`; if the baseline is too close to an optical axis, or the canvas would have
            more than `LARGEST` times alpha's pixels.
    """
    alpha, _ = pair.cameras
    rough = rectify(pair)
    h, w = alpha.hw
    corners = torch.tensor([[-0.5, -0.5], [w - 0.5, -0.5], [-0.5, h - 0.5], [w - 0.5, h - 0.5]]).to(alpha.K)
    rays = product(rough.R_alpha, alpha.rays(corners)[0][..., None])[..., 0]
    if not bool((rays[..., 2] > 0).all()):
        raise ValueError("the baseline is too near an optical axis: part of alpha is behind the other view")
    focal = alpha.K[:2, :2].det().abs().sqrt()
    x = focal * rays[..., :2] / rays[..., 2:]
    low, high = x.amin(0), x.amax(0)
    columns, rows = (int(n) for n in (high - low).ceil())
    if rows * columns > LARGEST * h * w:
        raise ValueError(f"the baseline is near an optical axis: the rectified image has {columns}x{rows} px")
    return rectify(pair, K=intrinsics(focal, (h, w), tuple(-low - 0.5)), hw=(rows, columns))


def warped(image: Tensor, H: Tensor, hw: HW, *, interpolation: Interpolation = "bicubic") -> Tensor:
    """Sample an image at H x for all pixels x of a canvas.

    Args:
        image: image (c, h, w).
        H: homography (3, 3) from pixels of the canvas to those of the image.
        hw: (height, width) of the canvas.
        interpolation: "bicubic", "bilinear" or "nearest".

    Returns:
        Image (c, *hw), bicubic not clipped; the image's border repeats beyond.

    Raises:
        ValueError: for another interpolation.
        TypeError: for an image of whole numbers.
    """
    x = apply_homography(H, pixel_grid(hw, dtype=torch.float64)).x
    return sample(image[None], x[None].float(), interpolation=interpolation, extended=True).values[0]
