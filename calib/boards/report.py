"""The report of a calibration: one HTML file with embedded figures."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from arraygeom import Camera
from arraygeom.text import angle

from .adequacy import Coverage, coverage_advice, coverages
from .detect import BoardViews
from .figures import (
    draw_adequacy,
    draw_by_image,
    draw_camera,
    draw_scene,
    draw_uncertainty,
    draw_worst_images,
    image,
)
from .parameters import term
from .photos import Photos
from .rig import Calibration
from .uncertainty import baseline_deviation, rig_covariance

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1080px; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: .6em 0 1.4em; font-variant-numeric: tabular-nums }
td, th { padding: .2em .8em .2em 0; text-align: left; vertical-align: top; border-bottom: 1px solid #ddd }
h2 { margin-top: 2em; font-size: 1.15em } img { max-width: 100% } .note { color: #8a3b00 } small { color: #666 }
"""


def report_html(
    calibration: Calibration,
    *,
    title: str = "Calibration",
    notes: Sequence[str] = (),
    detected: Mapping[str, BoardViews] | None = None,
    photos: Photos | None = None,
) -> str:
    """The report: accuracy by camera, pair and image, coverage, residual fields, uncertainties, the rig.

    With the points `detected` in `photos`, the images that fit worst are drawn.
    """
    covers = coverages(calibration)
    advice = by_cameras([*notes, *calibration.notes, *coverage_advice(calibration, covers)])
    parts = [
        f"<h1>{escape(title)}</h1>",
        f"<p>{escape(summary(calibration))}</p>",
        "<ul>" + "".join(f'<li class="note">{escape(a)}</li>' for a in advice) + "</ul>"
        if advice
        else "<p>No advice.</p>",
        "<h2>Cameras</h2>",
        camera_table(calibration, covers),
        "<h2>Pairs</h2>" + pair_table(calibration) if len(calibration.views) > 1 else "",
        "<h2>The rig and the boards</h2>",
        image(draw_scene(calibration)),
        "<h2>Residuals of each image</h2><p>Root mean square, pixels.</p>",
        image(draw_by_image(calibration)),
    ]
    worst = draw_worst_images(calibration, detected, photos) if detected and photos else None
    if worst is not None:
        parts += [
            "<h2>Images that fit worst</h2><p>Points used (dots), left out (red circles), residuals (enlarged).</p>",
            image(worst),
        ]
    for name in calibration.views:
        parts += [
            f"<h2>{escape(name)}: coverage and residuals</h2>",
            image(draw_camera(calibration, name, covers[name])),
        ]
    if calibration.fit.covariance is not None:
        parts += [
            "<h2>Adequacy of each camera</h2>",
            "<p>Left, middle: standard deviation (pixels, worst direction) of the projection of points at the nearest "
            "and the furthest depth of the boards, after the motion of the camera that keeps the boards where they "
            "were seen best. Right: how far cameras fitted to every other frame differ, where boards were seen (grey: "
            "nowhere): where that is much more, the lens model or the boards are inadequate.</p>",
            image(draw_adequacy(calibration, depths(covers.values()))),
        ]
    if len(calibration.views) > 1 and calibration.fit.covariance is not None:
        near, far = depths(covers.values())
        parts += [
            "<h2>Uncertainty of predicted positions</h2>",
            "<p>Standard deviation (pixels, worst direction) of the positions predicted in the other cameras for "
            f"pixels of the first, at {near:.3g} m (nearest board) and {far:.3g} m (furthest).</p>",
            image(draw_uncertainty(calibration, (near, far))),
        ]
    body = "\n".join(parts)
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style>'
    return f'<!DOCTYPE html>\n<html lang="en">{head}\n{body}\n</html>\n'


def by_cameras(notes: Iterable[str]) -> list[str]:
    """Notes such as "left: no points at the top", with the same text as one: "left, right: no points at the top"."""
    names: dict[str, list[str]] = {}
    for note in notes:
        name, between, text = note.partition(": ")
        name, text = (name, text) if between else ("", note)
        names.setdefault(text, []).append(name)
    return [": ".join(filter(None, [", ".join(dict.fromkeys(listed)), text])) for text, listed in names.items()]


