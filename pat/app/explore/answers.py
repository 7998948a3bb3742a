"""Answers of the explorer: from a state of the controls to one plain dictionary of what is drawn."""

from __future__ import annotations

import base64
import io
import math
from typing import Any

import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from arraygeom import Camera, Distortion, Pose, Rig, rotation_from_vector
from arraygeom.io.native import write as rig_text
from arraygeom.runtime.text import length_unit

from ...media.colour import to_bytes
from .pixel import FAMILIES, WINDOWS, BetaReport, ExplorerScene, ExplorerState, image_pixel, inspect_pixel

Controls = dict[str, Any]
"""Values of the controls, see `DEFAULTS`, and x, alpha's pixel."""
DEFAULTS: Controls = {
    "field": "auto",
    "second": "none",
    "weights": WINDOWS,
    "near": None,
    "far": None,
    "baseline": 1.0,
    "rotation": 0.0,
    "focal": 1.0,
    "lens": 0.0,
    "moved": {},
    "clicked": None,
}
"""Controls of an unchanged rig.

baseline and focal are factors, rotation is in degrees about the betas' y axes, lens is added to their k1,
`moved` are steps (right, forward) in alpha's axes by beta, metres; near and far are metres. `clicked` is a
beta and a pixel of it, whose match becomes alpha's pixel.
"""
WIDEST = 640
"""Pixels of the longer side of a displayed image."""
FARTHEST = 1000.0
"""Metres at which an infinite far bound is displayed until it is changed."""
SHIPPED = "pat-supervised"
"""Network whose attention can be chosen if no other is given."""


def answer(scene: ExplorerScene, alpha: str, controls: Controls) -> dict[str, Any]:
    """Compute what is drawn for a state of the controls.

    Returns:
        Pixel `x`, `depth`, `betas` with samples, weights and match (or a `problem`), and the rig's `top`
        view, as plain values for JSON.

    Raises:
        ValueError: or TypeError, AttributeError, KeyError, for impossible controls.
    """
    rig = scene.rig
    scene = scene.with_rig(moved_rig(rig, alpha, controls))
    backwards: list[Any] = []
    if controls["clicked"] is not None:
        controls, backwards = clicked(scene, alpha, controls)
    report = inspect_pixel(scene, explorer_state(scene.rig, alpha, controls))
    betas: dict[str, Any] = {name: {"problem": text} for name, text in report.problems.items()}
    betas |= {name: drawn(beta) for name, beta in report.betas.items()}
    if controls["second"] != "none":
        second = {**controls, "field": controls["second"]}
        other = inspect_pixel(scene, explorer_state(scene.rig, alpha, second))
        for name, beta in betas.items():
            problem = other.problems.get(name)
            beta["second"] = {"problem": problem} if problem else drawn(other.betas[name])
    return {
        "x": list(image_pixel(controls["x"][0], controls["x"][1], scene.rig[alpha].hw)),
        "depth": number(report.depth),
        "betas": betas,
        "backwards": backwards,
        "top": top_view(scene.rig, alpha),
        "rig": "" if scene.rig is rig else rig_text(scene.rig),
    }


def clicked(scene: ExplorerScene, alpha: str, controls: Controls) -> tuple[Controls, list[Any]]:
    """Find the alpha pixel that matches a beta's clicked pixel.

    Returns:
        The controls with that pixel, and the samples in alpha.

    Raises:
        ValueError: if no pixel can match.
    """
    name, column, row = controls["clicked"]
    x = image_pixel(column, row, scene.rig[name].hw)
    inspected = inspect_pixel(scene, explorer_state(scene.rig, alpha, controls).replace(alpha=name, x=x))
    if alpha in inspected.problems:
        raise ValueError(inspected.problems[alpha])
    report = drawn(inspected.betas[alpha])
    if "problem" in report:
        raise ValueError(f"no pixel of {alpha} can match ({x[0]:.0f}, {x[1]:.0f}) of {name}")
    return {**controls, "x": report["match"]}, report["samples"]


def moved_rig(rig: Rig, alpha: str, controls: Controls) -> Rig:
    """Move every calibrated beta as the controls say: position, rotation, focal length and lens.

    Args:
        alpha: name of alpha, which stays, as do its axes for positions; uncalibrated, nothing moves.
        controls: values of the controls (`explore`): baseline and focal length as factors, rotation about the
            beta's y axis in degrees, k1 to add, and shifts (right, forward) in metres by beta.

    Returns:
        The moved rig; the same one for unchanged controls.

    Raises:
        ValueError: for a lens without k1, if that is changed.
    """
    alpha_view, cameras = rig[alpha], dict(rig.cameras)
    if all(controls[name] == DEFAULTS[name] for name in ("baseline", "rotation", "focal", "lens", "moved")):
        return rig
    turned = torch.tensor([0.0, math.radians(controls["rotation"]), 0.0], dtype=torch.float64)
    for name in rig.betas(alpha):
        beta = rig[name]
        if not (isinstance(beta, Camera) and isinstance(alpha_view, Camera)):
            continue
        right, forward = controls["moved"].get(name, (0.0, 0.0))
        step = alpha_view.R.T @ alpha_view.R.new_tensor([right, 0.0, forward])
        centre = alpha_view.centre + controls["baseline"] * (beta.centre - alpha_view.centre) + step
        K = torch.cat([beta.K[:2, :2] * controls["focal"], beta.K[:2, 2:]], 1)
        cameras[name] = beta.replace(
            K=torch.cat([K, beta.K[2:]]),
            cam_from_world=Pose.from_centre(rotation_from_vector(turned).to(beta.R) @ beta.R, centre),
            distortion=with_k1(beta, controls["lens"]),
        )
    return rig.replace(cameras=cameras)


