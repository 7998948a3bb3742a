"""A checkered room seen by the cameras of a rig: images for a rig that has none yet."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from arraygeom import Camera, Rig, pixel_grid

SQUARES = 2
"""Squares from the middle of the room to a wall."""
DEEPEST = 20.0
"""Depth of the back wall in nearest depths where the rig's farthest is beyond it."""


def checkered_room(rig: Rig, alpha: str) -> dict[str, Float[Tensor, "1 h w"]]:
    """Every camera's image (1, h, w) of a box whose back wall is far and whose side walls alpha sees from near on.

    Squares differ in brightness, so that each has one match. Raises ValueError for a rig without poses or depth range.
    """
    cameras = {name: view for name, view in rig.cameras.items() if isinstance(view, Camera)}
    if len(cameras) < len(rig.cameras) or rig.depth is None:
        raise ValueError("a synthetic room needs a calibrated rig with a depth range: give images")
    near, far = (float(d) for d in rig.depth)
    view = cameras[alpha]
    rays = torch.where(valid_rays(view)[1][..., None], valid_rays(view)[0], 0.0)
    side = near * rays[..., :2].abs().amax((0, 1))
    half = torch.cat([side, side.new_tensor([min(far, DEEPEST * near)])])
    return {name: room_image(camera, view, half) for name, camera in cameras.items()}


def valid_rays(camera: Camera) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    """The rays of all pixels in the camera's frame, and their validity."""
    return camera.rays(pixel_grid(camera.hw, dtype=torch.float64))


def room_image(camera: Camera, alpha: Camera, half: Float[Tensor, "3"]) -> Float[Tensor, "1 h w"]:
    """The room's image; `half` is half the room's size in alpha's axes, metres, with alpha in its middle."""
    rays, valid = valid_rays(camera)
    R = alpha.R @ camera.R.T
    start = alpha.R @ (camera.centre - alpha.centre)
    directions = rays @ R.T
    distance = (half * directions.sign() - start) / directions
    hit, wall = torch.where(distance > 0, distance, torch.inf).min(-1)
    points = start + hit[..., None] * directions
    square = torch.floor(points / half.min() * SQUARES)
    square = square.scatter(-1, wall[..., None], 0.0)
    brightness = torch.frac(torch.sin(square @ HASH + wall) * 43758.5453).abs()  # the usual hash of shaders
    return torch.where(valid & hit.isfinite(), 0.1 + 0.8 * brightness, 0.0).float()[None]


HASH = torch.tensor([12.9898, 78.233, 37.719], dtype=torch.float64)
"""Numbers without a common period, those of the hash."""
