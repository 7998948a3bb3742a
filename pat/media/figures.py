"""Figures: coloured depth, panels of images side by side, and their files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom.runtime.atomic import write_atomically
from arraygeom.runtime.chunks import chunked

from .colour import to_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def colour_depth(depth: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Colour a depth map by inverse depth, from its 1st to its 99th percentile.

    Args:
        depth: NaN, infinity, 0 and less are unknown.

    Returns:
        RGB (3, h, w) 0..1, float32 on the CPU; near is red, far (or a single depth) dark blue, unknown black.
    """
    depth = depth.detach().cpu()
    has_depth = depth.isfinite() & (depth > 0)
    inverse = torch.where(has_depth, 1 / torch.where(has_depth, depth, 1.0), 0.0)
    low, high = np.percentile(inverse[has_depth].numpy(), (1, 99)) if has_depth.any() else (0.0, 1.0)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    turbo = torch.from_numpy(np.pad(table, ((0, 1), (0, 0))).T / np.float32(255))  # and black

    def coloured(inverse: Tensor, has_depth: Tensor) -> Tensor:
        scaled = (256 / max(high - low, 1e-12) * (inverse - low)).int().clamp_(0, 255)
        which = torch.where(has_depth, scaled, 256).flatten()
        return turbo.index_select(1, which).view(3, *has_depth.shape)

    return chunked(coloured, inverse, has_depth)


def reduced(image: Float[Tensor, "c h w"], longest: int) -> Float[Tensor, "c h2 w2"]:
    """Reduce an image so that its longer side has at most `longest` pixels (bicubic, antialiased).

    Returns:
        The smaller image, not clipped to 0..1; the same tensor if it is small enough.
    """
    factor = longest / max(image.shape[-2:])
    if factor >= 1:
        return image
    hw = [max(round(n * factor), 1) for n in image.shape[-2:]]
    return interpolate(image[None], hw, mode="bicubic", align_corners=False, antialias=True)[0]


def figure_file(path: Path) -> Path:
    """Check that a figure's name ends in a format that matplotlib writes.

    Returns:
        The path.

    Raises:
        ImportError: without matplotlib.
        ValueError: for another suffix, or none.
    """
    from matplotlib.backend_bases import FigureCanvasBase

    if path.suffix[1:].lower() not in FigureCanvasBase.get_supported_filetypes():
        raise ValueError(f"{path}: no format of pictures: end its name in .png, .pdf or .svg")
    return path


def save_figure(figure: Figure, path: Path, *, dpi: int = 110) -> Path:
    """Write a matplotlib figure atomically, in the format of the path's suffix.

    Args:
        figure: figure; its canvas becomes Agg's.
        dpi: pixels for each inch of the figure's size.

    Returns:
        The path.

    Raises:
        ValueError: as `figure_file`.
        OSError: if it cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure_file(path)
    FigureCanvasAgg(figure)
    with write_atomically(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return path


TITLE, GAP = 28, 10
"""Pixels of a title line above each panel, and between panels."""


def draw_panels(
    panels: Mapping[str, Float[Tensor, "_ _ _"]], *, columns: int, width: float = 10.0
) -> Image.Image:
    """Draw images side by side with titles, row by row, each scaled to its cell (aspect kept, centred).

    Args:
        panels: images (1 or 3, h, w), values 0..1, by title, at least one; a title may have several lines,
            and the font shrinks until the longest fits. The first image sets the cells' shape.
        columns: panels in a row, 1 or more.
        width: width of the figure, in units of 110 pixels.

    Returns:
        One RGB image of Pillow. ValueError for more columns than fit in the width.
    """
    wide = round(110 * width) // columns - GAP
    h, w = next(iter(panels.values())).shape[-2:]
    high = round(wide * h / w)
    longest = max(map(ImageFont.load_default(16).getlength, "\n".join(panels).split("\n")))
    font = ImageFont.load_default(min(16, 16 * wide / max(longest, 1)))
    above = TITLE * (1 + max(title.count("\n") for title in panels))
    cell_wh = wide + GAP, high + above
    drawn = Image.new("RGB", (columns * cell_wh[0], -(-len(panels) // columns) * cell_wh[1] + GAP), "white")
    text = ImageDraw.Draw(drawn)
    for i, (title, image) in enumerate(panels.items()):
        panel = Image.fromarray(np.ascontiguousarray(to_bytes(image.expand(3, -1, -1)).transpose(1, 2, 0)))
        factor = min(wide / panel.width, high / panel.height)
        wh = max(round(factor * panel.width), 1), max(round(factor * panel.height), 1)
        panel = panel.resize(wh, Image.Resampling.NEAREST if factor >= 3 else Image.Resampling.LANCZOS)
        left, top = i % columns * cell_wh[0] + GAP // 2, i // columns * cell_wh[1]
        text.text((left + wide / 2, top + above / 2 + 2), title, "black", font, anchor="mm", align="center")
        drawn.paste(panel, (left + (wide - wh[0]) // 2, top + above + (high - wh[1]) // 2))
    return drawn


def save_panels(panels: Mapping[str, Float[Tensor, "_ _ _"]], path: Path, *, columns: int) -> None:
    """Write the image of `draw_panels`, 16 units wide, atomically."""
    with write_atomically(path) as temporary:
        draw_panels(panels, columns=columns, width=16).save(temporary, compress_level=3)
