"""The explorer's page: images, the rig and controls, for a browser and for Jupyter."""

from __future__ import annotations

import html
import math
import re
import socket
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import panel as pn
import torch
from bokeh.events import Tap
from bokeh.models import ColumnDataSource, CustomJSTickFormatter, Range1d
from bokeh.plotting import figure
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate
from tornado.web import RequestHandler

from arraygeom import Camera, Rig
from arraygeom.viz import COLOURS, calibrated, extent_of, frustum_size, interactive_rig

from .pixel import (
    FAMILIES,
    BetaReport,
    ExplorerScene,
    ExplorerState,
    PixelReport,
    image_pixel,
    inspect_pixel,
    parameter_lengths,
)

UNITS = {
    "rotation": (180 / math.pi, "xyz", 3.0, 0.05, "deg"),
    "translation": (1000.0, "xyz", 50.0, 0.5, "mm"),
    "focal": (1.0, "xy", 50.0, 0.5, "px"),
    "centre": (1.0, "xy", 30.0, 0.5, "px"),
    "distortion": (1.0, "", 0.2, 0.002, ""),
}
"""By kind of parameter: shown units per unit of the rig, names of its parts, range and step of the slider, unit."""

SETTLED = 150
"""Milliseconds without a change after which the rig in space is redrawn."""

SHOWN_PIXELS = 2_000_000
"""Larger images are drawn reduced; computations use them as they are."""


class Explorer:
    """Widgets and figures of an `ExplorerState`; `report` is what is drawn, `panel()` is for a page or a cell."""

    def __init__(self, scene: ExplorerScene, alpha: str) -> None:
        hw = scene.rig[alpha].hw
        self.scene = scene
        self.state = ExplorerState(alpha, image_pixel(hw[1] / 2, hw[0] / 2, hw))
        self.betas = [n for n in scene.rig.betas(alpha) if n in scene.images]
        self.marker = ColumnDataSource({"x": [], "y": []}, name="pixel")
        self.sources = {name: beta_sources(name) for name in self.betas}
        self.facts = pn.pane.HTML(name="facts", sizing_mode="stretch_width", min_height=60)
        self.space = pn.pane.Plotly(None, height=340, sizing_mode="stretch_width", config={"displaylogo": False})
        self.drawn: tuple[object, dict[str, Any]] = None, {}
        self.pointed: tuple[float, float] | None = None
        self.waiting: Any = None
        self.controls = Controls(scene.rig, self.state, self.update)
        self.alpha_figure = self._alpha_figure()
        self.figures = [self._beta_figure(i, name) for i, name in enumerate(self.betas)]
        self.depth_figure = self._depth_figure()
        self.report: PixelReport | None = None
        self.show(self.state)

    def update(self, **changes: object) -> None:
        """Redraw for changed values of the controls."""
        self.show(self.state.replace(**changes))

    def select_pixel(self, event: Any) -> None:
        """Select the alpha pixel that was clicked."""
        hw = self.scene.rig[self.state.alpha].hw
        self.update(x=image_pixel(event.x, event.y, hw))

    def show(self, state: ExplorerState) -> PixelReport | None:
        """Compute a state and draw it. For an impossible state the error is shown and the drawing stays."""
        self.state = state
        try:
            report = inspect_pixel(self.scene, state)
        except ValueError as error:
            self.facts.object = f"<b>{html.escape(str(error))}</b>"
            return None
        self.report = report
        self.marker.data = {"x": [state.x[0]], "y": [state.x[1]]}
        for name, sources in self.sources.items():
            for source, data in zip(sources, beta_data(report.betas.get(name))):
                source.data = data
        self.facts.object = facts(state, report)
        self._once_settled()
        return report

    def _once_settled(self) -> None:
        """Draw the rig in space once the controls have settled: it takes a browser longer than all else together.

        At once the first time, and in a notebook, where no server can call back.
        """
        document = pn.state.curdoc
        if self.space.object is None or document is None or document.session_context is None:
            self._show_space()
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

    def panel(self) -> pn.viewable.Viewable:
        """The page."""
        images = pn.FlexBox(*map(pn.pane.Bokeh, (self.alpha_figure, *self.figures)))
        below = pn.Row(self.space, pn.pane.Bokeh(self.depth_figure))
        return pn.Row(self.controls.panel(), pn.Column(images, self.facts, below), sizing_mode="stretch_width")

    def _alpha_figure(self) -> Any:
        name = self.state.alpha
        drawn = image_figure(f"{name} (alpha): click a pixel", self.scene.rig[name].hw, self.scene.images[name])
        drawn.scatter("x", "y", source=self.marker, marker="cross", size=18, color="black", line_width=4)
        drawn.scatter("x", "y", source=self.marker, marker="cross", size=16, color="yellow", line_width=2)
        drawn.name = "alpha"
        drawn.on_event(Tap, self.select_pixel)
        return drawn

    def _beta_figure(self, index: int, name: str) -> Any:
        drawn = image_figure(name, self.scene.rig[name].hw, self.scene.images[name])
        segment, samples, match = self.sources[name]
        colour = COLOURS[(index + 1) % len(COLOURS)]
        drawn.line("x", "y", source=segment, color="white", line_width=7, alpha=0.85)
        drawn.line("x", "y", source=segment, color=colour, line_width=3)
        drawn.scatter("x", "y", source=samples, size="size", color=colour, fill_alpha=0.45, line_alpha=0.7)
        drawn.scatter("x", "y", source=match, marker="cross", size=18, color="yellow", line_width=2)
        return drawn

    def _depth_figure(self) -> Any:
        drawn = figure(
            width=440,
            height=340,
            title="weight against depth (m), the highest being 1",
            x_axis_type="log",
            y_range=Range1d(start=0, end=1.05),  # labels of changing size would lay out the whole page again
            tools="pan,wheel_zoom,reset",
            output_backend="canvas",
        )
        for index, name in enumerate(self.betas):
            colour = COLOURS[(index + 1) % len(COLOURS)]
            drawn.line("depth", "share", source=self.sources[name].samples, color=colour, legend_label=name)
            drawn.scatter("depth", "share", source=self.sources[name].samples, color=colour, size=4)
        if self.betas:
            drawn.legend.location = "top_left"
            drawn.legend.background_fill_alpha = 0.4
        return drawn