def summary(calibration: Calibration) -> str:
    """The calibration in a sentence or two."""
    points = sum(len(seen.x) for seen in calibration.fit.problem.seen.values())
    text = (
        f"{len(calibration.views)} cameras, {len(calibration.frames)} frames of {calibration.board}, {points} points: "
        f"reprojection error {calibration.rms:.3f} px (RMS)."
    )
    for where, errors in (("", calibration.epipolar), (" on held-out frames", calibration.held_out)):
        if errors:
            pooled = np.concatenate(list(errors.values()))
            text += f" Epipolar error{where} {_mean_and_quantile(pooled, ' px (mean; 95 % below ')})."
    return text


def depths(covers: Iterable[Coverage]) -> tuple[float, float]:
    """Depths of the nearest and the furthest board point, metres."""
    near, far = zip(*(c.depths for c in covers))
    return max(min(near), 1e-3), max(far)


# Tables -------------------------------------------------------------------------------------------------------


def camera_table(calibration: Calibration, covers: Mapping[str, Coverage]) -> str:
    """One row per camera: points, residuals, and parameters with standard deviations."""
    residuals = calibration.fit.problem.residuals()
    head = "camera|images, points|error px, together (alone)|noise px|focal length px|principal point px|lens|covered"
    rows = []
    for name, camera in calibration.fit.problem.cameras.items():
        views, r, covered = calibration.views[name], residuals[name], covers[name]
        rms = np.sqrt((r**2).sum(-1).mean())
        rows.append(
            (
                f"{name} {camera.hw[1]}x{camera.hw[0]}",
                f"{len(views.seen)}, {len(r)}",
                f"{rms:.3f}" + (f" ({calibration.single[name]:.3f})" if name in calibration.single else ""),
                f"{calibration.fit.sigma[name]:.3f}",
                _with_deviations(calibration, name, camera, "focal"),
                _with_deviations(calibration, name, camera, "centre"),
                _with_deviations(calibration, name, camera, "distortion"),
                f"{covered.share:.0%} of the image, {covered.depths[0]:.3g} to {covered.depths[1]:.3g} m, "
                f"tilts {covered.tilts[0]:.0f} to {covered.tilts[1]:.0f} deg",
            )
        )
    return _table(head.split("|"), rows)


def pair_table(calibration: Calibration) -> str:
    """One row per pair: baseline, relative rotation and epipolar errors."""
    covariance = rig_covariance(calibration.fit)
    cameras = calibration.fit.problem.cameras
    rows = []
    for (a, b), errors in calibration.epipolar.items():
        baseline = float((cameras[a].centre - cameras[b].centre).norm())
        deviation = baseline_deviation(cameras, a, b, covariance) if covariance else None
        held = calibration.held_out.get((a, b))
        rows.append(
            (
                f"{a} – {b}",
                f"{1e3 * baseline:.2f}" + (f" ± {1e3 * deviation:.2f}" if deviation is not None else ""),
                f"{math.degrees(angle(cameras[b].R @ cameras[a].R.T)):.3f}",
                _mean_and_quantile(errors),
                "" if held is None or not len(held) else _mean_and_quantile(held),
            )
        )
    return _table(["pair", "baseline mm", "rotation deg", "epipolar error px, mean, 95 %", "on held-out frames"], rows)


def _mean_and_quantile(errors: np.ndarray, between: str = ", ") -> str:
    return f"{errors.mean():.3f}{between}{np.quantile(errors, 0.95):.3f}"


def _with_deviations(calibration: Calibration, name: str, camera: Camera, kind: str) -> str:
    covariance = rig_covariance(calibration.fit)
    lens = camera.distortion
    values = {
        "focal": camera.K.diagonal()[:2],
        "centre": camera.K[:2, 2],
        "distortion": camera.K.new_zeros(0) if lens is None else lens.coefficients,
    }[kind].tolist()
    texts = []
    for i, value in enumerate(values):
        label = "" if kind != "distortion" or lens is None else f"{term(lens, i)} "
        if f"{name}.{kind}.{i}" not in calibration.fit.names:
            texts.append(f"{label}{value:.4g} (fixed)" if value or kind != "distortion" else "")
            continue
        deviation = covariance.deviation(f"{name}.{kind}.{i}") if covariance else float("nan")
        texts.append(f"{label}{value:.{_digits(deviation)}f} ± {deviation:.2g}")
    return ", ".join(t for t in texts if t)


def _digits(deviation: float) -> int:
    """Significant decimals of a value with a standard deviation."""
    return int(np.clip(1 - np.floor(np.log10(deviation)), 0, 8)) if deviation > 0 else 4


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "".join(f"<th>{escape(h)}</th>" for h in head)
    lines = ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return f"<table><tr>{top}</tr>{''.join(lines)}</table>"
