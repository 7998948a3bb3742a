"""Answers of the explorer: from a state of the controls to one plain dictionary of what is drawn."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Camera, Distortion, Pair, Pose, Rig, Segments, rotation_from_vector
from arraygeom.io.native import write as rig_text
from arraygeom.lenses.model import LensModel
from arraygeom.pixels import HW
from arraygeom.runtime.text import length_unit

from ...media.colour import to_bytes
from .pixel import (
    FAMILIES,
    WINDOWS,
    BetaReport,
    ExplorerScene,
    ExplorerState,
    PixelReport,
    beta_report,
    image_pixel,
    inspect_pixel,
    located,
    pixel_of,
    with_depths,
)

ALL = "all betas"
"""The `camera` whose sliders change all betas alike."""
Controls = dict[str, Any]
"""Values of the controls, see `DEFAULTS`, and x, alpha's pixel."""
DEFAULTS: Controls = {
    "field": "auto",
    "second": "none",
    "weights": WINDOWS,
    "near": None,
    "far": None,
    "baseline": 1.0,
    "map": "none",
    "camera": ALL,
    "errors": {},
    "pins": [],
    "clicked": None,
}
"""Controls of an unchanged rig.

baseline is a factor of all betas' distance from alpha; `errors` are changes of cameras by name (`ALL`: of all
betas), each by the names of `ERRORS`; `camera` is the one that the sliders change; near and far are in the
rig's unit. `map` is one of `MAPS`; `pins` are pixels of alpha that stay drawn; `clicked` is a beta and one
of its pixels, whose match becomes alpha's pixel.
"""
ERRORS: dict[str, tuple[str, float, float, float, float]] = {
    "rx": ("rotation x (degrees)", -3.0, 3.0, 0.01, 0.0),
    "ry": ("rotation y (degrees)", -3.0, 3.0, 0.01, 0.0),
    "rz": ("rotation z (degrees)", -3.0, 3.0, 0.01, 0.0),
    "right": ("right ({unit})", -1.0, 1.0, 0.005, 0.0),
    "down": ("down ({unit})", -1.0, 1.0, 0.005, 0.0),
    "forward": ("forward ({unit})", -1.0, 1.0, 0.005, 0.0),
    "cx": ("principal point x (px)", -20.0, 20.0, 0.1, 0.0),
    "cy": ("principal point y (px)", -20.0, 20.0, 0.1, 0.0),
    "focal": ("focal length (times)", 0.8, 1.25, 0.005, 1.0),
}
"""Label, least, most, step and usual value of each change of a camera.

Rotations are about its own axes, steps along alpha's (bounds in longest baselines, steps in the rig's unit),
pixels are added, the focal length is multiplied. "lens0", "lens1", ... are added to the lens's numbers.
"""
MAPS = ("none", "length, px", "betas that see it", "depth range seen", "entropy of weights")
"""Maps of the whole image: length of the segment or curve, pixels of beta; number of betas with a
sample; share of the depth range, in inverse depth, at which beta sees the point; entropy of the weights, 1 if
all are alike. All but the number are means over the betas."""
GRID = 24
"""Columns of alpha's pixels for which maps, and the answers of a saved page that cannot compute, are made."""
WIDEST = 1280
"""Pixels of the longer side of a displayed image."""
FARTHEST = 1000.0
"""Metres at which an infinite far bound is displayed until it is changed."""
SHIPPED = "pat-supervised"
"""Network whose attention can be chosen if no other is given."""


