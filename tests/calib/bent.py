"""Photographs of a bent board: each ray is replaced by that to where the flat board has what it meets."""

import numpy as np
import torch
from jaxtyping import Float, UInt8

from arraygeom import Camera, Pose
from calib.boards.board import Board
from calib.boards.deformation import BoardDeformation
from calib.boards.simulation import fine_rays, photograph

ITERATIONS = 12
"""Of the search for the point that a ray meets."""


def photograph_bent(
    camera: Camera, cam_from_board: Pose, board: Board, shape: BoardDeformation
) -> UInt8[np.ndarray, "h w"]:
    """The image of a board of some shape."""
    along, valid = fine_rays(camera)
    R, t = cam_from_board.R, cam_from_board.t
    flat = torch.from_numpy(on_bent(shape, (along @ R).numpy(), (-t @ R).numpy(), max(board.extent)))
    ahead = (R[:, 2] @ t) / (along @ R[:, 2]) > 0
    return photograph(camera, cam_from_board, board, rays=(cam_from_board.apply(flat), valid & ahead))


def on_bent(
    shape: BoardDeformation, along: Float[np.ndarray, "n 3"], centre: Float[np.ndarray, "3"], size: float
) -> Float[np.ndarray, "n 3"]:
    """Intersect rays from a centre with a bent board: positions on it if it were flat, by iteration.

    Rays that pass its plane farther than `size` (metres) from its middle are not followed.
    """
    found = centre - along * (centre[2] / along[:, 2])[:, None]
    found[:, 2] = 0
    middle = shape.middle[0]
    near = np.abs(found[:, :2] - middle).max(1) < size
    flat, part = found[near], np.zeros(near.sum(), dtype=int)
    for _ in range(ITERATIONS):
        bent = shape.deformed(flat, part)
        hit = centre + along[near] * ((bent[:, 2] - centre[2]) / along[near, 2])[:, None]
        flat[:, :2] = middle + np.clip(flat[:, :2] + (hit - bent)[:, :2] - middle, -size, size)
    found[near] = flat
    return found
