"""The explorer in one line of a notebook, without a server or a network; and as a page of one file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, Rig
from arraygeom.atomic import write_text
from arraygeom.extras import needs

from .answers import DEFAULTS, answer, grid_answers, shown_cameras
from .checkered_room import checkered_room
from .pixel import ExplorerScene

with needs("explore", "the explorer in a notebook"):
    import anywidget
    import traitlets

MODULE = Path(__file__).with_name("widget.js")
FARTHEST = 1000.0
"""Metres at which an infinite far is shown until it is changed."""
GRID = 24
"""Columns of alpha's pixels whose answers are in a saved page."""


class FieldWidget(anywidget.AnyWidget):
    """Alpha and betas side by side; `controls` come from the browser, `answer` goes to it."""

    _esm = MODULE
    cameras: Any = traitlets.List().tag(sync=True)
    ranges: Any = traitlets.List().tag(sync=True)
    controls = traitlets.Dict().tag(sync=True)
    answer = traitlets.Dict().tag(sync=True)

    def __init__(self, scene: ExplorerScene | None, alpha: str, controls: dict[str, Any], error: str = "") -> None:
        self.scene, self.alpha, self.error = scene, alpha, error
        cameras = [] if scene is None else shown_cameras(scene, alpha)
        ranges = [] if scene is None else slider_ranges(scene.rig)
        super().__init__(cameras=cameras, ranges=ranges, controls=controls, answer=self._answer(controls))
        self.observe(self._respond, "controls")

    def save(self, path: str | Path, columns: int = GRID) -> None:
        """Write a page of one file that needs no kernel, with the answers for a grid of alpha's pixels."""
        if self.scene is None:
            grid: dict[str, Any] = {"columns": 1, "rows": 1, "answers": {"0,0": self.answer}}
        else:
            grid = grid_answers(self.scene, self.alpha, self.controls, columns)
        values = {"cameras": self.cameras, "ranges": [], "controls": self.controls, "answer": self.answer}
        script = MODULE.read_text().replace("export default { render };", "")
        data = json.dumps({"values": values, "grid": grid}).replace("</", "<\\/")
        write_text(path, PAGE.replace("MODULE", script).replace("DATA", data))

    def _answer(self, controls: dict[str, Any]) -> dict[str, Any]:
        return {"error": self.error} if self.scene is None else answer(self.scene, self.alpha, controls)

    def _respond(self, change: Any) -> None:
        self.answer = self._answer(change.new)


PAGE = """<!doctype html><meta charset="utf-8"><title>Receptive fields</title><body><script type="module">
MODULE
const { values, grid } = DATA;
let drawAgain = () => {};
const cell = (v, n, size) => Math.min(n - 1, Math.max(0, Math.floor(((v + 0.5) / size) * n)));
render({ el: document.body, model: {
  get: (name) => values[name], on: (_, call) => { drawAgain = call; }, save_changes: () => drawAgain(),
  set: (_, controls) => {
    const [h, w] = values.cameras[0].hw, [x, y] = controls.x;
    values.controls = controls;
    values.answer = grid.answers[`${cell(x, grid.columns, w)},${cell(y, grid.rows, h)}`];
  } } });
</script>
"""
"""The saved page: the widget's module with a model that answers from the grid."""


def slider_ranges(rig: Rig) -> list[list[Any]]:
    """Name, label and (low, high, step, value) of each slider that the rig has a use for."""
    ranges: list[list[Any]] = []
    if rig.depth is not None:
        near, far = (min(float(d), FARTHEST) for d in rig.depth)
        ranges.append(["near", "near (m)", [near / 4, far, (far - near / 4) / 500, near]])
        ranges.append(["far", "far (m)", [near, 4 * far, (4 * far - near) / 500, far]])
    if any(isinstance(camera, Camera) for camera in rig.cameras.values()):
        ranges.append(["baseline", "baseline (times)", [0.1, 4.0, 0.05, 1.0]])
        ranges.append(["rotation", "rotation (degrees)", [-3.0, 3.0, 0.05, 0.0]])
    return ranges


def explore(
    rig: Rig,
    images: Mapping[str, Float[Tensor, "_ _ _"]] | None = None,
    *,
    alpha: str | None = None,
    x: tuple[float, float] | None = None,
    near: float | None = None,
    far: float | None = None,
    baseline: float = DEFAULTS["baseline"],
    rotation: float = DEFAULTS["rotation"],
) -> FieldWidget:
    """The receptive fields of a rig in a cell of a notebook: point at a pixel of alpha, and move the rig.

    `images` (C, H, W) by camera name; without any a checkered room is shown. `x` is alpha's pixel, by default the
    middle; `near` and `far` are in metres, `baseline` is a factor, `rotation` in degrees about the betas' y axes.
    What is wrong with the input is said in the widget.
    """
    try:
        scene, alpha = checked(rig, images, alpha)
    except ValueError as error:
        return FieldWidget(None, "", {}, str(error))
    h, w = rig[alpha].hw
    pixel = list(x or (w // 2, h // 2))
    return FieldWidget(scene, alpha, {"x": pixel, "near": near, "far": far, "baseline": baseline, "rotation": rotation})


def checked(rig: Rig, images: Mapping[str, Tensor] | None, alpha: str | None) -> tuple[ExplorerScene, str]:
    """The scene and alpha's name. Raises ValueError for what cannot be shown."""
    if len(rig.names) < 2:
        raise ValueError("the rig has one camera: a receptive field needs two or more")
    alpha = rig.require(alpha or next(n for n in rig.names if not images or n in images))
    images = images or checkered_room(rig, alpha)
    for name in images:
        rig.require(name)
    if alpha not in images or len(images) < 2:
        raise ValueError(f"give images of alpha, '{alpha}', and of at least one beta")
    return ExplorerScene(rig, images), alpha
