"""The pinhole camera that Blender renders, and the resampling of its image to the true camera."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates
from torch import Tensor

from arraygeom import Camera, Pose, View, pixel_grid, sample
from arraygeom.pixels import map_homogeneous

from ..rendered import depth_between, four_around

WIDEST = math.radians(80)
"""Largest angle off axis, in radians, that a plane image covers."""

_MARGIN = 3
_MOST_PIXELS = 64e6
_STEP = 0.01


class Lens(NamedTuple):
    """Pinhole camera to render with, and the resampling to the true camera.

    Attributes:
        pinhole: the pinhole camera, possibly rotated about the optical axis and of another size.
        x: positions (x, y) of the true camera's pixels in the pinhole's image; None if the pixels are the
            same.
        valid: True where the lens sees something; None if the pixels are the same.
    """

    pinhole: Camera
    x: Float[Tensor, "h w 2"] | None
    valid: Bool[Tensor, "h w"] | None

    def resampled(self, image: Float[Tensor, "c h1 w1"]) -> Float[Tensor, "c h2 w2"]:
        """Resample colours to the true camera by cubic splines; 0 where the lens sees nothing.

        The bicubic kernel of `grid_sample` shifts linear ramps, splines do not.

        Args:
            image: image of the pinhole, on the CPU, without gradient.

        Returns:
            Image (c, h2, w2), clipped at 0; the image itself if the pixels are the same.
        """
        if self.x is None or self.valid is None:
            return image
        positions = self.x.movedim(-1, 0).flip(0).numpy()
        planes = [map_coordinates(plane, positions, order=3, mode="mirror") for plane in image.numpy()]
        return torch.where(self.valid, torch.from_numpy(np.stack(planes)).clamp(min=0), 0.0)

    def nearest(self, image: Float[Tensor, "c h1 w1"]) -> Float[Tensor, "c h2 w2"]:
        """Resample values to the true camera from the nearest pixel; 0 where the lens sees nothing.

        Returns:
            Image (c, h2, w2); the image itself if the pixels are the same.
        """
        if self.x is None or self.valid is None:
            return image
        values = sample(image[None], self.x[None].to(image), interpolation="nearest").values[0]
        return torch.where(self.valid, values, 0)

    def depth(self, depth: Float[Tensor, "h1 w1"], index: Int[Tensor, "h1 w1"]) -> Float[Tensor, "h2 w2"]:
        """Resample depth along exact rays, exact on planes; beside edges the nearest pixel's surface is
        extrapolated.

        Args:
            depth: depth of the pinhole's pixels, metres; infinite where nothing is hit.
            index: object index of each pixel.

        Returns:
            Depth (h2, w2) in metres, infinite where nothing is hit, NaN where the lens sees nothing; `depth`
            itself if the pixels are the same.
        """
        if self.x is None or self.valid is None:
            return depth
        between, clean = depth_between(depth.double(), index, self.x, uneven=_STEP)
        continued = 1 / _continued(1 / depth.double(), self.x)
        return torch.where(self.valid, torch.where(clean, between, continued), torch.nan).to(depth)


def _continued(inverse: Float[Tensor, "h1 w1"], x: Float[Tensor, "h2 w2 2"]) -> Float[Tensor, "h2 w2"]:
    """Inverse depth at positions, extrapolated from the nearest pixel with its slopes to the smoother sides.

    It stays within the values of the four pixels around: no surface is nearer or farther than any that was
    seen.
    """
    layers = torch.stack([inverse, _gentlest(inverse, 1), _gentlest(inverse, 0)])
    q, across, down = sample(layers[None], x[None], interpolation="nearest").values[0]
    dx, dy = (x - (x + 0.5).floor()).unbind(-1)
    around = four_around(inverse[None, None], x)[0]
    return torch.clamp(q + across * dx + down * dy, around.amin(0), around.amax(0))


def _gentlest(inverse: Float[Tensor, "h w"], dim: int) -> Float[Tensor, "h w"]:
    """The smaller of the differences to the two neighbours along an axis."""
    steps = inverse.diff(dim=dim)
    edge = torch.full_like(steps.narrow(dim, 0, 1), torch.inf)
    before, after = torch.cat([edge, steps], dim), torch.cat([steps, edge], dim)
    return torch.where(before.abs() < after.abs(), before, after)


def lens_for(camera: View, name: str) -> Lens:
    """Make the lens of a rig's camera.

    Returns:
        The lens, float64 on the CPU.

    Raises:
        ValueError: naming the camera, if it is not calibrated, batched, skewed or mirrored, or its lens is
            not central, invalid, or too wide or too strong for a plane image.
    """
    if not isinstance(camera, Camera):
        raise ValueError(f"camera '{name}' is not calibrated: rendering needs its K, R and t")
    if camera.batch_shape:
        raise ValueError(f"camera '{name}' is batched {tuple(camera.batch_shape)}: render one rig at a time")
    if not camera.central:
        raise ValueError(f"camera '{name}' has rays that do not meet in a point: render a central lens")
    camera = camera.to(dtype=torch.float64, device="cpu")
    upright = _upright(camera, name)
    return Lens(upright, None, None) if camera.distortion is None else _wide(camera, upright, name)


def _upright(camera: Camera, name: str) -> Camera:
    """The same pinhole with upper triangular K: K = K' Q, where Q, a rotation about the optical axis, goes to
    the pose."""
    K = camera.K
    angle = torch.atan2(K[1, 0], K[1, 1])
    c, s = angle.cos(), angle.sin()
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    Q = torch.stack([torch.stack([c, -s, zero]), torch.stack([s, c, zero]), torch.stack([zero, zero, one])])
    K = K @ Q.T
    if abs(float(K[0, 1])) > 1e-9 * float(K[0, 0].abs()):
        skew = f"skew (K[0, 1] = {float(K[0, 1]):.4g}), which Blender's cameras cannot have"
        raise ValueError(f"camera '{name}' has {skew}: set it to 0, or calibrate without skew")
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise ValueError(f"camera '{name}' mirrors its image (K has det below 0): flip the image instead")
    K = K.clone()
    K[0, 1] = K[1, 0] = 0
    return camera.replace(K=K, cam_from_world=Pose(Q @ camera.R, Q @ camera.t), distortion=None)


def _wide(camera: Camera, upright: Camera, name: str) -> Lens:
    """Pinhole that covers all that the lens sees, at least as finely, with square pixels."""
    rays, valid = camera.rays(pixel_grid(camera.hw, dtype=torch.float64))
    rays = rays @ (upright.R @ camera.R.T).T
    if not valid.any():
        raise ValueError(f"camera '{name}': its lens model is valid for no pixel; check the coefficients")
    angle = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2])[valid].max()
    if angle > WIDEST:
        degrees, most = (f"{math.degrees(a):.0f}" for a in (angle, WIDEST))
        text = f"camera '{name}' sees {degrees} degrees off its axis; a plane image covers at most {most}"
        raise ValueError(f"{text}: crop the camera")
    plane = rays[..., :2] / rays[..., 2:].clamp(min=1e-6)
    f = float(_finest(plane, valid))
    low, high = (f * plane[valid].amin(0)).floor() - _MARGIN, (f * plane[valid].amax(0)).ceil() + _MARGIN
    w, h = (int(n) for n in high - low + 1)
    if w * h > _MOST_PIXELS:
        raise ValueError(f"camera '{name}': its lens needs an image of {w}x{h} pixels: crop the camera")
    K = torch.tensor([[f, 0, -float(low[0])], [0, f, -float(low[1])], [0, 0, 1]], dtype=torch.float64)
    return Lens(upright.replace(K=K, hw=(h, w)), map_homogeneous(K[:2], plane), valid)


def _finest(plane: Float[Tensor, "h w 2"], valid: Bool[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Focal length at which neighbouring lens pixels are a pixel or more apart nearly everywhere."""
    across, down = plane.diff(dim=1).norm(dim=-1), plane.diff(dim=0).norm(dim=-1)
    steps = torch.cat([across[valid[:, 1:] & valid[:, :-1]], down[valid[1:] & valid[:-1]]])
    return 1 / steps.quantile(0.1) if len(steps) < 1e6 else 1 / steps.kthvalue(len(steps) // 10).values
