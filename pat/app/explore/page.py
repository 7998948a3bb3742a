"""Explorer without a browser: its initial values, its answers, and itself as a page of one file."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, ReceptiveField, Rig, pixel_grid
from arraygeom.runtime.atomic import write_text
from arraygeom.uncertainty import Covariance

from ...networks.paper import PAT
from .answers import (
    DEFAULTS,
    GRID,
    Controls,
    answer,
    choices,
    explorer_state,
    grid_pixels,
    moved_rig,
    shown_cameras,
    slider_ranges,
)
from .pixel import WINDOWS, ExplorerScene, shipped_attention, with_depths

MODULE, PINHOLE = (Path(__file__).with_name(name) for name in ("widget.js", "pinhole.js"))


@dataclass
class Explorer:
    """Explorer of a scene, or an error shown in its place.

    Attributes:
        scene: the scene; None for an error.
        alpha: name of alpha; empty for an error.
        controls: initial controls, all of `DEFAULTS` and x.
        error: message; empty if there is a scene.
        files: files of the rig ("") and of the images by camera, for the code that makes the view; empty if
            unknown.
    """

    scene: ExplorerScene | None
    alpha: str
    controls: Controls
    error: str = ""
    files: Mapping[str, str] = field(default_factory=dict)

    def answer(self, controls: Controls) -> dict[str, Any]:
        """Compute all that is drawn for values of the controls.

        Returns:
            The values of `answers.answer`, or for impossible controls, choices that it was started without,
            and without a scene `error`, a message; with a scene also the control `asked`, None if not given.
        """
        if self.scene is None:
            return {"error": self.error}
        try:
            for name, _, options in choices(self.scene, self.controls):
                if controls[name] not in options:
                    raise ValueError(f"{name}: the explorer was started without {controls[name]!r:.80}")
            return {**answer(self.scene, self.alpha, controls), "asked": controls.get("asked")}
        except (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RuntimeError) as error:
            return {"error": str(error), "asked": controls.get("asked")}

    def values(self) -> dict[str, Any]:
        """Return the widget's initial values, as plain values for JSON.

        They are `cameras` (`shown_cameras`), `ranges` (`slider_ranges`) and `choices`, all empty for an
        error, `controls`, `defaults`, `files`, and the first `answer`.
        """
        scene = self.scene
        return {
            "cameras": [] if scene is None else shown_cameras(scene, self.alpha),
            "ranges": [] if scene is None else slider_ranges(scene.rig),
            "choices": [] if scene is None else choices(scene, self.controls),
            "controls": self.controls,
            "defaults": DEFAULTS,
            "files": dict(self.files),
            "answer": self.answer(self.controls),
        }

    def save(self, path: str | Path, columns: int = GRID) -> None:
        """Write a page of one file that needs neither a kernel nor a network connection.

        For calibrated pinholes with a depth range, and no links, it computes any pixel and the rig's sliders
        itself, for the default field, weights and lenses, and no second field; for others it stores the
        answers for a grid of alpha's pixels, and has no sliders.

        Args:
            columns: columns of that grid.

        Raises:
            OSError: if writing fails.
        """
        values = self.values()
        all_choices, values["choices"] = values["choices"], []
        if self.scene is not None and self.usual:
            values["ranges"] = [entry for entry in values["ranges"] if not entry[0].startswith("lens")]
            values["choices"] = [choice for choice in all_choices if choice[0] in ("camera", "map")]
            asks = f"asksPinholes({json.dumps(geometry(self.scene.rig, self.alpha))})"
        else:
            values["ranges"] = []
            asks = f"asksGrid({json.dumps(self.grid(columns))})"
        write_text(path, page(values, asks))

    @property
    def usual(self) -> bool:
        """True if rig, field and weights are those that a page can compute."""
        with suppress(Exception):  # of impossible controls, which every answer then names
            if self.scene is not None and is_pinhole(moved_rig(self.scene.rig, self.alpha, self.controls)):
                return all(self.controls[name] == DEFAULTS[name] for name in ("field", "second", "weights"))
        return False

    @property
    def rig(self) -> Rig:
        """The rig as the controls have changed it.

        Raises:
            ValueError: for an error in a scene's place, and otherwise as `answers.answer`.
        """
        if self.scene is None:
            raise ValueError(self.error)
        rig = moved_rig(self.scene.rig, self.alpha, self.controls)
        return with_depths(rig, explorer_state(rig, self.alpha, self.controls))

    def grid(self, columns: int) -> dict[str, Any]:
        """Compute the answers for a grid of alpha's pixels, which a saved page shows.

        Args:
            columns: columns of the grid; cells are about square.

        Returns:
            Plain values: `columns`, `rows`, and `answers` by "column,row"; one cell for an error.
        """
        if self.scene is None:
            return {"columns": 1, "rows": 1, "answers": {"0,0": {"error": self.error}}}
        rows, pixels = grid_pixels(self.scene.rig[self.alpha].hw, columns)
        controls = {**self.controls, "clicked": None, "map": "none"}
        answers = {
            f"{i % columns},{i // columns}": self.answer({**controls, "x": x}) for i, x in enumerate(pixels)
        }
        return {"columns": columns, "rows": rows, "answers": answers}


def is_pinhole(rig: Rig) -> bool:
    """Return True if all cameras are calibrated pinholes, without links, and there is a depth range."""
    pinholes = all(isinstance(c, Camera) and c.distortion is None for c in rig.cameras.values())
    return pinholes and not rig.links and rig.depth is not None


def geometry(rig: Rig, alpha: str) -> dict[str, Any]:
    """Return the calibrated cameras as plain numbers, for the page's own computation.

    Returns:
        Name of `alpha`; `cameras` by name, each with K, R (camera from world), centre and hw, lenses left
        out; `near` and `far`, at most 1e9. Lengths are in the rig's unit; the rig must have a depth range.
    """
    cameras = {
        name: {k: getattr(camera, k).tolist() for k in ("K", "R", "centre")} | {"hw": list(camera.hw)}
        for name, camera in rig.cameras.items()
        if isinstance(camera, Camera)
    }
    assert rig.depth is not None
    near, far = (min(float(d), 1e9) for d in rig.depth)
    return {"alpha": alpha, "cameras": cameras, "near": near, "far": far}


def page(values: Mapping[str, Any], asks: str) -> str:
    """Compose the widget's page; `asks`, an expression of pinhole.js, answers its questions."""
    scripts = MODULE.read_text().replace("export default { render };", "") + PINHOLE.read_text()
    # Nothing in a text may end the script, or be taken for a part of the page.
    data, asks = (text.replace("<", "\\u003c") for text in (json.dumps(values), asks))
    parts = {"MODULES": scripts, "DATA": data, "ASKS": asks}
    return re.sub("|".join(parts), lambda match: parts[match[0]], PAGE)


PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>Receptive fields</title>
<style>body { margin: 0; background: light-dark(#f6f7f9, #14171a); color-scheme: light dark }
body > .pat { min-height: 100vh; box-sizing: border-box }</style>
<body><script type="module">
MODULES
const values = DATA;
render({ el: document.body, model: modelOf(values, ASKS) });
</script></body></html>
"""


def opened(
    rig: Rig,
    images: Mapping[str, Float[Tensor, "_ _ _"]] | None = None,
    *,
    alpha: str | None = None,
    x: tuple[float, float] | None = None,
    network: PAT | str | None = None,
    fields: Mapping[str, ReceptiveField] | None = None,
    covariance: Covariance | None = None,
    files: Mapping[str, str] | None = None,
    **controls: Any,
) -> Explorer:
    """Make the explorer of a rig.

    Args:
        rig: the rig.
        images: images (C, H, W) by camera; None for a checkered room.
        alpha: name of alpha; None for the first camera with an image.
        x: pixel (x, y) of alpha; None for the middle.
        network: network of the paper, or weights of one, whose attention is shown; None for correlations of
            windows.
        fields: further fields by name; None for none.
        covariance: covariance of the rig's parameters, for bands; None for none.
        files: files of the rig and the images, as for `Explorer`; None if unknown.
        controls: initial values of the controls (`explore`); impossible ones are errors of its answers.

    Returns:
        The explorer; problems with the other arguments are its `error`.

    Raises:
        TypeError: for an unknown argument.
    """
    if unknown := controls.keys() - DEFAULTS.keys():
        raise TypeError(f"explore has no argument {', '.join(sorted(unknown))}: {', '.join(DEFAULTS)}")
    networks = {} if network is None or isinstance(network, str) else {"network": network}
    weights = WINDOWS if network is None else network if isinstance(network, str) else "network"
    try:
        if isinstance(network, str):
            shipped_attention(network)  # refuses others
        images, alpha = checked(rig, images, alpha)
        scene = ExplorerScene(rig, images, fields or {}, networks, covariance)
    except (ValueError, TypeError, FileNotFoundError) as error:
        return Explorer(None, "", {**DEFAULTS, "x": [0, 0]}, str(error))
    h, w = rig[alpha].hw
    controls = {**DEFAULTS, "weights": weights, **controls, "x": list(x or (w // 2, h // 2))}
    return Explorer(scene, alpha, controls, files=files or {})


def checked(
    rig: Rig, images: Mapping[str, Tensor] | None, alpha: str | None
) -> tuple[Mapping[str, Tensor], str]:
    """Check rig, images and alpha of an explorer, and fill in defaults.

    Args:
        images: images by camera; None or empty for a checkered room.
        alpha: name of alpha; None for the first camera with an image.

    Returns:
        Images by camera, of the room if none are given, and alpha's name.

    Raises:
        ValueError: for a rig of one camera, unknown names, no image of alpha or of any beta, and a rig for
            which no room can be rendered.
    """
    if len(rig.names) < 2:
        raise ValueError("the rig has one camera: a receptive field needs two cameras or more")
    alpha = rig.require(alpha or next((n for n in rig.names if not images or n in images), rig.names[0]))
    images = images or checkered_room(rig, alpha)
    for name in images:
        rig.require(name)
    if alpha not in images or len(images) < 2:
        raise ValueError(f"give images of alpha, '{alpha}', and of at least one beta")
    return images, alpha


SQUARES = 2
"""Squares from the middle of the room to a wall."""
NARROWEST = 1e-3
"""Least tangent of half the room's angle of view: a row of pixels on the axis has none."""
DEEPEST = 20.0
"""Largest depth of the back wall, in multiples of the near bound."""


def checkered_room(rig: Rig, alpha: str) -> dict[str, Float[Tensor, "1 h w"]]:
    """Render every camera's image of a box: the back wall far, the side walls seen by alpha from near on.

    Squares differ in brightness, so that each has one match. The back wall is at most `DEEPEST` times near.

    Returns:
        Images (1, h, w) by camera (`room_image`).

    Raises:
        ValueError: for a rig without all poses or without depth range.
    """
    cameras = {name: view for name, view in rig.to(torch.float64).cameras.items() if isinstance(view, Camera)}
    if len(cameras) < len(rig.cameras) or rig.depth is None:
        raise ValueError("a synthetic room needs a calibrated rig with a depth range: give images")
    near, far = (float(d) for d in rig.depth)
    view = cameras[alpha]
    rays, valid = view.rays(pixel_grid(view.hw, dtype=torch.float64))
    rays = torch.where(valid[..., None], rays, 0.0)
    side = near * rays[..., :2].abs().amax((0, 1)).clamp(min=NARROWEST)
    half = torch.cat([side, side.new_tensor([min(far, DEEPEST * near)])])
    return {name: room_image(camera, view, half) for name, camera in cameras.items()}


def room_image(camera: Camera, alpha: Camera, half: Float[Tensor, "3"]) -> Float[Tensor, "1 h w"]:
    """Render the room for one camera; numbers are float64.

    Args:
        half: half the room's size in alpha's axes, in the rig's unit, with alpha in its middle.

    Returns:
        Image (1, h, w), float32, 0.1..0.9; 0 where the lens has no ray.
    """
    rays, valid = camera.rays(pixel_grid(camera.hw, dtype=torch.float64))
    R = alpha.R @ camera.R.T
    start = alpha.R @ (camera.centre - alpha.centre)
    directions = rays @ R.T
    distance = (half * directions.sign() - start) / directions
    hit, wall = torch.where(distance > 0, distance, torch.inf).min(-1)
    points = start + hit[..., None] * directions
    square = torch.floor(points / half.min() * SQUARES)
    square = square.scatter(-1, wall[..., None], 0.0)
    brightness = torch.frac(torch.sin(square @ HASH + wall) * 43758.5453).abs()  # the usual hash of shaders
    return torch.where(valid & hit.isfinite(), 0.1 + 0.8 * brightness, 0.0).float()[None]


HASH = torch.tensor([12.9898, 78.233, 37.719], dtype=torch.float64)
"""Factors of the hash, without a common period."""
