"""The explorer's page: images, the rig and controls, for a browser and for Jupyter."""

from __future__ import annotations

import asyncio
import html
import io
import math
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import panel as pn
from bokeh.events import Tap
from bokeh.models import ColumnDataSource
from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig
from arraygeom.io.native import write as rig_text

from .controls import Controls
from .figures import (
    beta_data,
    beta_sources,
    centre_patch,
    colour_of,
    depth_figure,
    draw_cross,
    draw_segment,
    found_data,
    image_figure,
    no_patch,
    patch_data,
    patch_figure,
    ray_trace,
    rgba,
    space,
)
from .pixel import BetaReport, ExplorerScene, ExplorerState, PixelReport, changed_rig, image_pixel, inspect_pixel
from .theme import CARD, HEADING, TEXT, TOGGLE, WIDGET

SETTLED = 150
"""Milliseconds without a change after which the rig in space is redrawn."""
EMPTY: dict[str, list[float]] = {"x": [], "y": []}
"""Columns of nothing."""


class Explorer:
    """Widgets and figures of an `ExplorerState`; `report` is what is drawn, `panel()` is for a page or a cell."""

    def __init__(self, scene: ExplorerScene, alpha: str, field: str = "auto") -> None:
        self.scene = scene
        self.state = self.initial = ExplorerState(alpha, textured_pixel(scene.guides[alpha]), family=field)
        self.betas = [n for n in scene.rig.betas(alpha) if n in scene.images]
        self.marker = ColumnDataSource(dict(EMPTY), name="pixel")
        self.backwards = ColumnDataSource(dict(EMPTY), name="backwards")
        self.own_patch = ColumnDataSource(no_patch(), name="patch")
        self.shown = ColumnDataSource({"image": [rgba(scene.images[alpha])]}, name="alpha image")
        self.fused: dict[str, Tensor] = {}
        self.sources = {name: beta_sources(name) for name in self.betas}
        self.facts = pn.pane.HTML(name="facts", sizing_mode="stretch_width", styles=TEXT)
        self.captions = {n: pn.pane.HTML(sizing_mode="stretch_width", styles=TEXT) for n in (alpha, *self.betas)}
        self.space = pn.pane.Plotly(None, height=360, sizing_mode="stretch_width", config={"displayModeBar": False})
        self.drawn: tuple[object, dict[str, Any]] = None, {}
        self.pointed: tuple[float, float] | None = None
        self.waiting: Any = None
        self.controls = Controls(scene.rig, self.state, self.update)
        self.layer = pn.widgets.RadioButtonGroup(
            label="layer", options=["camera", "fused"], value="camera", stylesheets=[WIDGET]
        )
        self.layer.param.watch(self._show_layer, "value")
        self.alpha_figure = self._alpha_figure()
        self.figures = [self._beta_figure(i, name) for i, name in enumerate(self.betas)]
        self.patches = {name: self._patch(i - 1, name) for i, name in enumerate((alpha, *self.betas))}
        self.depth_figure = depth_figure(self.sources)
        self.report: PixelReport | None = None
        self.show(self.state)

    def update(self, **changes: object) -> None:
        """Redraw for changed values of the controls."""
        self.show(self.state.replace(**changes))

    def select_pixel(self, event: Any) -> None:
        """Select the alpha pixel that was clicked."""
        hw = self.scene.rig[self.state.alpha].hw
        self.backwards.data = dict(EMPTY)
        self.update(x=image_pixel(event.x, event.y, hw))

    def select_beta_pixel(self, name: str, event: Any) -> None:
        """Draw the segment in alpha of a pixel that was clicked in a beta, and select alpha's pixel that matches it."""
        x = image_pixel(event.x, event.y, self.scene.rig[name].hw)
        try:
            found = inspect_pixel(self.scene, self.state.replace(alpha=name, x=x)).betas.get(self.state.alpha)
        except ValueError as error:
            self._say(str(error))
            return
        if found is None or not bool(found.valid.any()):
            self._say(f"no pixel of {self.state.alpha} can match ({x[0]:.0f}, {x[1]:.0f}) of {name}")
            return
        self.backwards.data = beta_data(found)[0]
        best = found.xy[found.weight.argmax()].tolist()
        self.update(x=image_pixel(best[0], best[1], self.scene.rig[self.state.alpha].hw))

    def show(self, state: ExplorerState) -> PixelReport | None:
        """Compute a state and draw it. For an impossible state the error is shown and the drawing stays."""
        self.state = state
        try:
            report = inspect_pixel(self.scene, state)
        except ValueError as error:
            self._say(str(error))
            return None
        self.report = report
        self.marker.data = {"x": [state.x[0]], "y": [state.x[1]]}
        self.own_patch.data = patch_data(self.scene.images[state.alpha], state.x)
        centre_patch(self.patches[state.alpha], state.x)
        for name in self.betas:
            self._show_beta(name, report.betas.get(name))
        self.captions[state.alpha].object = alpha_caption(state, report)
        self._say_problems()
        self._once_settled()
        return report

    def reset(self) -> None:
        """The rig, the controls and the pixel as at the beginning."""
        self.controls.reset()
        self.backwards.data = dict(EMPTY)
        self.show(self.initial)

    def rig(self) -> Rig:
        """The rig as it is moved."""
        return changed_rig(self.scene.rig, self.state)

    def panel(self) -> pn.viewable.Viewable:
        """The page."""
        theme = pn.widgets.Button(label="light / dark", stylesheets=[WIDGET], width=100)
        theme.js_on_click(code=TOGGLE)
        reset = pn.widgets.Button(label="reset", stylesheets=[WIDGET], width=80)
        reset.on_click(lambda _: self.reset())
        save = pn.widgets.FileDownload(
            callback=lambda: io.StringIO(rig_text(self.rig())),
            filename="rig_moved.yaml",
            label="save the moved rig",
            stylesheets=[WIDGET],
            width=180,
        )
        heading = pn.pane.HTML(HEADING, sizing_mode="stretch_width", styles={"color": TEXT["color"]})
        head = pn.Row(heading, self.layer, reset, save, theme, sizing_mode="stretch_width", align="center")
        figures = [self.alpha_figure, *self.figures]
        views = [self._view(name, drawn) for name, drawn in zip((self.state.alpha, *self.betas), figures)]
        rows = [pn.Row(*views[i : i + 2], sizing_mode="stretch_width") for i in range(0, len(views), 2)]
        below = pn.Row(
            pn.Column(self.space, styles=CARD, sizing_mode="stretch_width"),
            pn.Column(
                pn.pane.Bokeh(self.depth_figure, sizing_mode="stretch_width"), styles=CARD, sizing_mode="stretch_width"
            ),
            sizing_mode="stretch_width",
        )
        main = pn.Column(*rows, self.facts, below, sizing_mode="stretch_width")
        side = pn.Column(self.controls.panel(), styles=CARD)
        return pn.Column(head, pn.Row(side, main, sizing_mode="stretch_width"), sizing_mode="stretch_width", margin=12)

    def _view(self, name: str, drawn: Any) -> pn.viewable.Viewable:
        """An image with its caption, the zoomed patch in a corner below."""
        image = pn.pane.Bokeh(drawn, sizing_mode="scale_width")
        below = pn.Row(pn.pane.Bokeh(self.patches[name]), self.captions[name], sizing_mode="stretch_width")
        return pn.Column(image, below, sizing_mode="stretch_width", styles=CARD)

    def _show_beta(self, name: str, report: BetaReport | None) -> None:
        source = self.sources[name]
        for part, data in zip((source.segment, source.samples, source.match), beta_data(report)):
            part.data = data
        source.found.data = found_data(report)
        self.captions[name].object = beta_caption(name, report)
        if report is None:
            return
        middle = report.position if report.offset is None else report.offset.position
        x, y = middle.tolist()
        source.patch.data = patch_data(self.scene.images[name], (x, y))
        centre_patch(self.patches[name], (x, y))

    def _say_problems(self) -> None:
        problems = {} if self.report is None else self.report.problems
        self.facts.object = "<br>".join(f"<b>{html.escape(n)}</b> {html.escape(text)}" for n, text in problems.items())

    def _say(self, text: str) -> None:
        self.facts.object = f"<b>{html.escape(text)}</b>"

    async def _show_layer(self, event: Any) -> None:
        """Alpha's image, or that fused with the rig as it now is."""
        document, wanted, text = pn.state.curdoc, self.scene.images[self.state.alpha], ""
        if event.new == "fused":
            key = rig_text(self.rig())
            if key not in self.fused:
                self._say("fusing with the rig as it is now ...")
                try:
                    self.fused = {key: await asyncio.to_thread(self._fuse)}
                except ValueError as error:
                    text = str(error)
            wanted = self.fused.get(key, wanted)

        def draw() -> None:
            if self.layer.value == event.new:
                self.shown.data = {"image": [rgba(wanted)]}
                self._say(text) if text else self._say_problems()

        if document is None or document.session_context is None:
            draw()
        else:  # after waiting, the document is no longer locked for this callback
            document.add_next_tick_callback(draw)

    def _fuse(self) -> Tensor:
        """The image fused at alpha's view."""
        from ..fusion.fuse import fuse
        from ..networks.weights import load_weights

        images = {name: self.scene.images[name] for name in (self.state.alpha, *self.betas)}
        coloured = any(len(images[name]) == 3 for name in self.betas) or len(self.betas) == 3
        weights = load_weights("mono-colour" if coloured else "mono-spectral")
        return fuse(weights, self.rig(), images, alpha=self.state.alpha, align=False).image

    def _once_settled(self) -> None:
        """Draw the rig in space once the controls have settled: it takes a browser longer than all else together.

        The first time once the page is there, and at once in a notebook, where no server can call back.
        """
        document = pn.state.curdoc
        if document is None or document.session_context is None:
            self._show_space()
            return
        if self.space.object is None:
            pn.state.onload(self._show_space)
            return
        if self.waiting is not None:
            document.remove_timeout_callback(self.waiting)
        self.waiting = document.add_timeout_callback(self._show_space, SETTLED)

    def _show_space(self) -> None:
        """Redraw the cameras only if the rig has changed, and the ray only if the pixel has."""
        self.waiting = None
        state, report = self.state, self.report
        if report is None:
            return
        key = (state.near, state.far, tuple(state.changes.items()))
        if key != self.drawn[0]:
            self.drawn = key, space(report.rig, state.alpha)
        elif state.x == self.pointed:
            return
        self.pointed = state.x
        rig = self.drawn[1]
        self.space.object = {**rig, "data": [*rig["data"], *ray_trace(report.rig, state)]}

    def _alpha_figure(self) -> Any:
        drawn = image_figure(self.scene.rig[self.state.alpha].hw, self.shown)
        draw_segment(drawn, self.backwards, "#d55e00")
        draw_cross(drawn, self.marker)
        drawn.name = "alpha"
        drawn.on_event(Tap, self.select_pixel)
        return drawn

    def _beta_figure(self, index: int, name: str) -> Any:
        image = ColumnDataSource({"image": [rgba(self.scene.images[name])]})
        drawn = image_figure(self.scene.rig[name].hw, image)
        source, colour = self.sources[name], colour_of(index)
        draw_segment(drawn, source.segment, colour)
        drawn.scatter("x", "y", source=source.samples, size="size", color=colour, fill_alpha=0.45, line_alpha=0.7)
        draw_cross(drawn, source.match)
        drawn.name = f"beta:{name}"
        drawn.on_event(Tap, lambda event: self.select_beta_pixel(name, event))
        return drawn

    def _patch(self, index: int, name: str) -> Any:
        """The zoomed patch of alpha (index -1) or of a beta."""
        if index < 0:
            drawn = patch_figure(self.own_patch)
            draw_cross(drawn, self.marker, size=14)
            return drawn
        source = self.sources[name]
        drawn = patch_figure(source.patch)
        drawn.line("x", "y", source=source.segment, color=colour_of(index), line_width=2)
        draw_cross(drawn, source.found, size=14)
        return drawn


