"""The explorer's controls."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import panel as pn
from bokeh.models import CustomJSTickFormatter

from arraygeom import Rig

from .pixel import FAMILIES, ExplorerState, parameter_lengths
from .theme import WIDGET

UNITS = {
    "rotation": (180 / math.pi, "xyz", 3.0, 0.05, "deg"),
    "translation": (1000.0, "xyz", 50.0, 0.5, "mm"),
    "focal": (1.0, "xy", 50.0, 0.5, "px"),
    "centre": (1.0, "xy", 30.0, 0.5, "px"),
    "distortion": (1.0, "", 0.2, 0.002, ""),
}
"""By kind of parameter: shown units per unit of the rig, names of its parts, range and step of the slider, unit."""
FARTHEST = 1000.0
"""Metres at which an infinite far is shown until it is changed."""


class Controls:
    """Sliders that call `update` with the changed part of the state."""

    def __init__(self, rig: Rig, state: ExplorerState, update: Callable[..., None]) -> None:
        self.update = update
        self.changes: dict[str, list[float]] = {name: [0.0] * n for name, n in parameter_lengths(rig).items()}
        self.family = pn.widgets.Select(
            label="field",
            options=list(dict.fromkeys([*FAMILIES, state.family])),
            value=state.family,
            stylesheets=[WIDGET],
            sizing_mode="stretch_width",
        )
        self.family.param.watch(lambda e: update(family=e.new), "value")
        self.depths = [] if rig.depth is None else depth_controls(rig, update)
        self.sliders = field_sliders(update)
        self.numbers = {name: self._sliders_of(name) for name in self.changes}
        self.all = [self.family, *self.depths, *self.sliders, *(s for some in self.numbers.values() for s in some)]
        self.initial = [widget.value for widget in self.all]

    def reset(self) -> None:
        """All controls as they were at the beginning."""
        for widget, value in zip(self.all, self.initial):
            widget.value = value
        self.update(near=None, far=None)

    def panel(self) -> pn.viewable.Viewable:
        """Field and depth above, the parameters of each camera below."""
        cameras = dict.fromkeys(name.rpartition(".")[0] for name in self.numbers)
        moved = [
            pn.Card(
                *(s for n, found in self.numbers.items() if n.rpartition(".")[0] == camera for s in found),
                title=f"move {camera}",
                collapsed=True,
                header_color="var(--pat-ink, inherit)",
                stylesheets=[WIDGET],
                width=270,
                margin=(4, 10),
            )
            for camera in cameras
        ]
        rows = [pn.Row(*self.depths[i : i + 2]) for i in range(0, len(self.depths), 2)]
        return pn.Column(self.family, *rows, *self.sliders, *moved, width=290)

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


class Slider(pn.widgets.FloatSlider):
    """Panel's slider with a shorter debounce: the default of 50 ms is half of the time that we allow."""

    _debounce: ClassVar[int] = 5


def depth_controls(rig: Rig, update: Callable[..., None]) -> list[Any]:
    """Near and far, each as a slider on a logarithmic scale and as a number to type; an infinite far is shown as
    `FARTHEST` until changed."""
    assert rig.depth is not None
    near, far = (min(float(d), FARTHEST) for d in rig.depth)
    return [
        *linked("near", near, (near / 4, far), lambda v: update(near=v)),
        *linked("far", far, (near, max(4 * far, FARTHEST)), lambda v: update(far=v)),
    ]


def linked(name: str, value: float, ends: tuple[float, float], changed: Callable[[float], None]) -> list[Any]:
    """A slider of the decimal logarithm that shows the number itself, and a field to type it; either moves the other.

    A number that is typed beyond the slider's ends counts all the same.
    """
    low, high = (math.log10(e) for e in ends)
    shown = CustomJSTickFormatter(code="return (10 ** tick).toPrecision(3)")
    slide = Slider(
        label=f"{name} (m)",
        start=low,
        end=high,
        step=0.005,
        value=math.log10(value),
        format=shown,
        width=165,
        stylesheets=[WIDGET],
    )
    start = round(value, 4)
    typed = pn.widgets.FloatInput(label=f"type {name}", value=start, start=1e-6, width=85, stylesheets=[WIDGET])
    current = [value]

    def moved(number: float) -> None:
        if math.isclose(number, current[0], rel_tol=1e-3):
            return
        current[0] = number
        typed.value = round(number, 4)
        slide.value = min(max(math.log10(number), low), high)
        changed(number)

    def slid(event: Any) -> None:
        beyond = not low <= math.log10(current[0]) <= high
        if not (beyond and event.new in (low, high)):
            moved(10**event.new)

    def entered(event: Any) -> None:
        if event.new:
            moved(event.new)

    slide.param.watch(slid, "value")
    typed.param.watch(entered, "value")
    return [slide, typed]


def field_sliders(update: Callable[..., None]) -> list[Any]:
    """Displacement, width, sharpness. A displacement of 0 covers the depth range."""
    return [
        slider("displacement (px; 0: the depth range)", (0, 200, 1), 0, lambda v: update(displacement=v or None)),
        slider("widened by (px)", (0, 10, 0.5), 0, lambda v: update(across=v)),
        slider("sharpness of the weights", (1, 100, 1), 30, lambda v: update(sharpness=v)),
    ]


def slider(name: str, bounds: tuple[float, float, float], value: float, changed: Callable[[float], None]) -> Any:
    """A slider that calls `changed` with its value."""
    start, end, step = bounds
    made = Slider(
        label=name, start=start, end=end, step=step, value=value, sizing_mode="stretch_width", stylesheets=[WIDGET]
    )
    made.param.watch(lambda e: changed(e.new), "value")
    return made
