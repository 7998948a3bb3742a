"""Rendered scenes on disk: their views, and windows cut from them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError
from typing import NamedTuple
from zipfile import BadZipFile
from zlib import error as BadDeflate

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Camera, Rig, pinhole_view, pixel_grid, resampled, resize_matrix, sample
from arraygeom.pixels import HW, map_homogeneous
from pat.lab.synthesis.rendered import RENDER_FILE, Rendered, is_rendered

DAMAGED = EOFError, BadZipFile, BadDeflate, TokenError, NotImplementedError
"""Errors of NumPy for a damaged archive, beside ValueError, KeyError and TypeError."""
AGAIN = "remove it and run 'pat lab render' again"


def scene_folders(root: str | Path) -> list[Path]:
    """List the complete rendered scenes of a folder.

    Args:
        root: folder of a job (with `scenes` in it), folder of scenes, or one scene.

    Returns:
        Folders in order of their names; files, and folders whose names begin with a dot, are left out.

    Raises:
        FileNotFoundError: for a missing folder.
        ValueError: for a folder without a scene, or with an incomplete one, as which any other folder counts.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"{root}: no such folder: check the path")
    if is_rendered(root):
        return [root]
    inside = root / "scenes" if (root / "scenes").is_dir() else root
    folders = sorted(f for f in inside.iterdir() if f.is_dir() and not f.name.startswith("."))
    if not any(is_rendered(f) for f in folders):
        make = f"make some with 'pat lab render CONFIG --scenes N --out {root}'"
        raise ValueError(f"{root}: holds no rendered scene: {make}")
    if broken := next((f for f in folders if not is_rendered(f)), None):
        raise ValueError(f"{broken}: is not a whole scene (no {RENDER_FILE}): {AGAIN}")
    return folders


@contextmanager
def reading(folder: Path) -> Iterator[None]:
    """Context manager that turns OSError, ValueError, KeyError, TypeError and `DAMAGED`, raised while a scene
    is read, into a ValueError that names its folder; other errors pass.
    """
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, *DAMAGED) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{folder}: cannot be read ({reason}): {AGAIN}") from None


def scene_rig(folder: Path) -> Rig:
    """Read the rig of a rendered scene.

    Returns:
        The rig as rendered; whether its cameras are calibrated is not checked.

    Raises:
        ValueError: naming the folder, if it cannot be read.
    """
    with reading(folder):
        return Rendered(folder).rig


class RenderedView(NamedTuple):
    """One camera's view of a rendered scene.

    Attributes:
        rgb: image in linear light, 1 is white, may exceed it.
        depth: z in metres at the pixels' centres; infinite where nothing is hit, NaN where unknown (the lens
            sees nothing, or outside the image).
        camera: the camera, float64.
    """

    rgb: Float[Tensor, "3 h w"]
    depth: Float[Tensor, "h w"]
    camera: Camera


def read_view(folder: Path, name: str) -> RenderedView:
    """Read a camera's first frame as rendered.

    Raises:
        ValueError: naming the folder, if it cannot be read, the camera is unknown or not calibrated, or
            sizes disagree with the rig.
    """
    with reading(folder):
        frame, camera = Rendered(folder).frame(name), Rendered(folder).rig[name]
    if not isinstance(camera, Camera):
        raise ValueError(f"{folder}: camera '{name}' is not calibrated")
    hw = (frame.depth.shape[-2], frame.depth.shape[-1])
    if hw != camera.hw or frame.rgb.shape[1:] != frame.depth.shape:
        text = f"the image of '{name}' is {hw[1]}x{hw[0]}, its rig says {camera.hw[1]}x{camera.hw[0]}"
        raise ValueError(f"{folder}: {text}: {AGAIN}")
    return RenderedView(frame.rgb, frame.depth, camera.to(torch.float64))


def pinhole_of(camera: Camera) -> Camera:
    """Return the camera's pinhole view, or the camera itself if it has no lens model."""
    return camera if camera.distortion is None else pinhole_view(camera)


def undistorted(view: RenderedView) -> RenderedView:
    """Resample a view to its pinhole camera.

    Returns:
        The view of `pinhole_view`, usually of another size: colours bicubic, clipped at 0, beyond the image
        its edge's; depth of the nearest pixel, NaN beyond. Without a lens model the view itself.

    Raises:
        ValueError: if no pixel is within the lens's range.
    """
    if view.camera.distortion is None:
        return view
    pinhole = pinhole_of(view.camera)
    rgb = resampled(view.rgb, view.camera, pinhole, extended=True).values[0].clamp(min=0)
    depth = resampled(view.depth[None], view.camera, pinhole, interpolation="nearest")
    return RenderedView(rgb, torch.where(depth.valid[0], depth.values[0, 0], torch.nan), pinhole)


def window(view: RenderedView, top: int, left: int, size: HW, hw: HW) -> RenderedView:
    """Cut a window from a view and resize it to `hw` (`reduced`, `reduced_depth`).

    Args:
        view: whole view, through a lens or not.
        top: first row, may lie outside.
        left: first column, may lie outside.
        size: (height, width) of the window in the view.
        hw: (height, width) of the result.

    Returns:
        The view of the window, with its camera. Outside the image colours repeat the edge and depth is NaN.
    """
    rows, columns = (torch.arange(n) + start for n, start in zip(size, (top, left)))
    h, w = view.camera.hw
    inside = ((rows >= 0) & (rows < h))[:, None] & (columns >= 0) & (columns < w)
    rows, columns = rows.clamp(0, h - 1)[:, None], columns.clamp(0, w - 1)
    rgb = reduced(view.rgb[:, rows, columns][None], hw)[0]
    depth = reduced_depth(torch.where(inside, view.depth[rows, columns], torch.nan)[None], hw)[0]
    return RenderedView(rgb, depth, view.camera.crop(top, left, size).resize(hw))


def reduced(rgb: Float[Tensor, "n c h w"], hw: HW) -> Float[Tensor, "n c h2 w2"]:
    """Reduce linear light cubically (a = -0.5, antialiased) to a size, clipped at zero.

    Returns:
        Images (n, c, h2, w2); the same tensor if the size is unchanged.
    """
    if rgb.shape[-2:] == hw:
        return rgb
    return interpolate(rgb, hw, mode="bicubic", align_corners=False, antialias=True).clamp(min=0)


def reduced_depth(depth: Float[Tensor, "n h w"], hw: HW) -> Float[Tensor, "n h2 w2"]:
    """Resample depth to the centres of coarser pixels.

    Returns:
        Depth (n, h2, w2): interpolated linearly in inverse depth where that is within 1 % of the nearest
        pixel's depth, else the nearest pixel's, infinite and NaN too; the same tensor for an equal size.
    """
    old = (depth.shape[-2], depth.shape[-1])
    if old == hw:
        return depth
    x = map_homogeneous(resize_matrix(hw, old)[:2], pixel_grid(hw, dtype=torch.float64)).to(depth)[None]
    between = 1 / sample(1 / depth[:, None], x).values[:, 0]
    nearest = sample(depth[:, None], x, interpolation="nearest").values[:, 0]
    even = (between / nearest - 1).abs() < 0.01
    return torch.where(even, between, nearest)