def answer(scene: ExplorerScene, alpha: str, controls: Controls) -> dict[str, Any]:
    """Compute all that the explorer draws for values of the controls, which are all of `DEFAULTS`, and x.

    Returns:
        Plain values for JSON: `x`, alpha's pixel; `depth` by all betas, in the rig's unit (None if unknown);
        `betas` by name, as `drawn` gives them, or with a `problem`, each with `epipole` (None if not seen)
        and for a second field `second`, as `drawn` gives it; `backwards`, samples in alpha of a `clicked`
        pixel of beta; `pins`, each with `x` and `betas`; `top` (`top_view`); `map` (`whole_map`); and `rig`,
        the file of the rig as moved (`moved_rig`), empty if it is not.

    Raises:
        ValueError: for impossible controls; missing ones and other types give TypeError, AttributeError,
            LookupError, ArithmeticError or RuntimeError.
    """
    rig = scene.rig
    scene = scene.with_rig(moved_rig(rig, alpha, controls))
    backwards: list[Any] = []
    if controls["clicked"] is not None:
        controls, backwards = clicked(scene, alpha, controls)
    report = inspect_pixel(scene, explorer_state(scene.rig, alpha, controls))
    betas: dict[str, Any] = {name: {"problem": text} for name, text in report.problems.items()}
    betas |= {name: drawn(beta) for name, beta in report.betas.items()}
    for name, beta in betas.items():
        beta["epipole"] = epipole(scene.rig, alpha, name)
    if controls["second"] != "none":
        second = {**controls, "field": controls["second"]}
        other = inspect_pixel(scene, explorer_state(scene.rig, alpha, second))
        for name, beta in betas.items():
            problem = other.problems.get(name)
            beta["second"] = {"problem": problem} if problem else drawn(other.betas[name])

    return {
        "pins": [pinned(scene, alpha, {**controls, "x": x}) for x in controls["pins"]],
        "x": list(image_pixel(controls["x"][0], controls["x"][1], scene.rig[alpha].hw)),
        "depth": number(report.depth),
        "betas": betas,
        "backwards": backwards,
        "top": top_view(scene.rig, alpha, report),
        "map": whole_map(scene, alpha, controls),
        "rig": "" if scene.rig is rig else rig_text(scene.rig),
    }


def clicked(scene: ExplorerScene, alpha: str, controls: Controls) -> tuple[Controls, list[Any]]:
    """Find the alpha pixel that matches a beta's pixel, the control `clicked` (name, column, row).

    Returns:
        The controls with that pixel as `x`, and the samples in alpha, a list of (x, y).

    Raises:
        ValueError: if no pixel can match, for an unknown beta, and for alpha itself.
    """
    name, column, row = controls["clicked"]
    x = image_pixel(column, row, scene.rig.pair(alpha, name).beta.hw)
    inspected = inspect_pixel(scene, explorer_state(scene.rig, alpha, controls).replace(alpha=name, x=x))
    if alpha in inspected.problems:
        raise ValueError(inspected.problems[alpha])
    report = drawn(inspected.betas[alpha])
    if "problem" in report:
        raise ValueError(f"no pixel of {alpha} can match ({x[0]:.0f}, {x[1]:.0f}) of {name}")
    return {**controls, "x": report["match"]}, report["samples"]


def pinned(scene: ExplorerScene, alpha: str, controls: Controls) -> dict[str, Any]:
    """Compute samples and match in each beta of a pixel that stays drawn."""
    report = inspect_pixel(scene, explorer_state(scene.rig, alpha, controls))
    shown = {name: drawn(beta) for name, beta in report.betas.items()}
    found = {n: {k: beta[k] for k in ("samples", "match")} for n, beta in shown.items() if "match" in beta}
    return {"x": list(image_pixel(controls["x"][0], controls["x"][1], scene.rig[alpha].hw)), "betas": found}


def moved_rig(rig: Rig, alpha: str, controls: Controls) -> Rig:
    """Apply the controls' changes to the calibrated cameras.

    Args:
        alpha: name of alpha, in whose axes steps are, in the rig's unit; uncalibrated, nothing moves.
        controls: values of the controls: `baseline`, and `errors` by camera or `ALL` (betas), as `ERRORS`.

    Returns:
        The moved rig, its links unchanged; the same one for unchanged controls.

    Raises:
        ValueError: for a change that a camera's lens has not, unknown cameras and changes, `errors` of
            another type, and numbers that no camera has.
    """
    alpha_view, cameras, errors = rig[alpha], dict(rig.cameras), controls["errors"]
    if not all(
        isinstance(e, Mapping) for e in (errors.values() if isinstance(errors, Mapping) else [errors])
    ):
        raise ValueError(f"errors: expected {{CAMERA: {{CHANGE: NUMBER}}}}, got {errors!r:.80}")
    known = {*rig.names, ALL}
    if unknown := {*errors} - known or {
        k for e in errors.values() for k in e if k not in ERRORS and k[:4] != "lens"
    }:
        raise ValueError(f"errors: no camera or change is called {', '.join(map(repr, sorted(unknown)))}")
    same = all(v == (1 if k == "focal" else 0) for e in errors.values() for k, v in e.items())
    if (same and controls["baseline"] == 1) or not isinstance(alpha_view, Camera):
        return rig
    for name, camera in rig.cameras.items():
        if not isinstance(camera, Camera):
            continue
        given = [errors.get(name, {}), *([] if name == alpha else [errors.get(ALL, {})])]
        change = {key: sum(e.get(key, 0.0) for e in given) for key in {*ERRORS, *given[0], *given[-1]}}
        step = alpha_view.R.T @ alpha_view.R.new_tensor([change[key] for key in ("right", "down", "forward")])
        centre = alpha_view.centre + controls["baseline"] * (camera.centre - alpha_view.centre) + step
        turn = camera.R.new_tensor([math.radians(change[key]) for key in ("rx", "ry", "rz")])
        focal = math.prod(e.get("focal", 1.0) for e in given)
        K = camera.K.clone()
        K[:2, :2] *= focal
        K[:2, 2] += K.new_tensor([change["cx"], change["cy"]])
        cameras[name] = camera.replace(
            K=K,
            cam_from_world=Pose.from_centre(rotation_from_vector(turn) @ camera.R, centre),
            distortion=with_lens(
                name, camera, {k[4:]: v for k, v in change.items() if k[:4] == "lens" and v}
            ),
        )
    return rig.replace(cameras=cameras)


