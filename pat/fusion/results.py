"""What a fusion leaves on disk."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig
from arraygeom.atomic import write_atomically
from arraygeom.viz import new_figure

from ..media.colour import linear_from_srgb
from ..media.images import write_image
from ..media.raw import developed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ImageFormat = Literal["png", "tif", "exr"]


def save_frame(
    frame: Frame,
    out: Path,
    *,
    bits: int = 8,
    kind: ImageFormat = "png",
    view: Rig | None = None,
    name: str = "",
) -> list[Path]:
    """Write fused.png, confidence.png, depth.tif (metres, float; NaN as 0) and depth.png (near is bright).

    8 and 16 bits hold sRGB values; 32 bits (tif, exr) hold linear light as floats, nothing cut off. With `view`, the
    rig of alpha alone goes to view.yaml and says so. With a `name` the files are name_fused.png and so on. The image
    is written last: where it is, the others are. Each appears whole or not at all. Without any known depth there are
    no depth files. Bands that are not one or three go to fused_1.png, fused_2.png and so on, their mean to fused.png.
    Returns what was written.
    """
    prefix = f"{name}_" if name else ""
    fused, confidence = out / f"{prefix}fused.{kind}", out / f"{prefix}confidence.png"
    write_image(confidence, frame.confidence[None])
    written = [confidence]
    if frame.depth.isfinite().any():
        depths = [out / f"{prefix}depth.tif", out / f"{prefix}depth.png"]
        write_image(depths[0], frame.depth.nan_to_num(0.0)[None], bits=32)
        write_image(depths[1], colour_depth(frame.depth))
        written += depths
    if view is not None:
        view.save(out / "view.yaml")
        written.append(out / "view.yaml")
    image = linear_from_srgb(frame.image) if bits == 32 else frame.image
    if len(image) not in (1, 3):
        bands = {out / f"{prefix}fused_{i}.{kind}": band[None] for i, band in enumerate(image, 1)}
        for file, band in bands.items():
            write_image(file, band, bits=bits)
        written, image = [*bands, *written], image.mean(0, keepdim=True)
    write_image(fused, image, bits=bits)
    return [fused, *written]


def view_of(rig: Rig, alpha: str, *, bits: int, bands: int = 3) -> Rig:
    """The rig of fused images: alpha's camera alone, its values coded as `save_frame` writes them."""
    coding = "linear" if bits == 32 else "srgb"
    response = "rgb" if bands == 3 else rig[alpha].sensor.response
    sensor = dataclasses.replace(developed(rig[alpha].sensor), coding=coding, response=response)
    return Rig({alpha: rig[alpha].replace(sensor=sensor)}, depth=rig.depth, name=rig.name)


def colour_depth(depth: Float[Tensor, "h w"]) -> Float[Tensor, "3 h w"]:
    """Inverse depth in colours, from its 1st to its 99th percentile; unknown depth is black."""
    known = depth.isfinite()
    inverse = torch.where(known, 1 / torch.where(known, depth, 1.0), 0.0)
    low, high = np.percentile(inverse[known].numpy(), (1, 99)) if known.any() else (0.0, 1.0)
    colours = torch.zeros(3, *depth.shape)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    turbo = torch.from_numpy(table.T / np.float32(255))
    for rows, found, seen in zip(colours.split(256, 1), inverse.split(256), known.split(256)):
        scaled = ((found - low) / max(high - low, 1e-12)).clamp(0, 1)
        rows[:, seen] = turbo[:, (256 * scaled).long().clamp(max=255)][:, seen]
    return colours


def save_figure(figure: Figure, path: Path, *, dpi: int = 110) -> Path:
    """Write a figure, whole or not at all; returns where."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    with write_atomically(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return path


def draw_panels(panels: Mapping[str, Float[Tensor, "_ _ _"]], *, columns: int, width: float = 10.0) -> Figure:
    """One figure, `width` inches wide, of images by title, row by row."""
    rows = -(-len(panels) // columns)
    h, w = next(iter(panels.values())).shape[-2:]
    figure = new_figure(figsize=(width, (width / columns * h / w + 0.3) * rows), layout="constrained")
    for i, (title, image) in enumerate(panels.items()):
        axes = figure.add_subplot(rows, columns, i + 1, title=title)
        axes.imshow(image.detach().expand(3, -1, -1).clamp(0, 1).movedim(0, -1).numpy())
        axes.set_axis_off()
    return figure


def save_panels(panels: Mapping[str, Float[Tensor, "_ _ _"]], path: Path, *, columns: int) -> None:
    """`draw_panels`, 16 inches wide, as a file that appears whole or not at all."""
    save_figure(draw_panels(panels, columns=columns, width=16), path)


class Frame(NamedTuple):
    """A fused frame at alpha's view.

    image: (C, H, W), in alpha's coding, not cut to 0..1.
    depth: (H, W), metres along alpha's axis; NaN where no calibrated beta tells it.
    confidence: (H, W), 0 to 1: that every band's beta sees the point, and that it is known where.
    """

    image: Float[Tensor, "c h w"]
    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]
