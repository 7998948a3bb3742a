"""Point clouds of a depth map, as PLY files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, pixel_grid
from arraygeom.atomic import write_atomically

from .colour import to_bytes

HEADER = """ply
format binary_little_endian 1.0
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""
VERTEX = np.dtype([("X", "<f4", 3), ("colour", "u1", 3)])


def write_points(path: Path, camera: Camera, depth: Float[Tensor, "h w"], image: Float[Tensor, "c h w"]) -> int:
    """Write the pixels of known depth as a coloured point cloud (binary PLY), atomically; returns their number.

    Coordinates are the camera's: x right, y down, z ahead, in the unit of the depth. An image of one band is grey.
    """
    known = depth.isfinite()
    x = pixel_grid(camera.hw, dtype=torch.float64)[known]
    colours = image.expand(3, -1, -1) if len(image) == 1 else image[:3]
    own = camera.to(torch.float64)
    X = own.cam_from_world.apply(own.unproject(x, depth[known].double()))
    seen = X.isfinite().all(-1)
    vertices = np.empty(int(seen.sum()), VERTEX)
    vertices["X"] = X[seen].numpy()
    vertices["colour"] = to_bytes(colours[:, known][:, seen]).T
    with write_atomically(path) as temporary:
        temporary.write_bytes(HEADER.format(count=len(vertices)).encode() + vertices.tobytes())
    return len(vertices)