def with_k1(camera: Camera, k1: float) -> Any:
    """Add a number to the first radial coefficient of a camera's lens.

    Args:
        k1: number to add; 0 leaves the lens.

    Returns:
        The lens; for a pinhole one of Brown-Conrady.

    Raises:
        ValueError: for a lens without k1.
    """
    lens = camera.distortion
    if k1 == 0:
        return lens
    if lens is None:
        return Distortion("brown-conrady", camera.K.new_tensor([k1, 0, 0, 0]))
    if not has_k1(camera):
        raise ValueError("the lens slider changes k1, which this lens has not: set it back to 0")
    change = torch.zeros_like(lens.coefficients)
    change[..., 0] = k1
    return lens.replace(coefficients=lens.coefficients + change)


def has_k1(camera: Camera) -> bool:
    """Return True if the lens slider can change the camera."""
    lens = camera.distortion
    return lens is None or (isinstance(lens, Distortion) and lens.model == "brown-conrady")


def explorer_state(rig: Rig, alpha: str, controls: Controls) -> ExplorerState:
    """Convert the controls to a state, for a rig that they have moved."""
    x = image_pixel(controls["x"][0], controls["x"][1], rig[alpha].hw)
    near, far, weights = (controls[name] for name in ("near", "far", "weights"))
    return ExplorerState(alpha, x, controls["field"], near, far, weights)


def drawn(beta: BetaReport) -> dict[str, Any]:
    """Convert a beta's report to plain values for JSON.

    Returns:
        `samples` and `match` in beta's pixels, `weights`, `depths` and `depth` in metres (None where
        unknown), and `off`, the distance of the images' match from the line, pixels; or a `problem` if no
        sample is on the image.
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
        "off": None if beta.offset is None else round(beta.offset.distance, 2),
    }


def top_view(rig: Rig, alpha: str) -> list[dict[str, Any]]:
    """List the cameras from above, in alpha's axes: each centre (right, forward) and viewing direction,
    metres.

    Returns:
        Plain values; empty if alpha is not calibrated.
    """
    alpha_view = rig[alpha]
    if not isinstance(alpha_view, Camera):
        return []
    shown = []
    for name, camera in rig.cameras.items():
        if isinstance(camera, Camera):
            centre, ahead = alpha_view.R @ (camera.centre - alpha_view.centre), alpha_view.R @ camera.R[2]
            shown.append({"name": name, "at": rounded(centre[[0, 2]], 5), "ahead": rounded(ahead[[0, 2]], 4)})
    return shown


def rounded(values: Tensor, digits: int = 2) -> list[Any]:
    """Round values to a list of numbers, short enough for a page."""
    return values.double().round(decimals=digits).tolist()


def number(value: float) -> float | None:
    """Round to four digits; None for a number that is not finite, as JSON has no NaN."""
    return float(f"{value:.4g}") if math.isfinite(value) else None


def slider_ranges(rig: Rig) -> list[list[Any]]:
    """List the sliders that suit a rig.

    Returns:
        Name, label and [low, high, step, value] of each; depths only with a depth range, others only with
        calibrated cameras.
    """
    ranges: list[list[Any]] = []
    if rig.depth is not None:
        unit = length_unit(rig)
        near, far = (min(float(d), FARTHEST) for d in rig.depth)
        ranges.append(["near", f"near ({unit})", [near / 4, far, (far - near / 4) / 500, near]])
        ranges.append(["far", f"far ({unit})", [near, 4 * far, (4 * far - near) / 500, far]])
    cameras = [camera for camera in rig.cameras.values() if isinstance(camera, Camera)]
    if cameras:
        ranges.append(["baseline", "baseline (times)", [0.1, 4.0, 0.05, 1.0]])
        ranges.append(["rotation", "rotation (degrees)", [-3.0, 3.0, 0.05, 0.0]])
        ranges.append(["focal", "focal length (times)", [0.8, 1.25, 0.005, 1.0]])
    if cameras and all(map(has_k1, cameras)):
        ranges.append(["lens", "lens (k1)", [-0.3, 0.3, 0.01, 0.0]])
    return ranges


def choices(scene: ExplorerScene, controls: Controls) -> list[list[Any]]:
    """List the drop-down choices of the explorer: field, second field, and weights.

    Returns:
        Name, label and options of each.
    """
    fields = [*FAMILIES, *scene.fields]
    unlisted = [name for name in (controls["field"], controls["second"]) if name not in ("none", *fields)]
    weights = [WINDOWS, *(scene.networks or [SHIPPED])]
    weights += [controls["weights"]] if controls["weights"] not in weights else []
    return [
        ["field", "field", [*fields, *unlisted]],
        ["second", "compared with", ["none", *fields, *unlisted]],
        ["weights", "weights by", weights],
    ]


def shown_cameras(scene: ExplorerScene, alpha: str) -> list[dict[str, Any]]:
    """Describe alpha and each beta with an image, in this order, for the page.

    Returns:
        Plain values: `name`, `hw`, `src` (the image as a data URL), `alpha` (True for alpha), and `unit` of
        depths.
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