def textured_pixel(guide: Float[Tensor, "1 1 h w"]) -> tuple[float, float]:
    """The strongest corner in the middle half of an image, where a match can be seen; its middle without any."""
    h, w = guide.shape[-2:]
    top, left = h // 4, w // 4
    middle = (255 * guide[0, 0, top : h - top, left : w - left].clamp(0, 1)).byte().numpy()
    found = cv2.goodFeaturesToTrack(np.ascontiguousarray(middle), 1, 0.01, 1)
    x, y = (w / 2, h / 2) if found is None else (found[0, 0] + (left, top)).tolist()
    return image_pixel(x, y, (h, w))


def alpha_caption(state: ExplorerState, report: PixelReport) -> str:
    """The pixel, its depth and its fused colour."""
    depth = f"depth {report.depth:.3g} m" if math.isfinite(report.depth) else "no depth"
    return (
        f"<b>{html.escape(state.alpha)}</b> (alpha): click a pixel<br>pixel ({state.x[0]:.0f}, {state.x[1]:.0f})"
        f"<br>{depth}<br>fused colour {swatch(report.colour)}"
    )


def beta_caption(name: str, report: BetaReport | None) -> str:
    """How far the images' own match lies from the line, and what the samples say."""
    head = f"<b>{html.escape(name)}</b> (beta): click goes the other way<br>"
    if report is None:
        return f"{head}no samples here"
    off = "no clear match near the line"
    if report.offset is not None:
        distance, correlation = report.offset.distance, report.offset.correlation
        off = f'<b style="font-size:1.25em">{distance:.1f} px off the line</b>, correlation {correlation:.2f}'
    length = "" if report.ends is None else f"segment {float((report.ends[1] - report.ends[0]).norm()):.1f} px, "
    return (
        f"{head}{off}<br>{length}{int(report.valid.sum())} samples<br>peak {report.peak:.2f}, deviation "
        f"{report.deviation:.1f} px<br>colour {swatch(report.value)}"
    )


