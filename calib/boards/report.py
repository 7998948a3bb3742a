"""A calibration's report: one HTML file with tables and figures: rig, residuals, coverage, uncertainty."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from io import BytesIO
from itertools import cycle
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from torch import Tensor

from arraygeom import Camera, Rig
from arraygeom.distortion import term
from arraygeom.text import angle
from arraygeom.viz import COLOURS, draw_rig, show_image

from .adequacy import CELLS, Coverage, coverage_advice, coverages
from .detect import BoardViews
from .photos import FrameKey, Photos
from .rig import Calibration
from .solve import frame_rms, misfits
from .uncertainty import (
    GRID,
    baseline_deviation,
    beta_covariance,
    intrinsics_of,
    rig_covariance,
    uncertainty,
    worst_deviation,
)
from .validation import half_difference

THUMBNAIL = 480
"""Width of a drawn image, pixels."""
DRAWN = 6
"""Images drawn at most."""


STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1080px; margin: 2em auto; padding: 0 1em;
  color: #222 }
table { border-collapse: collapse; margin: .6em 0 1.4em; font-variant-numeric: tabular-nums }
td, th { padding: .2em .8em .2em 0; text-align: left; vertical-align: top; border-bottom: 1px solid #ddd }
h2 { margin-top: 2em; font-size: 1.15em } img { max-width: 100% }
.note { color: #8a3b00 } small { color: #666 }
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
            "<h2>Images that fit worst</h2><p>Points used (dots), "
            "left out (red circles), residuals (enlarged).</p>",
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
            "<p>Left, middle: standard deviation (pixels, worst direction) of the projection of points at "
            "the nearest and the furthest depth of the boards, after the motion of the camera that keeps "
            "the boards where they were seen best. Right: how far cameras fitted to every other frame "
            "differ, where boards were seen (grey: nowhere): where that is much more, "
            "the lens model or the boards are inadequate.</p>",
            image(draw_adequacy(calibration, depths(covers.values()))),
        ]
    if len(calibration.views) > 1 and calibration.fit.covariance is not None:
        near, far = depths(covers.values())
        parts += [
            "<h2>Uncertainty of predicted positions</h2>",
            "<p>Standard deviation (pixels, worst direction) of the positions predicted in the other "
            f"cameras for pixels of the first, at {near:.3g} m (nearest board) and {far:.3g} m "
            "(furthest).</p>",
            image(draw_uncertainty(calibration, (near, far))),
        ]
    return html_page(parts, title)


def html_page(parts: Iterable[str], title: str, further: str = "") -> str:
    """A page of these parts in the report's style; `further` is for its head."""
    head = f'<meta charset="utf-8">{further}<title>{escape(title)}</title><style>{STYLE}</style>'
    return "\n".join([f'<!DOCTYPE html>\n<html lang="en">{head}', *parts, "</html>\n"])


def by_cameras(notes: Iterable[str]) -> list[str]:
    """Notes such as "left: no points at the top", equal ones as one: "left, right: no points at the top"."""
    names: dict[str, list[str]] = {}
    for note in notes:
        name, between, text = note.partition(": ")
        name, text = (name, text) if between else ("", note)
        names.setdefault(text, []).append(name)
    return [
        ": ".join(filter(None, [", ".join(dict.fromkeys(listed)), text])) for text, listed in names.items()
    ]