class Controls:
    """Sliders that call `update` with the changed part of the state."""

    def __init__(self, rig: Rig, state: ExplorerState, update: Any) -> None:
        self.update = update
        self.changes: dict[str, list[float]] = {name: [0.0] * n for name, n in parameter_lengths(rig).items()}
        self.family = pn.widgets.Select(label="field", options=list(FAMILIES), value=state.family)
        self.family.param.watch(lambda e: update(family=e.new), "value")
        self.sliders = [*depth_sliders(rig, update), *field_sliders(update)]
        self.numbers = {name: self._sliders_of(name) for name in self.changes}

    def panel(self) -> pn.viewable.Viewable:
        """Field and depth above, the parameters of each camera below."""
        cameras = dict.fromkeys(name.rpartition(".")[0] for name in self.numbers)
        groups = [
            (
                camera,
                pn.Column(*(s for n, found in self.numbers.items() if n.rpartition(".")[0] == camera for s in found)),
            )
            for camera in cameras
        ]
        return pn.Column(self.family, *self.sliders, pn.Accordion(*groups, toggle=True), width=320)

    def _sliders_of(self, name: str) -> list[Any]:
        kind = name.rpartition(".")[2]
        scale, parts, extent, step, unit = UNITS[kind]

        def changed(index: int, shown: float) -> None:
            self.changes[name][index] = shown / scale
            self.update(changes={n: tuple(v) for n, v in self.changes.items() if any(v)})

        return [
            slider(
                f"{name} {parts[i] if parts else i} ({unit})" if unit else f"{name} {i}",
                (-extent, extent, step),
                0.0,
                lambda value, i=i: changed(i, value),
            )
            for i in range(len(self.changes[name]))
        ]