def with_lens(name: str, camera: Camera, changes: Controls) -> LensModel | None:
    """Add values to the numbers of a camera's lens.

    Args:
        name: name of the camera, for messages.
        changes: values by the index of the number as text, from "0"; empty leaves the lens.

    Returns:
        The lens; for a pinhole one of Brown-Conrady with four numbers, None if nothing changes.

    Raises:
        ValueError: for a number that the lens has not.
    """
    if not changes:
        return camera.distortion
    lens = camera.distortion or Distortion("brown-conrady", camera.K.new_zeros(4))
    numbers = lens.coefficients.clone()
    for index, value in changes.items():
        if not (index.isdecimal() and int(index) < numbers.numel()):
            raise ValueError(f"'{name}' has no lens number {index}: set it back to 0")
        numbers[int(index)] += value
    return lens.with_coefficients(numbers)


def explorer_state(rig: Rig, alpha: str, controls: Controls) -> ExplorerState:
    """Convert the controls to a state, for a rig that they have moved."""
    x = image_pixel(controls["x"][0], controls["x"][1], rig[alpha].hw)
    near, far, weights = (controls[name] for name in ("near", "far", "weights"))
    return ExplorerState(alpha, x, controls["field"], near, far, weights)


def drawn(beta: BetaReport) -> dict[str, Any]:
    """Convert a beta's report to plain values for JSON.

    Returns:
        `samples` on the image, in beta's pixels, their `weights` and their `depths`; `match`, the sample of
        the largest weight, and its `depth`; depths are in the rig's unit, None where unknown; `off` and
        `band`, the report's offset and band (None where there is none); or a `problem` alone if no sample is
        on the image.
    """
    if not bool(beta.valid.any()):
        return {"problem": "no part of the segment lies in this image: the views do not overlap here"}
    best = int(beta.weight.argmax())
    return {
        "samples": rounded(beta.xy[beta.valid]),
        "weights": rounded(beta.weight[beta.valid], 4),
        "depths": [number(float(d)) for d in beta.depth[beta.valid]],
        "match": rounded(beta.xy[best]),
        "depth": number(float(beta.depth[best])),
        "off": None if beta.offset is None else round(beta.offset, 2),
        "band": None if beta.band is None else rounded(beta.band),
    }


def epipole(rig: Rig, alpha: str, beta: str) -> list[float] | None:
    """Return the position in beta of alpha's centre; None where beta does not see it."""
    a, b = rig[alpha], rig[beta]
    if not (isinstance(a, Camera) and isinstance(b, Camera) and a.central):
        return None
    seen = b.project(a.centre)
    return rounded(seen.x) if bool(seen.valid & seen.x.isfinite().all()) else None


