"""Depth maps read from files (PFM, TIFF, 16-bit PNG), and written as point clouds (PLY)."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from arraygeom import Camera, pixel_grid, world_rays
from arraygeom.pixels import HW
from arraygeom.runtime.atomic import write_atomically

from .colour import to_bytes
from .images import read_recorded

MILLIMETRE = 0.001
"""Metres for each count in integer maps: depth cameras (RealSense, ZED, Kinect) count millimetres."""
PLY_HEADER = """ply
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


def read_depth(path: str | Path, *, hw: HW | None = None, scale: float | None = None) -> Float[Tensor, "h w"]:
    """Read a depth map from a PFM, TIFF or 16-bit PNG file.

    Args:
        hw: expected (height, width); None accepts any.
        scale: metres for each unit of the file; None takes 1 for float files, and for integers the scale that
            a depth_16.png of `pat fuse` states, or else `MILLIMETRE`.

    Returns:
        Depth z in metres (h, w), float32; NaN where the file's value is not positive and finite.

    Raises:
        OSError: for a missing file (FileNotFoundError), or one that may not be read.
        ValueError: for a file that is no depth map (colour, 8 bits, no positive depth after scaling), has
            another size, or states no usable scale; and as `read_recorded`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such depth map: check the path")
    if path.suffix.lower() == ".pfm":
        values = _pfm(path)
    else:
        planes = read_recorded(path)
        if len(planes) != 1:
            raise ValueError(f"{path}: has {len(planes)} channels: give depth, with one, not its picture")
        values = planes[0]
    if hw is not None and values.shape != tuple(hw):
        (h, w), (height, width) = values.shape, hw
        raise ValueError(f"{path}: is {w}x{h}, alpha's image is {width}x{height}: give alpha's own depth")
    if values.dtype == np.uint8:
        raise ValueError(f"{path}: has 8 bits, too few for depth: give PFM, float TIFF, or PNG of 16 bits")
    if scale is None:
        scale = 1.0 if np.issubdtype(values.dtype, np.floating) else _stated_scale(path) or MILLIMETRE
    depth = torch.from_numpy(values.astype(np.float32)) * scale
    has_depth = depth.isfinite() & (depth > 0)
    if not has_depth.any():
        raise ValueError(f"{path}: no pixel has a positive depth: is it a depth map?")
    return torch.where(has_depth, depth, torch.nan)


def _pfm(path: Path) -> NDArray[np.float32]:
    """Read a grey PFM file: "Pf", w, h, scale (negative for little-endian), rows from the bottom."""
    content = path.read_bytes()
    head = re.match(rb"Pf\s+(\d+)\s+(\d+)\s+([+-]?[0-9]*\.?[0-9]+(?:[eE][+-]?[0-9]+)?)(?:\r\n|\s)", content)
    if head is None:
        raise ValueError(f"{path}: not a grey PFM file: give one that begins with 'Pf', or float TIFF")
    w, h, scale = int(head[1]), int(head[2]), float(head[3])
    if (size := len(content) - head.end()) != 4 * h * w:
        raise ValueError(f"{path}: has {size} bytes of values, {w}x{h} are {4 * h * w}: it is not whole")
    values = np.frombuffer(content, "<f4" if scale < 0 else ">f4", offset=head.end())
    return values.reshape(h, w)[::-1].astype(np.float32)


def _stated_scale(path: Path) -> float | None:
    """Metres for each count as `write_depth` states them in a PNG file; None in other files."""
    with path.open("rb") as file:  # Pillow would refuse large ones
        head, *_ = file.read(2**16).split(b"IDAT", 1)
    said = re.match(rb"\x89PNG.*tEXtDescription\0depth: ([!-~]+) counts a metre", head, re.DOTALL)
    if said is None:
        return None
    with suppress(ValueError, ZeroDivisionError):
        if 0 < (scale := 1 / float(said[1])) < math.inf:
            return scale
    raise ValueError(f"{path}: says {said[1].decode()} counts a metre: give FILE,scale=METRES of a count")


def write_points(
    path: Path,
    camera: Camera,
    depth: Float[Tensor, "h w"],
    image: Float[Tensor, "c h w"],
    *,
    along: Literal["depth", "distance"] = "depth",
) -> int:
    """Write the pixels of known depth as a coloured point cloud (binary PLY), atomically.

    Camera, depth and image are on the CPU, of one size, and need no gradient.

    Args:
        path: file to write; missing folders are made.
        camera: camera of the image.
        depth: metres; pixels are left out where it is not positive and finite, or the ray misses it.
        image: values 0..1; grey for one channel, or three and more, of which the first are RGB.
        along: "depth" for z along the optical axis, "distance" for the length of the ray.

    Returns:
        The number of points. Their coordinates are the camera's, x right, y down, z ahead, in metres.

    Raises:
        OSError: if it cannot be written.
    """
    has_depth = depth.isfinite() & (depth > 0)
    x = pixel_grid(camera.hw, dtype=torch.float64)[has_depth]
    colours = image.expand(3, -1, -1) if len(image) == 1 else image[:3]
    double_camera, to_point = camera.to(torch.float64), depth[has_depth].double()
    X = double_camera.cam_from_world.apply(
        (at_distance if along == "distance" else Camera.unproject)(double_camera, x, to_point)
    )
    finite = X.isfinite().all(-1)
    vertices = np.empty(int(finite.sum()), VERTEX)
    vertices["X"] = X[finite].numpy()
    vertices["colour"] = to_bytes(colours[:, has_depth][:, finite]).T
    with write_atomically(path) as temporary:
        temporary.write_bytes(PLY_HEADER.format(count=len(vertices)).encode() + vertices.tobytes())
    return len(vertices)


def at_distance(
    camera: Camera, x: Float[Tensor, "*n 2"], distance: Float[Tensor, "*n"]
) -> Float[Tensor, "*n 3"]:
    """Compute the world points of pixels at a distance (metres) along their rays.

    Returns:
        Points (*n, 3) of the world, metres; NaN for pixels without a ray (outside the lens model).
    """
    rays = world_rays(camera, x)
    return torch.where(rays.valid[..., None], rays.origin + distance[..., None] * rays.direction, torch.nan)
