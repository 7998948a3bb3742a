"""What the explorer draws: images with marks, zoomed patches, weights against depth, the rig in space."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from bokeh.models import ColumnDataSource, Range1d
from bokeh.models.annotations import Legend
from bokeh.plotting import figure
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Camera, Rig
from arraygeom.viz import COLOURS, calibrated, frustum, frustum_size, interactive_rig

from ..media.colour import to_bytes
from .pixel import BetaReport, ExplorerState
from .theme import NEUTRAL

SHOWN_PIXELS = 1_000_000
"""Larger images are drawn reduced; computations use them as they are."""
HALF_PATCH = 16
"""Pixels to either side in a zoomed patch."""
RAY = 6.0
"""How far the pixel's ray is drawn, in lengths of the frusta."""

Columns = dict[str, Any]


def colour_of(index: int) -> str:
    """The colour of a beta, by its place among the betas."""
    return COLOURS[(index + 1) % len(COLOURS)]


class BetaSources(NamedTuple):
    """Bokeh's data sources of one beta; the samples have depth and weight."""

    segment: ColumnDataSource
    samples: ColumnDataSource
    match: ColumnDataSource
    patch: ColumnDataSource
    found: ColumnDataSource


def beta_sources(name: str) -> BetaSources:
    """Empty ones, named so that a page's script can find them."""
    parts: tuple[Columns, ...] = (*beta_data(None), no_patch(), {"x": [], "y": []})
    return BetaSources(*(ColumnDataSource(d, name=f"{k}:{name}") for k, d in zip(BetaSources._fields, parts)))


def beta_data(report: BetaReport | None) -> tuple[Columns, Columns, Columns]:
    """Columns of the segment's ends (far, near), of the samples, and of the expected match."""
    if report is None:
        samples: Columns = {key: [] for key in ("x", "y", "weight", "share", "depth", "size")}
        return {"x": [], "y": []}, samples, {"x": [], "y": []}
    ends = np.empty((0, 2)) if report.ends is None else report.ends.numpy()
    valid = report.valid
    x, y = report.xy[valid].numpy().T
    weight = report.weight[valid].numpy()
    share = weight / max(float(weight.max(initial=0.0)), 1e-9)
    size, depth = 2 + 12 * np.sqrt(share), report.depth[valid].numpy()
    samples = {"x": x, "y": y, "weight": weight, "share": share, "depth": depth, "size": size}
    match = [[float(v)] if bool(valid.any()) else [] for v in report.position]
    return {"x": ends[:, 0], "y": ends[:, 1]}, samples, {"x": match[0], "y": match[1]}


def found_data(report: BetaReport | None) -> Columns:
    """Columns of where the images match, on the line or beside it."""
    if report is None or report.offset is None:
        return {"x": [], "y": []}
    return {"x": [float(report.offset.position[0])], "y": [float(report.offset.position[1])]}


def no_patch() -> Columns:
    """Columns of no patch."""
    return {key: [] for key in ("image", "x", "y", "dw", "dh")}


def patch_data(image: Float[Tensor, "c h w"], middle: tuple[float, float]) -> Columns:
    """Columns of the part of an image around a point."""
    h, w = image.shape[1:]
    left, top = (round(v) - HALF_PATCH for v in middle)
    box = (max(top, 0), min(top + 2 * HALF_PATCH + 1, h), max(left, 0), min(left + 2 * HALF_PATCH + 1, w))
    if box[0] >= box[1] or box[2] >= box[3]:
        return no_patch()
    part = rgba(image[:, box[0] : box[1], box[2] : box[3]])
    dh, dw = part.shape
    return {"image": [part], "x": [box[2] - 0.5], "y": [box[0] - 0.5], "dw": [dw], "dh": [dh]}


def image_figure(hw: tuple[int, int], source: ColumnDataSource) -> Any:
    """An image with pixel centres at whole numbers and y downwards, as wide as there is room."""
    h, w = hw
    drawn = bare_figure(sizing_mode="scale_width", width=600, height=round(600 * h / w), active_scroll="wheel_zoom")
    drawn.x_range, drawn.y_range = Range1d(start=-0.5, end=w - 0.5), Range1d(start=h - 0.5, end=-0.5)
    drawn.image_rgba("image", x=-0.5, y=-0.5, dw=w, dh=h, source=source)
    return drawn


def patch_figure(source: ColumnDataSource) -> Any:
    """A zoomed patch; `centre_patch` moves it."""
    drawn = bare_figure(width=210, height=210)
    drawn.x_range, drawn.y_range = Range1d(start=0, end=1), Range1d(start=1, end=0)
    drawn.image_rgba("image", x="x", y="y", dw="dw", dh="dh", source=source)
    return drawn


def centre_patch(drawn: Any, middle: tuple[float, float]) -> None:
    """Move a patch's view to a point."""
    x, y = (round(v) for v in middle)
    extent = HALF_PATCH + 0.5
    drawn.x_range.update(start=x - extent, end=x + extent)
    drawn.y_range.update(start=y + extent, end=y - extent)


def bare_figure(**options: Any) -> Any:
    """A figure without axes, grid and toolbar."""
    drawn = figure(tools="pan,wheel_zoom,reset", toolbar_location=None, min_border=0, **options)
    drawn.grid.visible = drawn.axis.visible = False  # measuring labels takes a third of the painting time
    drawn.background_fill_color = drawn.border_fill_color = drawn.outline_line_color = None
    return drawn