class BetaSources(NamedTuple):
    """Bokeh's data sources of one beta; the samples have depth and weight."""

    segment: ColumnDataSource
    samples: ColumnDataSource
    match: ColumnDataSource


def beta_sources(name: str) -> BetaSources:
    """Empty ones, named so that a page's script can find them."""
    return BetaSources(*(ColumnDataSource(d, name=f"{k}:{name}") for k, d in zip(BetaSources._fields, beta_data(None))))


def beta_data(report: BetaReport | None) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Columns of the segment's ends (near, far), of the samples, and of the expected match."""
    if report is None:
        return (
            {"x": [], "y": []},
            {"x": [], "y": [], "weight": [], "share": [], "depth": [], "size": []},
            {"x": [], "y": []},
        )
    ends = np.empty((0, 2)) if report.ends is None else report.ends.numpy()
    valid = report.valid
    x, y = report.xy[valid].numpy().T
    weight = report.weight[valid].numpy()
    share = weight / max(float(weight.max(initial=0.0)), 1e-9)
    size, depth = 2 + 12 * np.sqrt(share), report.depth[valid].numpy()
    samples = {"x": x, "y": y, "weight": weight, "share": share, "depth": depth, "size": size}
    match = [[float(v)] if bool(valid.any()) else [] for v in report.position]
    return {"x": ends[:, 0], "y": ends[:, 1]}, samples, {"x": match[0], "y": match[1]}


def image_figure(title: str, hw: tuple[int, int], image: Float[Tensor, "c h w"]) -> Any:
    """An image with pixel centres at whole numbers and y downwards."""
    h, w = hw
    drawn = figure(
        title=title,
        frame_width=450,
        frame_height=round(450 * h / w),
        x_range=Range1d(start=-0.5, end=w - 0.5),
        y_range=Range1d(start=h - 0.5, end=-0.5),
        match_aspect=True,
        tools="pan,wheel_zoom,reset",
        active_scroll="wheel_zoom",
    )
    drawn.image_rgba([rgba(image)], x=-0.5, y=-0.5, dw=w, dh=h)
    drawn.grid.visible = drawn.axis.visible = False  # measuring labels takes a third of the painting time
    return drawn


def rgba(image: Float[Tensor, "c h w"]) -> np.ndarray:
    """The image as Bokeh wants it, (H, W) of 32 bits, reduced if it is very large."""
    shrink = math.sqrt(SHOWN_PIXELS / (image.shape[1] * image.shape[2]))
    if shrink < 1:
        image = interpolate(image[None], scale_factor=shrink, mode="bilinear", antialias=True)[0]
    colours = image if image.shape[0] == 3 else image.mean(0, keepdim=True).expand(3, -1, -1)
    opaque = torch.cat([colours.clamp(0, 1), torch.ones_like(colours[:1])])
    bytes_ = (255 * opaque).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    return bytes_.view(np.uint32)[..., 0]


class Slider(pn.widgets.FloatSlider):
    """Panel's slider with a shorter debounce: the default of 50 ms is half of the time that we allow."""

    _debounce: ClassVar[int] = 5


def depth_sliders(rig: Rig, update: Any) -> list[Any]:
    """Near and far on logarithmic scales, if the rig has them; an infinite far is shown as 1000 m until changed."""
    if rig.depth is None:
        return []
    near, far = (min(float(d), 1000.0) for d in rig.depth)
    return [
        logarithmic("near (m)", near, (near / 4, far), lambda v: update(near=v)),
        logarithmic("far (m)", far, (near, max(4 * far, 1000.0)), lambda v: update(far=v)),
    ]