def swatch(colour: Float[Tensor, "c"]) -> str:
    """A square of the colour, and its numbers."""
    values = [float(v) for v in colour.clamp(0, 1)]
    r, g, b = (round(255 * v) for v in (values if len(values) == 3 else [sum(values) / len(values)] * 3))
    square = f'<span style="display:inline-block;width:1.4em;height:1em;background:rgb({r},{g},{b})"></span>'
    return f"{square} ({', '.join(f'{v:.2f}' for v in values)})"


def explorer(
    rig: Rig, images: Mapping[str, Float[Tensor, "_ _ _"]], *, alpha: str | None = None, field: str = "auto"
) -> pn.viewable.Viewable:
    """The explorer of a rig and images (C, H, W) by camera name, to show in a cell of a notebook.

    `alpha` is the camera to click in, by default the first with an image; `field` the name of the one to begin with, or
    MODULE:OBJECT. Raises ValueError for a camera the rig lacks, an image of another size, and if alpha or every beta
    has no image.
    """
    return Explorer(*prepared(rig, images, alpha), field).panel()


def prepared(rig: Rig, images: Mapping[str, Tensor], alpha: str | None) -> tuple[ExplorerScene, str]:
    """The checked scene and alpha's name."""
    for name in images:
        rig.require(name)
    if len(images) < 2:
        raise ValueError("the explorer needs images of two cameras or more: give one of alpha and one of each beta")
    alpha = rig.require(alpha or next(n for n in rig.names if n in images))
    if alpha not in images:
        raise ValueError(f"no image of alpha, '{alpha}': give one, or choose another alpha")
    pn.extension("plotly")
    return ExplorerScene(rig, images), alpha