def draw_cross(drawn: Any, source: ColumnDataSource, *, size: int = 16) -> None:
    """A cross with a dark rim."""
    drawn.scatter("x", "y", source=source, marker="cross", size=size + 2, color="black", line_width=4)
    drawn.scatter("x", "y", source=source, marker="cross", size=size, color="yellow", line_width=2)


def draw_segment(drawn: Any, source: ColumnDataSource, colour: str) -> None:
    """A line on a light rim."""
    drawn.line("x", "y", source=source, color="white", line_width=5, alpha=0.8)
    drawn.line("x", "y", source=source, color=colour, line_width=2.5)


def depth_figure(sources: dict[str, BetaSources]) -> Any:
    """Weights against depth, the legend above them."""
    drawn = figure(
        height=360,
        sizing_mode="stretch_width",
        x_axis_type="log",
        x_axis_label="depth (m)",
        y_axis_label="weight, the highest being 1",
        y_range=Range1d(start=0, end=1.05),  # labels of changing size would lay out the whole page again
        tools="pan,wheel_zoom,reset",
        toolbar_location=None,
        output_backend="canvas",
    )
    legend = Legend(orientation="horizontal", border_line_color=None, background_fill_color=None)
    legend.label_text_color = NEUTRAL
    drawn.add_layout(legend, "above")
    for index, (name, source) in enumerate(sources.items()):
        colour = colour_of(index)
        drawn.line("depth", "share", source=source.samples, color=colour, legend_label=name)
        drawn.scatter("depth", "share", source=source.samples, color=colour, size=4)
    drawn.background_fill_color = drawn.border_fill_color = None
    drawn.outline_line_color = NEUTRAL
    drawn.grid.grid_line_color, drawn.grid.grid_line_alpha = NEUTRAL, 0.25
    for part in ("axis_label_text_color", "major_label_text_color", "axis_line_color", "major_tick_line_color"):
        setattr(drawn.axis, part, NEUTRAL)
    drawn.axis.minor_tick_line_color = None
    return drawn


def rgba(image: Float[Tensor, "c h w"]) -> np.ndarray:
    """The image as Bokeh wants it, (H, W) of 32 bits, reduced if it is very large."""
    shrink = math.sqrt(SHOWN_PIXELS / (image.shape[1] * image.shape[2]))
    if shrink < 1:
        image = interpolate(image[None], scale_factor=shrink, mode="bilinear", antialias=True)[0]
    colours = image if image.shape[0] == 3 else image.mean(0, keepdim=True).expand(3, -1, -1)
    opaque = torch.cat([colours, torch.ones_like(colours[:1])])
    return np.ascontiguousarray(to_bytes(opaque).transpose(1, 2, 0)).view(np.uint32)[..., 0]


def space(rig: Rig, alpha: str) -> dict[str, Any]:
    """The rig in 3-D as plotly's plain data; nothing if no camera is calibrated."""
    if not any(isinstance(c, Camera) for c in rig.cameras.values()):
        return {"data": [], "layout": {"title": "no camera is calibrated: no drawing in space"}}
    drawn = interactive_rig(rig.replace(depth=None), alpha=alpha if isinstance(rig[alpha], Camera) else None)
    margin = {"l": 0, "r": 0, "t": 0, "b": 0}
    drawn.update_layout(margin=margin, uirevision="rig", showlegend=False, title=None)
    drawn.update_layout(paper_bgcolor="rgba(0,0,0,0)", font_color=NEUTRAL)
    axis = {"gridcolor": NEUTRAL, "backgroundcolor": "rgba(0,0,0,0)", "zerolinecolor": NEUTRAL, "nticks": 4}
    drawn.update_scenes(xaxis=axis, yaxis=axis, zaxis=axis, camera_eye={"x": -1.3, "y": -1.9, "z": 1.0})
    drawn.update_scenes(**around_cameras(rig))
    return drawn.to_plotly_json()


def around_cameras(rig: Rig) -> dict[str, Any]:
    """Ranges of plotly's axes (x, z, -y) that hold all cameras and the beginning of alpha's ray."""
    cameras = calibrated(rig)
    size = frustum_size(cameras)
    points = np.concatenate([line for camera in cameras.values() for line in frustum(camera, size)])
    (x0, y0, z0), (x1, y1, z1) = np.nanmin(points, 0) - 0.6 * size, np.nanmax(points, 0) + 0.6 * size
    ranges = {"xaxis": (x0, x1), "yaxis": (z0, z1 + (RAY - 1) * size), "zaxis": (-y1, -y0)}
    return {f"{axis}_range": [float(v) for v in ends] for axis, ends in ranges.items()}


def ray_trace(rig: Rig, state: ExplorerState) -> list[dict[str, Any]]:
    """The beginning of the pixel's ray as a trace of plotly's; empty if alpha is not calibrated."""
    camera = rig[state.alpha]
    if not isinstance(camera, Camera):
        return []
    depth = torch.tensor([RAY * frustum_size(calibrated(rig))], dtype=torch.float64)
    end = camera.unproject(torch.tensor([state.x], dtype=torch.float64), depth)
    x, y, z = torch.cat([camera.centre[None], end]).detach().numpy().T
    line = {"color": "gold", "width": 6}
    return [{"type": "scatter3d", "x": x, "y": z, "z": -y, "mode": "lines", "line": line, "name": "the pixel"}]
