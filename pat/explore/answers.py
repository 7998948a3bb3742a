"""What the widget and its saved page draw: a state of the controls in, one plain dictionary out."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping
from typing import Any

from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Camera, Rig

from ..media.colour import to_bytes
from .pixel import BetaReport, ExplorerScene, ExplorerState, image_pixel, inspect_pixel

Controls = dict[str, Any]
"""Values of the controls: x (alpha's pixel), near, far (metres), baseline (a factor), rotation (degrees)."""
WIDEST = 640
"""Pixels of the longer side of an image that is shown."""


def answer(scene: ExplorerScene, alpha: str, controls: Controls) -> dict[str, Any]:
    """The pixel, its depth, and each beta's samples, weights and match; `error` or `problem` where there are none."""
    try:
        state = explorer_state(scene.rig, alpha, controls)
        report = inspect_pixel(scene, state)
    except (ValueError, TypeError, KeyError) as error:
        return {"error": str(error)}
    betas: dict[str, Any] = {name: {"problem": text} for name, text in report.problems.items()}
    betas |= {name: drawn(beta) for name, beta in report.betas.items()}
    return {"x": list(state.x), "depth": number(report.depth), "betas": betas, "code": code(alpha, controls)}


def explorer_state(rig: Rig, alpha: str, controls: Controls) -> ExplorerState:
    """The state of the controls. Betas are rotated about their y axes, and moved along their baselines."""
    column, row = controls["x"]
    x = image_pixel(column, row, rig[alpha].hw)
    changes: dict[str, tuple[float, ...]] = {}
    for name in rig.betas(alpha):
        beta, own = rig[name], rig[alpha]
        if isinstance(beta, Camera) and isinstance(own, Camera):
            longer = (controls["baseline"] - 1) * (beta.t + beta.R @ own.centre)
            changes[f"{name}.translation"] = tuple(longer.tolist())
            changes[f"{name}.rotation"] = (0.0, math.radians(controls["rotation"]), 0.0)
    return ExplorerState(alpha, x, near=controls["near"], far=controls["far"], changes=changes)


def drawn(beta: BetaReport) -> dict[str, Any]:
    """A beta's report in numbers: positions in its pixels, depths in metres."""
    if not bool(beta.valid.any()):
        return {"problem": "no part of the segment lies in this image: the views do not overlap here"}
    best = int(beta.weight.argmax())
    return {
        "samples": rounded(beta.xy[beta.valid]),
        "weights": rounded(beta.weight[beta.valid], 4),
        "match": rounded(beta.xy[best]),
        "depth": number(float(beta.depth[best])),
        "off": None if beta.offset is None else round(beta.offset.distance, 2),
    }


def rounded(values: Tensor, digits: int = 2) -> list[Any]:
    """A list of numbers, short enough for a page."""
    return values.double().round(decimals=digits).tolist()


def number(value: float) -> float | None:
    """The number to four digits; None if there is none, as JSON has no NaN."""
    return float(f"{value:.4g}") if math.isfinite(value) else None


def code(alpha: str, controls: Controls) -> str:
    """The line of Python that makes the same view."""
    changed = {name: controls[name] for name in ("near", "far", "baseline", "rotation")}
    kept = {name: v for name, v in changed.items() if v is not None and v != DEFAULTS[name]}
    x = tuple(round(v) for v in controls["x"])
    settings = "".join(f", {name}={v:.6g}" for name, v in kept.items())
    return f"explore(rig, images, alpha={alpha!r}, x={x}{settings})"


DEFAULTS: Controls = {"near": None, "far": None, "baseline": 1.0, "rotation": 0.0}
"""The rig as it is."""


def shown_cameras(scene: ExplorerScene, alpha: str) -> list[dict[str, Any]]:
    """Name, width, height and image of alpha and of every beta with an image, in this order."""
    names = [alpha, *(n for n in scene.rig.betas(alpha) if n in scene.images)]
    return [
        {"name": n, "hw": list(scene.rig[n].hw), "src": data_url(scene.images[n]), "alpha": n == alpha} for n in names
    ]


def data_url(image: Tensor) -> str:
    """An image (C, H, W) as PNG in text, at most `WIDEST` pixels long; grey unless it has three bands."""
    image = image if len(image) == 3 else image.mean(0, keepdim=True).expand(3, -1, -1)
    scale = min(1.0, WIDEST / max(image.shape[1:]))
    if scale < 1:
        image = interpolate(image[None].float(), scale_factor=scale, mode="area")[0]
    file = io.BytesIO()
    Image.fromarray(to_bytes(image.clamp(0, 1)).transpose(1, 2, 0)).save(file, "PNG")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def grid_answers(scene: ExplorerScene, alpha: str, controls: Controls, columns: int) -> dict[str, Any]:
    """Answers for a grid of alpha's pixels by "column,row", and the grid's size: what a page without a kernel draws."""
    h, w = scene.rig[alpha].hw
    rows = max(1, round(columns * h / w))
    answers: Mapping[str, Any] = {
        f"{i},{j}": answer(scene, alpha, {**controls, "x": [(i + 0.5) * w / columns, (j + 0.5) * h / rows]})
        for i in range(columns)
        for j in range(rows)
    }
    return {"columns": columns, "rows": rows, "answers": answers}
