"""Figures: depth in colours, panels of images side by side, and files of both."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from arraygeom.atomic import write_atomically


def colour_depth(depth: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Inverse depth in colours, from its 1st to its 99th percentile; unknown depth is black."""
    known = depth.isfinite()
    inverse = torch.where(known, 1 / torch.where(known, depth, 1.0), 0.0)
    low, high = np.percentile(inverse[known].numpy(), (1, 99)) if known.any() else (0.0, 1.0)
    colours = torch.zeros(3, *depth.shape)
    for rows, found, seen in zip(colours.split(256, 1), inverse.split(256), known.split(256)):
        scaled = ((found - low) / max(high - low, 1e-12)).clamp(0, 1).numpy()
        rows[:, seen] = torch.from_numpy(colormaps["turbo"](scaled)[..., :3].astype(np.float32)).movedim(-1, 0)[:, seen]
    return colours


def save_figure(figure: Figure, path: Path, *, dpi: int = 110) -> Path:
    """Write a figure atomically; returns the path."""
    FigureCanvasAgg(figure)
    with write_atomically(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return path


def draw_panels(panels: Mapping[str, Float[Tensor, "_ _ _"]], *, columns: int, width: float = 10.0) -> Figure:
    """One figure, `width` inches wide, of images by title, row by row."""
    rows = -(-len(panels) // columns)
    h, w = next(iter(panels.values())).shape[-2:]
    figure = Figure(figsize=(width, (width / columns * h / w + 0.3) * rows), layout="constrained")
    for i, (title, image) in enumerate(panels.items()):
        axes = figure.add_subplot(rows, columns, i + 1, title=title)
        axes.imshow(image.detach().expand(3, -1, -1).clamp(0, 1).movedim(0, -1).numpy())
        axes.set_axis_off()
    return figure


def save_panels(panels: Mapping[str, Float[Tensor, "_ _ _"]], path: Path, *, columns: int) -> None:
    """`draw_panels`, 16 inches wide, written atomically."""
    save_figure(draw_panels(panels, columns=columns, width=16), path)