def logarithmic(name: str, value: float, ends: tuple[float, float], changed: Any) -> Any:
    """A slider of the decimal logarithm that shows the number itself."""
    low, high = (math.log10(e) for e in ends)
    shown = CustomJSTickFormatter(code="return (10 ** tick).toPrecision(3)")
    made = Slider(label=name, start=low, end=high, step=0.005, value=math.log10(value), format=shown)
    made.param.watch(lambda e: changed(10**e.new), "value")
    return made


def field_sliders(update: Any) -> list[Any]:
    """Displacement, width, sharpness. A displacement of 0 covers the depth range."""
    return [
        slider("displacement (px; 0: the depth range)", (0, 200, 1), 0, lambda v: update(displacement=v or None)),
        slider("widened by (px)", (0, 10, 0.5), 0, lambda v: update(across=v)),
        slider("sharpness of the weights", (1, 100, 1), 30, lambda v: update(sharpness=v)),
    ]


def slider(name: str, bounds: tuple[float, float, float], value: float, changed: Any) -> Any:
    """A slider that calls `changed` with its value."""
    start, end, step = bounds
    made = Slider(label=name, start=start, end=end, step=step, value=value)
    made.param.watch(lambda e: changed(e.new), "value")
    return made


def facts(state: ExplorerState, report: PixelReport) -> str:
    """A line of HTML for the pixel, and one for each beta."""
    depth = f"depth {report.depth:.3g} m" if math.isfinite(report.depth) else "no depth"
    lines = [f"<b>pixel ({state.x[0]:.0f}, {state.x[1]:.0f})</b> {depth}, fused colour {swatch(report.colour)}"]
    for name, beta in report.betas.items():
        length = f"length {float((beta.ends[1] - beta.ends[0]).norm()):.1f} px, " if beta.ends is not None else ""
        lines.append(
            f"<b>{html.escape(name)}</b> {length}{int(beta.valid.sum())} samples, peak {beta.peak:.2f}, "
            f"deviation {beta.deviation:.1f} px, colour {swatch(beta.value)}"
        )
    lines += [f"<b>{html.escape(n)}</b> {html.escape(problem)}" for n, problem in report.problems.items()]
    return "<br>".join(lines)


def swatch(colour: Float[Tensor, "c"]) -> str:
    """A square of the colour, and its numbers."""
    values = [float(v) for v in colour.clamp(0, 1)]
    r, g, b = (round(255 * v) for v in (values if len(values) == 3 else [sum(values) / len(values)] * 3))
    square = f'<span style="display:inline-block;width:1.4em;height:1em;background:rgb({r},{g},{b})"></span>'
    return f"{square} ({', '.join(f'{v:.2f}' for v in values)})"


def space(rig: Rig, alpha: str) -> dict[str, Any]:
    """The rig in 3-D as plotly's plain data; nothing if no camera is calibrated."""
    if not any(isinstance(c, Camera) for c in rig.cameras.values()):
        return {"data": [], "layout": {"title": "no camera is calibrated: no drawing in space"}}
    drawn = interactive_rig(rig, alpha=alpha if isinstance(rig[alpha], Camera) else None)
    drawn.update_layout(margin={"l": 0, "r": 0, "t": 30, "b": 0}, uirevision="rig", showlegend=False)
    drawn.update_scenes(**around_cameras(rig))
    return drawn.to_plotly_json()


def around_cameras(rig: Rig) -> dict[str, Any]:
    """Ranges of plotly's axes (x, z, -y) in which the cameras are large; farther parts are cut off."""
    cameras = calibrated(rig)
    centres = np.stack([camera.centre.detach().double().numpy() for camera in cameras.values()])
    room = max(extent_of(cameras), 1.5 * frustum_size(cameras))
    (x0, y0, z0), (x1, y1, z1) = centres.min(0) - room, centres.max(0) + room
    ranges = {"xaxis": (x0, x1), "yaxis": (z0, z1 + 2 * room), "zaxis": (-y1, -y0)}
    return {f"{axis}_range": [float(v) for v in ends] for axis, ends in ranges.items()}