def top_view(rig: Rig, alpha: str, report: PixelReport) -> list[dict[str, Any]]:
    """List the calibrated cameras from above, in alpha's axes (right, forward), with alpha's centre at 0.

    Returns:
        Plain values of each camera: `name`; `at`, its centre in the rig's unit; `ahead`, its viewing
        direction; and `ray`, the direction of alpha's pixel or of the match (None without one); both are of
        unit length in space. Empty if alpha is not calibrated.
    """
    alpha_view = rig[alpha]
    if not isinstance(alpha_view, Camera):
        return []
    shown = []
    for name, camera in rig.cameras.items():
        if isinstance(camera, Camera):
            centre, axes = alpha_view.R @ (camera.centre - alpha_view.centre), alpha_view.R @ camera.R.T
            beta = report.betas.get(name)
            x = report.x if name == alpha else None if beta is None else beta.xy[int(beta.weight.argmax())]
            ray, valid = (axes[:, 2], False) if x is None else camera.rays(x.to(axes))
            shown.append(
                {
                    "name": name,
                    "at": rounded(centre[[0, 2]], 5),
                    "ahead": rounded(axes[[0, 2], 2], 4),
                    "ray": rounded((axes @ (ray / ray.norm()))[[0, 2]], 4) if valid else None,
                }
            )
    return shown


def grid_pixels(hw: HW, columns: int) -> tuple[int, list[list[float]]]:
    """Return the number of rows of about square cells over an image, and the cells' middles, row by row."""
    h, w = hw
    rows = max(1, round(columns * h / w))
    xs, ys = ([(i + 0.5) * side / n - 0.5 for i in range(n)] for side, n in ((w, columns), (h, rows)))
    return rows, [[x, y] for y in ys for x in xs]


def whole_map(scene: ExplorerScene, alpha: str, controls: Controls) -> dict[str, Any] | None:
    """Compute the map that the controls choose (`MAPS`), on a grid of alpha's pixels; kept until they change.

    Returns:
        Plain values: `columns`, `rows`, and `values` row by row, where no beta has one None (0 for the
        number of betas); None for no map.

    Raises:
        ValueError: for an unknown map, and impossible depth bounds.
    """
    which = MAPS.index(controls["map"])
    kept = {k: controls[k] for k in ("map", "field", "weights", "near", "far", "baseline", "errors")}
    key = json.dumps(kept, sort_keys=True)
    if which and key not in scene.maps:
        rows, pixels = grid_pixels(scene.rig[alpha].hw, GRID)
        states = [explorer_state(scene.rig, alpha, {**controls, "x": x}) for x in pixels]
        rig = with_depths(scene.rig, states[0])
        found = []
        for name in (n for n in rig.betas(alpha) if n in scene.images):
            with suppress(Exception):  # the reason is said in its picture
                found.append(_mapped(scene, rig.pair(alpha, name), name, states, which))
        values = torch.stack(found) if found else torch.full((1, len(states)), torch.nan)
        values = values.nansum(0) if which == 2 else values.nanmean(0)
        scene.maps.clear()
        scene.maps[key] = {"columns": GRID, "rows": rows, "values": [number(v) for v in values.tolist()]}
    return scene.maps[key] if which else None


def _mapped(
    scene: ExplorerScene, pair: Pair, name: str, states: list[ExplorerState], which: int
) -> Float[Tensor, " n"]:
    """Values of the map with a number in `MAPS` in one beta; NaN where there is none."""
    if which == 4:
        return torch.tensor([_entropy(beta_report(scene, pair, name, state)) for state in states]).double()
    x = torch.cat([pixel_of(state) for state in states])
    if which == 3:
        near, far = (float(d) for d in pair.depth_range)
        alpha, beta = pair.cameras
        depth = 1 / torch.linspace(1 / near, 1 / far, DEPTHS, dtype=torch.float64).clamp(min=1e-9)
        points = alpha.unproject(x.expand(DEPTHS, -1, -1), depth[:, None].expand(-1, len(x)))
        there = beta.project(points)
        return (there.valid & beta.contains(there.x)).double().mean(0)
    locations = located(scene, pair, states[0].family, x)
    if isinstance(locations, Segments):
        seen, length = locations.valid, locations.length
    else:
        here, steps = locations.mask, locations.xy.diff(dim=-2).norm(dim=-1)
        seen, length = here.any(-1), torch.where(here[:, 1:] & here[:, :-1], steps, 0.0).sum(-1)
    return seen.double() if which == 2 else torch.where(seen, length, torch.nan).double()


def _entropy(report: BetaReport) -> float:
    """Entropy of the weights as a share of the largest; NaN without samples."""
    count = int(report.valid.sum())
    return float(torch.special.entr(report.weight).sum()) / math.log(max(count, 2)) if count else math.nan


DEPTHS = 33
"""Depths at which it is asked whether a beta sees a point, evenly spaced in inverse depth."""


def rounded(values: Tensor, digits: int = 2) -> list[Any]:
    """Round values to a list of numbers, short enough for a page."""
    return values.double().round(decimals=digits).tolist()