def summary(calibration: Calibration) -> str:
    """The calibration in a sentence or two."""
    points = sum(len(seen.x) for seen in calibration.fit.problem.seen.values())
    text = (
        f"{len(calibration.views)} cameras, {len(calibration.frames)} frames of {calibration.board}, "
        f"{points} points: reprojection error {calibration.rms:.3f} px (RMS)."
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


# Tables -----------------------------------------------------------------------------------------------------


def camera_table(calibration: Calibration, covers: Mapping[str, Coverage]) -> str:
    """One row per camera: points, residuals, and parameters with standard deviations."""
    residuals = calibration.fit.problem.residuals
    head = (
        "camera|images, points|error px, "
        "together (alone)|noise px|focal length px|principal point px|lens|covered"
    )
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
    return _table(
        ["pair", "baseline mm", "rotation deg", "epipolar error px, mean, 95 %", "on held-out frames"], rows
    )


def _mean_and_quantile(errors: np.ndarray, between: str = ", ") -> str:
    return f"{errors.mean():.3f}{between}{np.quantile(errors, 0.95):.3f}"


def _with_deviations(calibration: Calibration, name: str, camera: Camera, kind: str) -> str:
    lens, deviations = camera.distortion, calibration.fit.deviations
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
        deviation = deviations.get(f"{name}.{kind}.{i}", math.nan)
        texts.append(f"{label}{value:.{_digits(deviation)}f} ± {deviation:.2g}")
    return ", ".join(t for t in texts if t)


def _digits(deviation: float) -> int:
    """Significant decimals of a value with a standard deviation."""
    return int(np.clip(1 - np.floor(np.log10(deviation)), 0, 8)) if deviation > 0 else 4


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "".join(f"<th>{escape(h)}</th>" for h in head)
    lines = ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return f"<table><tr>{top}</tr>{''.join(lines)}</table>"


# Figures ----------------------------------------------------------------------------------------------------


def draw_scene(calibration: Calibration) -> Figure:
    """The rig alone, and the rig with the boards from above."""
    figure = draw_rig(Rig({escaped(n): c for n, c in calibration.rig.cameras.items()}))
    figure.set_size_inches(10.4, 4.6)
    axes: Any = figure.axes[0]
    axes.set_position((0.0, 0.02, 0.46, 0.94))
    figure.set_layout_engine("none")
    above = figure.add_axes((0.55, 0.12, 0.43, 0.8))
    corners = _outline(calibration)
    for pose in calibration.fit.problem.board_poses.values():
        X = pose.apply(corners).numpy()
        above.plot(X[:, 0], X[:, 2], color="0.75", lw=0.8)
    for colour, (name, camera) in zip(cycle(COLOURS), calibration.fit.problem.cameras.items()):
        x, _, z = camera.centre.tolist()
        dx, _, dz = camera.R[2].tolist()
        above.plot(x, z, "o", ms=4, color=colour)
        above.annotate(
            escaped(name),
            (x, z),
            (0, -4),
            textcoords="offset points",
            fontsize=8,
            color=colour,
            va="top",
            ha="center",
        )
        above.quiver(x, z, dx, dz, color=colour, width=0.004, scale=12)
    above.set(aspect="equal", xlabel="x (m)", ylabel="z (m)")
    above.set_title("from above, with the boards", fontsize=9)
    above.spines[["top", "right"]].set_visible(False)
    return figure


def draw_by_image(calibration: Calibration) -> Figure:
    """The root mean square residual of every image of every camera, by frame."""
    frames = calibration.frames
    figure = Figure(figsize=(10.4, 2.8), layout="constrained")
    axes = figure.subplots()
    for colour, (name, rms) in zip(cycle(COLOURS), frame_rms(calibration.fit.problem).items()):
        numbers = [frames.index(key) for key in rms]
        axes.plot(numbers, list(rms.values()), "o", ms=4, color=colour, label=escaped(name))
    step = max(1, len(frames) // 30)
    axes.set_xticks(
        range(0, len(frames), step), [escaped(str(f)) for f in frames[::step]], fontsize=7, rotation=60
    )
    axes.set(ylim=(0, None), xlabel="frame", ylabel="RMS residual (px)")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(fontsize=8, frameon=False, loc="outside right upper")
    return figure


def draw_camera(calibration: Calibration, name: str, covered: Coverage) -> Figure:
    """One camera: observed points; median residuals of parts of the image, magnified; their scatter."""
    seen, r = calibration.fit.problem.seen[name], calibration.fit.problem.residuals[name]
    hw = calibration.views[name].hw
    figure = Figure(
        figsize=(10.4, 10.4 / 3.4 * min(1.6, max(0.8, 1.33 * hw[0] / hw[1])) + 0.5), layout="compressed"
    )
    left, middle, right = figure.subplots(1, 3)
    show_image(left, hw)
    left.imshow(
        np.where(covered.cells, np.nan, 1.0), extent=_extent(hw), cmap="Reds", vmin=0, vmax=4, aspect="equal"
    )
    left.plot(*seen.x.T, ".", ms=1.5, color=COLOURS[0])
    left.set_title(f"points observed (red: none), {covered.share:.0%} covered", fontsize=9)
    show_image(middle, hw)
    _draw_field(middle, seen.x, r, hw)
    limit = max(4 * calibration.fit.sigma[name], 1e-3)
    right.plot(*np.clip(r, -limit, limit).T, ".", ms=1.5, color=COLOURS[0])
    right.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal", xlabel="x (px)", ylabel="y (px)")
    right.set_title(f"residuals, noise {calibration.fit.sigma[name]:.3f} px", fontsize=9)
    right.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_field(axes: Any, x: np.ndarray, r: np.ndarray, hw: tuple[int, int]) -> None:
    """The median residual in each cell as an arrow, magnified so that the longest nearly fills a cell."""
    rows, columns = 2 * CELLS[0], 2 * CELLS[1]
    row = np.clip(((x[:, 1] + 0.5) / hw[0] * rows).astype(int), 0, rows - 1)
    column = np.clip(((x[:, 0] + 0.5) / hw[1] * columns).astype(int), 0, columns - 1)
    cell = row * columns + column
    filled = [c for c in np.unique(cell) if (cell == c).sum() >= 3]
    if not filled:
        return
    at = np.array([x[cell == c].mean(0) for c in filled])
    arrows = np.array([np.median(r[cell == c], axis=0) for c in filled])
    longest = float(np.linalg.norm(arrows, axis=1).max())
    magnify = 1.2 * hw[1] / columns / max(longest, 1e-9)
    axes.quiver(
        *at.T, *(magnify * arrows).T, angles="xy", scale_units="xy", scale=1, width=0.004, color=COLOURS[1]
    )
    axes.set_title(f"median residuals, longest {longest:.3f} px", fontsize=9)


def draw_uncertainty(calibration: Calibration, at: tuple[float, float]) -> Figure:
    """By beta (rows) and depth (columns): the predicted pixel's deviation, over the first camera's image."""
    covariance = rig_covariance(calibration.fit)
    assert covariance is not None
    alpha, *betas = calibration.views
    h, w = calibration.views[alpha].hw
    xs, ys = np.linspace(0, w - 1, 25), np.linspace(0, h - 1, 19)
    x = np.stack(np.meshgrid(xs, ys), -1).reshape(-1, 2)
    figure = Figure(figsize=(8.4, 2.6 * len(betas) + 0.3), layout="constrained")
    grid = figure.subplots(len(betas), len(at), squeeze=False)
    for row, beta in zip(grid, betas):
        for axes, depth in zip(row, at):
            pixels = beta_covariance(calibration.rig, covariance, alpha, beta, x, depth)
            usable = np.isfinite(pixels).all((1, 2))
            deviation = np.full(len(x), np.nan)
            deviation[usable] = worst_deviation(pixels[usable])
            shown = axes.imshow(
                deviation.reshape(len(ys), len(xs)), extent=_extent((h, w)), cmap="viridis", norm=LogNorm()
            )
            axes.set(xticks=[], yticks=[])
            median = float(np.median(deviation[usable])) if usable.any() else float("nan")
            axes.set_title(
                f"{escaped(beta)} of {escaped(alpha)}, {depth:.3g} m: median {median:.2f} px", fontsize=9
            )
            figure.colorbar(shown, ax=axes, shrink=0.9)
    return figure


def image(figure: Figure) -> str:
    """A figure as an embedded HTML image."""
    FigureCanvasAgg(figure)
    data = BytesIO()
    figure.savefig(data, format="png", dpi=110)
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}">'


def _outline(calibration: Calibration) -> Tensor:
    (left, top, _), (right, bottom, _) = calibration.board.points.min(0), calibration.board.points.max(0)
    corners = [[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]
    return torch.tensor([[*corner, 0.0] for corner in corners], dtype=torch.float64)


def _extent(hw: tuple[int, int]) -> tuple[float, float, float, float]:
    return (-0.5, hw[1] - 0.5, hw[0] - 0.5, -0.5)


def draw_adequacy(calibration: Calibration, depths: tuple[float, float]) -> Figure:
    """A row per camera: uncertainty of projection at two depths, and how halves of the frames differ."""
    names = list(calibration.views)
    figure = Figure(figsize=(10.4, 2.5 * len(names) + 0.3), layout="constrained")
    halves = half_difference(calibration.fit, float(np.mean(depths)))
    for row, name in zip(figure.subplots(len(names), 3, squeeze=False), names):
        known = intrinsics_of(calibration.fit, name)
        for axes, depth in zip(row, depths):
            x, deviation = uncertainty(known, depth)
            _map(axes, figure, known.camera.hw, x, deviation, f"{name}: uncertainty at {depth:.2g} m")
        if len(halves.get(name, ((), ()))[0]) > 3:
            x, off = halves[name]
            length = np.linalg.norm(off, axis=1)
            _map(row[2], figure, known.camera.hw, x, length, f"{name}: halves of the frames")
            row[2].quiver(*x[::3].T, *off[::3].T, angles="xy", color="white", width=0.003)
        else:
            row[2].set_axis_off()
            row[2].set_title("too few frames to compare halves", fontsize=9)
    return figure


def _map(
    axes: Any, figure: Figure, hw: tuple[int, int], x: np.ndarray, value: np.ndarray, title: str
) -> None:
    """Values at pixels of `grid_points`; what lies between pixels that are no neighbours is grey."""
    triangles = Triangulation(*x.T)
    spread = np.ptp(x[triangles.triangles], axis=1) * (np.array(GRID)[::-1] - 1) / (hw[1], hw[0])
    triangles.set_mask((spread > 1.5).any(1))
    drawn = axes.tripcolor(
        triangles, np.maximum(value, 1e-4), shading="gouraud", cmap="viridis", norm=LogNorm()
    )
    axes.set(xlim=(0, hw[1]), ylim=(hw[0], 0), aspect="equal", xticks=[], yticks=[], facecolor="0.85")
    axes.set_title(escaped(f"{title}: median {np.median(value):.2g} px"), fontsize=9, loc="left")
    figure.colorbar(drawn, ax=axes, shrink=0.8)


def draw_worst_images(
    calibration: Calibration, detected: Mapping[str, BoardViews], photos: Photos
) -> Figure | None:
    """Images with most points left out or largest residuals: points (red: left out), residuals enlarged."""
    chosen = _worst(calibration, detected)
    if not chosen:
        return None
    columns = min(3, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(10.4, 2.9 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid:
        axes.set_axis_off()
    for axes, (name, key) in zip(grid, chosen):
        _draw_image(axes, calibration, name, key, detected[name], photos)
    return figure


def _worst(calibration: Calibration, detected: Mapping[str, BoardViews]) -> list[tuple[str, FrameKey]]:
    found = [(m.camera, m.frame) for m in misfits(calibration.fit)]
    left_out = {
        (name, key): len(d.ids)
        - (len(calibration.views[name].seen[key].ids) if key in calibration.views[name].seen else 0)
        for name, v in detected.items()
        for key, d in v.seen.items()
    }
    found += sorted((image for image, count in left_out.items() if count), key=lambda image: -left_out[image])
    return list(dict.fromkeys(found))[:DRAWN]


def _draw_image(
    axes: Any, calibration: Calibration, name: str, key: FrameKey, views: BoardViews, photos: Photos
) -> None:
    photo = _photo(photos[name], key)
    scale = THUMBNAIL / views.hw[1]
    if photo is not None:
        small = cv2.resize(photo.read(), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        axes.imshow(small, cmap="gray", extent=(-0.5, views.hw[1] - 0.5, views.hw[0] - 0.5, -0.5))
    used = calibration.views[name].seen.get(key)
    x = views.seen[key].x
    kept = np.zeros(len(x), dtype=bool) if used is None else (x[:, None] == used.x[None]).all(-1).any(1)
    axes.plot(*x[kept].T, ".", ms=2, color=COLOURS[0])
    axes.plot(*x[~kept].T, "o", ms=5, mfc="none", color="red")
    text = f"{name} {key}: {int((~kept).sum())} of {len(x)} left out"
    if key in calibration.frames and used is not None:
        block = calibration.frames.index(key)
        mine = calibration.fit.problem.seen[name].block == block
        r = calibration.fit.problem.residuals[name][mine]
        enlarge = 0.06 * views.hw[1] / max(float(np.linalg.norm(r, axis=1).max()), 1e-9)
        at = calibration.fit.problem.seen[name].x[mine]
        axes.quiver(
            *at.T, *(enlarge * r).T, angles="xy", scale_units="xy", scale=1, width=0.004, color="orange"
        )
        text += f", {frame_rms(calibration.fit.problem)[name][key]:.2f} px"
    axes.set_title(escaped(text), fontsize=9)


def _photo(photos: Mapping[FrameKey, Any], key: FrameKey) -> Any | None:
    """The image of a view, which may be of one of several boards in it."""
    by_text = {str(k): photo for k, photo in photos.items()}
    return by_text.get(str(key).split(" board ")[0])


def escaped(text: str) -> str:
    """Text that matplotlib does not parse as formulas."""
    return text.replace("$", r"\$")