def ray_trace(rig: Rig, state: ExplorerState) -> list[dict[str, Any]]:
    """The pixel's ray from near to far as a trace of plotly's; empty if alpha is not calibrated."""
    ray = pixel_ray(rig, state)
    if ray is None:
        return []
    x, y, z = ray.T
    line = {"color": "gold", "width": 6}
    return [{"type": "scatter3d", "x": x, "y": z, "z": -y, "mode": "lines", "line": line, "name": "the pixel"}]


def pixel_ray(rig: Rig, state: ExplorerState) -> np.ndarray | None:
    """World points on the pixel's ray: alpha's centre, near, far (at most 40 m), (3, 3); None if they are not known."""
    camera = rig[state.alpha]
    if rig.depth is None or not isinstance(camera, Camera):
        return None
    near, far = (min(float(d), 40.0) for d in rig.depth)
    x = torch.tensor([state.x] * 2, dtype=torch.float64)
    ends = camera.unproject(x, torch.tensor([near, far], dtype=torch.float64))
    return torch.cat([camera.centre[None], ends]).detach().numpy()


def explorer(
    rig: Rig, images: Mapping[str, Float[Tensor, "_ _ _"]], *, alpha: str | None = None
) -> pn.viewable.Viewable:
    """The explorer of a rig and images (C, H, W) by camera name, to show in a cell of a notebook.

    `alpha` is the camera to click in, by default the first with an image. Raises ValueError for a camera the rig
    lacks, an image of another size, and if alpha or every beta has no image.
    """
    return Explorer(*prepared(rig, images, alpha)).panel()


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


def serve(
    rig: Rig,
    images: Mapping[str, Float[Tensor, "_ _ _"]],
    *,
    alpha: str | None = None,
    port: int = 0,
    browser: bool = True,
) -> None:
    """Serve the explorer to this machine alone until interrupted; port 0 takes a free one.

    Requests for other host names than this machine's are refused, whatever their origin: a foreign page whose name is
    made to resolve to this machine must not read the images. Raises as `explorer`, and ValueError for a port that is
    none or in use.
    """
    check_port(port)
    scene, alpha = prepared(rig, images, alpha)
    port = port or free_port()
    server = pn.serve(
        {"/": lambda: Explorer(scene, alpha).panel()},
        port=port,
        address="localhost",
        websocket_origin=[f"{name}:{port}" for name in OWN_NAMES],
        show=False,
        start=False,
        title=f"pat explore {rig.name}".strip(),
        verbose=False,
    )
    refuse_foreign_hosts(server)
    print(f"the explorer is at http://localhost:{port} (Ctrl+C ends it)", flush=True)
    server.start()
    if browser:
        server.show("/")
    try:
        server.io_loop.start()
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()


OWN_NAMES = ("localhost", "127.0.0.1")
"""Host names of this machine."""


class ForeignHost(RequestHandler):
    """The answer to requests for another host."""

    def prepare(self) -> None:
        """Refuse."""
        self.set_status(403)
        self.finish("the explorer answers to localhost alone\n")


def refuse_foreign_hosts(server: Any) -> None:
    """Refuse every request, WebSockets included, whose Host is not this machine's, before any other rule applies."""
    own = "|".join(map(re.escape, OWN_NAMES))
    server._tornado.add_handlers(f"(?!(?:{own})$).*", [(r".*", ForeignHost)])


def check_port(port: int) -> None:
    """Raises ValueError for a number that is no port, or a port that is in use."""
    if not 0 <= port <= 65535:
        raise ValueError(f"--port {port}: wanted 1 to 65535, or 0 for a free one")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("localhost", port))
        except OSError as error:
            raise ValueError(f"--port {port}: {error.strerror}: give another, or 0 for a free one") from None


def free_port() -> int:
    """A port on localhost that nothing listens at."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]