def number(value: float) -> float | None:
    """Round to four digits; None for a number that is not finite, as JSON has no NaN."""
    return float(f"{value:.4g}") if math.isfinite(value) else None


def slider_ranges(rig: Rig) -> list[list[Any]]:
    """List the sliders that suit a rig.

    Returns:
        A list [name, label, [low, high, step, value], change] for each, with `change` True for a change of
        one camera (`ERRORS`; each number of the longest lens), False for "near", "far" and "baseline". Depths
        only with a depth range, taken up to `FARTHEST`; others only with calibrated cameras.
    """
    ranges: list[list[Any]] = []
    unit = length_unit(rig)
    if rig.depth is not None:
        near, far = (min(float(d), FARTHEST) for d in rig.depth)
        ranges.append(["near", f"near ({unit})", [near / 4, far, (far - near / 4) / 500, near], False])
        ranges.append(["far", f"far ({unit})", [near, 4 * far, (4 * far - near) / 500, far], False])
    cameras = [camera for camera in rig.cameras.values() if isinstance(camera, Camera)]
    if not cameras:
        return ranges
    ranges.append(["baseline", "baseline (times)", [0.1, 4.0, 0.05, 1.0], False])
    longest = max(float((camera.centre - cameras[0].centre).norm()) for camera in cameras) or 1.0
    for name, (label, low, high, step, usual) in ERRORS.items():
        size = longest if "{unit}" in label else 1.0
        ranges.append([name, label.format(unit=unit), [size * low, size * high, size * step, usual], True])
    lenses = [camera.distortion.coefficients for camera in cameras if camera.distortion is not None]
    largest = max(lenses, key=lambda numbers: numbers.numel(), default=torch.zeros(1))
    for i, value in enumerate(largest.flatten().tolist()):
        reach = max(0.3, 0.5 * abs(value)) if i == 0 else max(0.05, 0.5 * abs(value))
        ranges.append([f"lens{i}", f"lens number {i + 1}", [-reach, reach, reach / 100, 0.0], True])
    return ranges


def choices(scene: ExplorerScene, controls: Controls) -> list[list[Any]]:
    """List the drop-down choices of the explorer: field, second field, weights, map, and camera to change.

    Returns:
        A list [name of the control, label, options] for each.
    """
    fields = [*FAMILIES, *scene.fields]
    unlisted = [name for name in (controls["field"], controls["second"]) if name not in ("none", *fields)]
    weights = [WINDOWS, *(scene.networks or [SHIPPED])]
    weights += [controls["weights"]] if controls["weights"] not in weights else []
    return [
        ["field", "field", [*fields, *unlisted]],
        ["second", "compared with", ["none", *fields, *unlisted]],
        ["weights", "weights by", weights],
        ["map", "over alpha", list(MAPS)],
        [
            "camera",
            "sliders change",
            [ALL, *(n for n, v in scene.rig.cameras.items() if isinstance(v, Camera))],
        ],
    ]


def shown_cameras(scene: ExplorerScene, alpha: str) -> list[dict[str, Any]]:
    """Describe alpha and each beta with an image, in this order, for the page.

    Returns:
        Plain values of each: `name`, `hw` (of the camera), `src` (the image as `data_url` makes it), `alpha`
        (True for alpha), and `unit` of depths ("m" or "baselines").
    """
    names = [alpha, *(n for n in scene.rig.betas(alpha) if n in scene.images)]
    unit = length_unit(scene.rig)
    return [
        {
            "name": n,
            "hw": list(scene.rig[n].hw),
            "src": data_url(scene.images[n]),
            "alpha": n == alpha,
            "unit": unit,
        }
        for n in names
    ]


def data_url(image: Tensor) -> str:
    """Encode an image (c, h, w) as the data URL of a PNG whose longer side is at most `WIDEST` pixels.

    Images of other numbers of bands than three are shown as their mean; values are clipped to 0..1.
    """
    image = image if len(image) == 3 else image.mean(0, keepdim=True).expand(3, -1, -1)
    scale = min(1.0, WIDEST / max(image.shape[1:]))
    if scale < 1:
        hw = [max(1, round(side * scale)) for side in image.shape[1:]]
        image = interpolate(image[None].float(), size=hw, mode="area")[0]
    file = io.BytesIO()
    Image.fromarray(to_bytes(image.clamp(0, 1)).transpose(1, 2, 0)).save(file, "PNG")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
