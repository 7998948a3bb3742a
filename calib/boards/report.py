"""Report of a calibration: one HTML file with tables and figures of rig, residuals, coverage, uncertainty."""

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
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from torch import Tensor

from arraygeom import Camera, Rig
from arraygeom.distortion import term
from arraygeom.runtime.text import angle
from arraygeom.uncertainty import triangulation_covariance
from arraygeom.viz import COLOURS, draw_rig, show_image

from .adequacy import CELLS, Coverage, coverages
from .bundle import intrinsic_values, parameter_names
from .detect import BoardViews
from .photos import FrameKey, Photos
from .rig import Calibration
from .solve import frame_rms, misfits
from .uncertainty import (
    GRID,
    RigCovariance,
    baseline_deviation,
    beta_covariance,
    grid_points,
    intrinsics_of,
    rig_covariance,
    uncertainty,
    worst_deviation,
)
from .validation import half_difference

THUMBNAIL = 480
"""Width of a drawn image, pixels."""
DRAWN = 6
"""Largest number of drawn images."""
GOOD = 1.0
"""Deviation of lines and predicted positions up to which fusion searches at the right place, pixels."""


STYLE = """
:root { color-scheme: light dark; --text: #222; --line: #ddd; --note: #8a3b00; --soft: #666 }
@media (prefers-color-scheme: dark) {
  :root { --text: #e6e8ea; --line: #33383e; --note: #ff9d5c; --soft: #9aa3ad }
}
body { font: 15px/1.45 system-ui, sans-serif; max-width: 1080px; margin: 2em auto; padding: 0 1em;
  color: var(--text) }
table { border-collapse: collapse; margin: .6em 0 1.4em; font-variant-numeric: tabular-nums; display: block;
  overflow-x: auto }
td, th { padding: .2em .8em .2em 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--line) }
h2 { margin-top: 2em; font-size: 1.15em } img { max-width: 100%; background: #fff }
.note { color: var(--note) } small { color: var(--soft) }
"""
ADEQUACY = (
    "Left, middle: standard deviation (pixels, worst direction) of the projection of points at the nearest "
    "and the furthest depth of the boards, after the motion of the camera that keeps the boards where they "
    "were seen best. Right: how far cameras fitted to every other frame differ, where boards were seen "
    "(grey: nowhere): where that is much more, the lens model or the boards are inadequate."
)


def report_html(
    calibration: Calibration,
    *,
    title: str = "Calibration",
    notes: Sequence[str] = (),
    detected: Mapping[str, BoardViews] | None = None,
    photos: Photos | None = None,
    further: str = "",
) -> str:
    """Compose the HTML report of a calibration: verdict, notes, accuracy, coverage, residuals, uncertainty.

    Args:
        title: heading of the page.
        notes: sentences at the top; "No advice." without any.
        detected: all detections by camera; with `photos`, the images that fit worst are drawn. None to draw
            none.
        photos: images by camera and moment; None to draw none.
        further: HTML for the page's head, not escaped.

    Returns:
        The page as HTML, figures embedded.

    Raises:
        ValueError, OSError: if an image to be drawn cannot be read.
    """
    covers, has_covariance = coverages(calibration), calibration.fit.covariance is not None
    near, far = _depths(covers.values())
    parts = [
        f"<h1>{escape(title)}</h1><p><b>{escape(verdict(calibration))}</b></p>",
        f"<p>{escape(summary(calibration))}</p><ul>",
        *(f'<li class="note">{escape(a)}</li>' for a in notes or ["No advice."]),
        "</ul><h2>Cameras</h2>",
        camera_table(calibration, covers),
    ]
    if len(calibration.views) > 1:
        parts.append("<h2>Pairs</h2>" + pair_table(calibration))
    parts.append(_section("The rig and the boards", "", draw_scene(calibration)))
    parts.append(_section("Residuals of each image", "Root mean square, pixels.", draw_by_image(calibration)))
    if detected and photos and (worst := worst_images(calibration, detected)):
        text = "Points used (dots), left out (red circles), residuals (enlarged)."
        drawn = draw_images(calibration, worst, detected, photos)
        parts.append(_section("Images that fit worst", text, drawn))
    for name in calibration.views:
        drawn = draw_camera(calibration, name, covers[name])
        parts.append(_section(f"{name}: coverage and residuals", "", drawn))
    if has_covariance:
        drawn = draw_adequacy(calibration, (near, far))
        parts.append(_section("Adequacy of each camera", ADEQUACY, drawn))
    if has_covariance and len(calibration.views) > 1:
        text = (
            "Standard deviation (pixels, worst direction) of the positions predicted in the other cameras "
            f"for pixels of the first, at {near:.3g} m (nearest board) and {far:.3g} m (furthest)."
        )
        drawn = draw_uncertainty(calibration, (near, far))
        parts.append(_section("Uncertainty of predicted positions", text, drawn))
    return html_page(parts, title, further)


def _section(title: str, text: str, figure: Figure) -> str:
    """HTML of a figure under its title and text."""
    FigureCanvasAgg(figure)
    data = BytesIO()
    figure.savefig(data, format="png", dpi=150)
    image = f'<img alt="" src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}">'
    return f"<h2>{escape(title)}</h2><p>{text}</p>{image}"


def html_page(parts: Iterable[str], title: str, further: str = "") -> str:
    """Compose an HTML page of these parts in the report's style; `further` goes into its head."""
    fit = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    head = f'<meta charset="utf-8">{fit}{further}<title>{escape(title)}</title><style>{STYLE}</style>'
    return "\n".join([f'<!DOCTYPE html>\n<html lang="en">{head}', *parts, "</html>\n"])


def by_cameras(notes: Iterable[str]) -> list[str]:
    """Merge notes that differ only before the first colon, in the camera: "left: no points" and "right: no
    points" become "left, right: no points".

    Returns:
        The merged notes, in order of first appearance, each once.
    """
    names: dict[str, list[str]] = {}
    for note in notes:
        name, between, text = note.partition(": ")
        name, text = (name, text) if between else ("", note)
        names.setdefault(text, []).append(name)
    return [
        ": ".join(filter(None, [", ".join(dict.fromkeys(listed)), text])) for text, listed in names.items()
    ]


def summary(calibration: Calibration) -> str:
    """Summarise a calibration: numbers of cameras, frames and points, reprojection and epipolar errors.

    Returns:
        Up to three sentences, errors in pixels: epipolar errors only of pairs, and once more on held-out
        frames if there are enough.
    """
    points = sum(len(observed.x) for observed in calibration.fit.problem.seen.values())
    cameras, frames = len(calibration.views), len(calibration.frames)
    text = (
        f"{cameras} camera{'s' * (cameras > 1)}, {frames} frame{'s' * (frames > 1)} of {calibration.board}, "
        f"{points} points: reprojection error {calibration.rms:.3f} px (RMS)."
    )
    for where, errors in (("", calibration.epipolar), (" on held-out frames", calibration.held_out)):
        if errors:
            pooled = np.concatenate(list(errors.values()))
            text += f" Epipolar error{where} {_mean_and_quantile(pooled, ' px (mean; 95 % below ')})."
    return text


def verdict(calibration: Calibration) -> str:
    """Return a sentence on whether the rig is good enough to fuse, and between which depths.

    It is if points of held-out frames (not judged where they are too few) lie by `GOOD` pixels or less off
    their lines, in the mean of each pair, and, at some of five depths from the nearest to the farthest board
    point, the positions predicted for pixels of the first camera have a standard deviation below `GOOD`, in
    the median over the image, in the worst other camera that has any. Without a covariance it is not.

    Returns:
        The sentence, with depths in metres and deviations in pixels; empty for a single camera.
    """
    alpha, *betas = calibration.views
    covariance, covers = rig_covariance(calibration.fit), coverages(calibration)
    if not betas:
        return ""
    if covariance is None:
        return "Not good enough to fuse: the images do not determine all parameters; take more, tilted ones."
    off = max((float(errors.mean()) for errors in calibration.held_out.values() if len(errors)), default=0.0)
    if off > GOOD:
        return (
            f"Not good enough to fuse: points of held-out frames lie {off:.2f} px off their lines; check "
            "that images of one moment have the same number, and the lens model."
        )
    off_position, off_depth = {}, {}
    for depth in np.geomspace(*_depths(covers.values()), 5).tolist():
        x, X = grid_points(calibration.rig[alpha], depth)
        by_beta = (beta_covariance(calibration.rig, covariance, alpha, beta, x, depth) for beta in betas)
        usable = [pixels[np.isfinite(pixels).all((1, 2))] for pixels in by_beta]
        medians = [float(np.median(worst_deviation(pixels))) for pixels in usable if len(pixels)]
        if medians:
            off_position[depth] = max(medians)
            off_depth[depth] = _depth_deviation(calibration.rig, covariance, torch.from_numpy(X)) / depth
    good = [depth for depth, deviation in off_position.items() if deviation < GOOD]
    if not good:
        least = min(off_position.values(), default=math.nan)
        return f"Not good enough to fuse: predicted positions deviate by {least:.2g} px; take more images."
    most, share = (max(deviations[depth] for depth in good) for deviations in (off_position, off_depth))
    return (
        f"Good enough to fuse at {min(good):.3g} to {max(good):.3g} m, where the boards were: predicted "
        f"positions deviate by {most:.2g} px at most, and depth by {share:.1%} by this calibration (standard "
        "deviations, medians over the image)."
    )


def _depth_deviation(rig: Rig, covariance: RigCovariance, X: Float[Tensor, "n 3"]) -> float:
    """Median standard deviation along the first camera's axis of points that it and others see, metres."""
    projected = [(camera, camera.project(X)) for camera in rig.cameras.values()]
    seen = torch.stack([at.valid & camera.contains(at.x) for camera, at in projected])
    seen &= seen[0] & (seen.sum(0) > 1)
    x = torch.stack([at.x for _, at in projected]).nan_to_num()
    of_point = triangulation_covariance(rig, covariance, x[:, seen[0]], seen=seen[:, seen[0]])
    axis = rig[rig.names[0]].R[2]
    return float((axis @ of_point @ axis).sqrt().nanmedian())


def _depths(covers: Iterable[Coverage]) -> tuple[float, float]:
    """Depths of the nearest and the farthest board point, metres."""
    near, far = zip(*(c.depths for c in covers))
    return max(min(near), 1e-3), max(far)


# Tables -----------------------------------------------------------------------------------------------------


def camera_table(calibration: Calibration, covers: Mapping[str, Coverage]) -> str:
    """Format a table with one row for each camera: points, residuals, parameters with standard deviations.

    Args:
        covers: coverage by camera, of all cameras.

    Returns:
        HTML; deviations are nan without a covariance.
    """
    rows = []
    for name, camera in calibration.fit.problem.cameras.items():
        r, covered = calibration.fit.problem.residuals[name], covers[name]
        rms = np.sqrt((r**2).sum(-1).mean())
        row = {
            "camera": f"{name} {camera.hw[1]}x{camera.hw[0]}",
            "images, points": f"{len(calibration.views[name].seen)}, {len(r)}",
            "error px, together (alone)": f"{rms:.3f}"
            + (f" ({calibration.single[name]:.3f})" if name in calibration.single else ""),
            "noise px": f"{calibration.fit.problem.sigma[name]:.3f}",
            "focal length px": _with_deviations(calibration, name, camera, "focal"),
            "principal point px": _with_deviations(calibration, name, camera, "centre"),
            "lens": _with_deviations(calibration, name, camera, "distortion"),
            "covered": f"{covered.share:.0%} of the image, {covered.depths[0]:.3g} to "
            f"{covered.depths[1]:.3g} m, tilts {covered.tilts[0]:.0f} to {covered.tilts[1]:.0f} deg",
        }
        rows.append(row)
    return _table(rows)


def pair_table(calibration: Calibration) -> str:
    """Format a table with one row for each pair that saw common points: baseline, relative rotation, epipolar
    errors (mean and 95 % quantile), these also on held-out frames if there are enough.

    Returns:
        HTML, in mm, degrees and pixels; the baseline's deviation only where the fit has a covariance.
    """
    covariance = rig_covariance(calibration.fit)
    cameras = calibration.fit.problem.cameras
    rows = []
    for (a, b), errors in calibration.epipolar.items():
        baseline = f"{1e3 * float((cameras[a].centre - cameras[b].centre).norm()):.2f}"
        if covariance is not None:
            baseline += f" ± {1e3 * baseline_deviation(cameras, a, b, covariance):.2f}"
        held = calibration.held_out.get((a, b), ())
        row = {
            "pair": f"{a} – {b}",
            "baseline mm": baseline,
            "rotation deg": f"{math.degrees(angle(cameras[b].R @ cameras[a].R.T)):.3f}",
            "epipolar error px, mean, 95 %": _mean_and_quantile(errors),
            "on held-out frames": _mean_and_quantile(np.asarray(held)) if len(held) else "",
        }
        rows.append(row)
    return _table(rows)


def _mean_and_quantile(errors: np.ndarray, between: str = ", ") -> str:
    return f"{errors.mean():.3f}{between}{np.quantile(errors, 0.95):.3f}"


def _with_deviations(calibration: Calibration, name: str, camera: Camera, kind: str) -> str:
    """Values of a kind of intrinsics (focal, centre, distortion), each with its standard deviation."""
    lens, deviations = camera.distortion, calibration.fit.deviations
    texts = []
    for entry, value in zip(parameter_names(camera), intrinsic_values(camera)):
        entry_kind, index = entry.split(".")
        if entry_kind != kind:
            continue
        label = f"{term(lens, int(index))} " if kind == "distortion" and lens is not None else ""
        if f"{name}.{entry}" in calibration.fit.names:
            deviation = deviations.get(f"{name}.{entry}", math.nan)
            digits = int(np.clip(1 - np.floor(np.log10(deviation)), 0, 8)) if deviation > 0 else 4
            texts.append(f"{label}{value:.{digits}f} ± {deviation:.2g}")
        elif value or kind != "distortion":
            texts.append(f"{label}{value:.4g} (fixed)")
    return ", ".join(texts)


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    top = "".join(f"<th>{escape(head)}</th>" for row in rows[:1] for head in row)
    lines = ["".join(f"<td>{escape(cell)}</td>" for cell in row.values()) for row in rows]
    return f"<table><tr>{'</tr><tr>'.join([top, *lines])}</tr></table>"


# Figures ----------------------------------------------------------------------------------------------------


def draw_scene(calibration: Calibration) -> Figure:
    """Draw the rig alone in space, and the rig with the boards from above (x and z of the world, metres)."""
    figure = draw_rig(Rig({escaped(n): c for n, c in calibration.rig.cameras.items()}))
    figure.set_size_inches(10.4, 4.6)
    axes: Any = figure.axes[0]
    axes.set_position((0.0, 0.02, 0.46, 0.94))
    figure.set_layout_engine("none")
    above = figure.add_axes((0.55, 0.12, 0.43, 0.8))
    (left, top, _), (right, bottom, _) = calibration.board.points.min(0), calibration.board.points.max(0)
    outline = [[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]
    corners = torch.tensor([[*corner, 0.0] for corner in outline], dtype=torch.float64)
    for pose in calibration.fit.problem.board_poses.values():
        X = pose.apply(corners).numpy()
        above.plot(X[:, 0], X[:, 2], color="0.75", lw=0.8)
    for colour, (name, camera) in zip(cycle(COLOURS), calibration.fit.problem.cameras.items()):
        x, _, z = camera.centre.tolist()
        dx, _, dz = camera.R[2].tolist()
        above.plot(x, z, "o", ms=4, color=colour)
        place: dict[str, Any] = {"textcoords": "offset points", "va": "top", "ha": "center"}
        above.annotate(escaped(name), (x, z), (0, -4), fontsize=8, color=colour, **place)
        above.quiver(x, z, dx, dz, color=colour, width=0.004, scale=12)
    above.set(aspect="equal", xlabel="x (m)", ylabel="z (m)")
    above.set_title("from above, with the boards", fontsize=9)
    above.spines[["top", "right"]].set_visible(False)
    return figure


def draw_by_image(calibration: Calibration) -> Figure:
    """Plot the root mean square residual (pixels) of every image of every camera, by frame."""
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
    """Draw one camera's observed points, median residuals over the image (enlarged), and residuals' scatter.

    Residuals are measured minus projected pixels; the scatter is clipped to four deviations of the noise.

    Args:
        name: name of the camera.
        covered: coverage of its image; cells without points are red.
    """
    observed, r = calibration.fit.problem.seen[name], calibration.fit.problem.residuals[name]
    hw = calibration.views[name].hw
    figure = Figure(
        figsize=(10.4, 10.4 / 3.4 * min(1.6, max(0.8, 1.33 * hw[0] / hw[1])) + 0.5), layout="compressed"
    )
    left, middle, right = figure.subplots(1, 3)
    show_image(left, hw)
    left.imshow(
        np.where(covered.cells, np.nan, 1.0), extent=_extent(hw), cmap="Reds", vmin=0, vmax=4, aspect="equal"
    )
    left.plot(*observed.x.T, ".", ms=1.5, color=COLOURS[0])
    left.set_title(f"points observed (red: none), {covered.share:.0%} covered", fontsize=9)
    show_image(middle, hw)
    _draw_field(middle, observed.x, r, hw)
    limit = max(4 * calibration.fit.problem.sigma[name], 1e-3)
    right.plot(*np.clip(r, -limit, limit).T, ".", ms=1.5, color=COLOURS[0])
    right.set(xlim=(-limit, limit), ylim=(limit, -limit), aspect="equal", xlabel="x (px)", ylabel="y (px)")
    right.set_title(f"residuals, noise {calibration.fit.problem.sigma[name]:.3f} px", fontsize=9)
    right.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_field(axes: Any, x: np.ndarray, r: np.ndarray, hw: tuple[int, int]) -> None:
    """Draw the median residual of each cell as an arrow, enlarged so that the longest nearly fills a cell."""
    rows, columns = 2 * CELLS[0], 2 * CELLS[1]
    row = np.clip(((x[:, 1] + 0.5) / hw[0] * rows).astype(int), 0, rows - 1)
    column = np.clip(((x[:, 0] + 0.5) / hw[1] * columns).astype(int), 0, columns - 1)
    cell = row * columns + column
    filled = [c for c in np.unique(cell) if (cell == c).sum() >= 3]
    if not filled:
        return
    centres = np.array([x[cell == c].mean(0) for c in filled])
    arrows = np.array([np.median(r[cell == c], axis=0) for c in filled])
    longest = _draw_arrows(axes, centres, arrows, 1.2 * hw[1] / columns, COLOURS[1])
    axes.set_title(f"median residuals, longest {longest:.3f} px", fontsize=9)


def draw_uncertainty(calibration: Calibration, depths: tuple[float, float]) -> Figure:
    """Draw the standard deviation (worst direction, pixels) of predicted positions over the first camera's
    image, by beta (rows) and depth (columns).

    Args:
        calibration: calibration of two cameras or more; AssertionError without a covariance.
        depths: depths in metres.
    """
    covariance = rig_covariance(calibration.fit)
    assert covariance is not None
    alpha, *betas = calibration.views
    figure = Figure(figsize=(8.4, 2.6 * len(betas) + 0.3), layout="constrained")
    for row, beta in zip(figure.subplots(len(betas), len(depths), squeeze=False), betas):
        for axes, depth in zip(row, depths):
            x, _ = grid_points(calibration.rig[alpha], depth)
            pixels = beta_covariance(calibration.rig, covariance, alpha, beta, x, depth)
            usable = np.isfinite(pixels).all((1, 2))
            title = f"{beta} of {alpha}, {depth:.3g} m"
            hw = calibration.views[alpha].hw
            _map(axes, figure, hw, x[usable], worst_deviation(pixels[usable]), title)
    return figure


def _extent(hw: tuple[int, int]) -> tuple[float, float, float, float]:
    return (-0.5, hw[1] - 0.5, hw[0] - 0.5, -0.5)


def draw_adequacy(calibration: Calibration, depths: tuple[float, float]) -> Figure:
    """Draw each camera's (row's) uncertainty of projection at two depths, and the difference between halves
    of the frames (if there are enough) at their mean, in pixels.

    Args:
        calibration: calibration with a covariance; without one the uncertainty is drawn as 0.
        depths: both depths, metres.
    """
    names = list(calibration.views)
    figure = Figure(figsize=(10.4, 2.5 * len(names) + 0.3), layout="constrained")
    halves = half_difference(calibration.fit, float(np.mean(depths)))
    for row, name in zip(figure.subplots(len(names), 3, squeeze=False), names):
        intrinsics = intrinsics_of(calibration.fit, name)
        for axes, depth in zip(row, depths):
            x, deviation = uncertainty(intrinsics, depth)
            _map(axes, figure, intrinsics.camera.hw, x, deviation, f"{name}: uncertainty at {depth:.2g} m")
        x, off = halves.get(name, np.zeros((2, 0, 2)))
        if len(x) < 4:
            row[2].set_axis_off()
            row[2].set_title("too few frames to compare halves", fontsize=9)
            continue
        length = np.linalg.norm(off, axis=1)
        _map(row[2], figure, intrinsics.camera.hw, x, length, f"{name}: halves of the frames")
        row[2].quiver(*x[::3].T, *off[::3].T, angles="xy", color="white", width=0.003)
    return figure


def _map(
    axes: Any, figure: Figure, hw: tuple[int, int], x: np.ndarray, value: np.ndarray, title: str
) -> None:
    """Draw values at pixels of `grid_points`; grey between pixels that are no neighbours."""
    show_image(axes, hw)
    axes.set_facecolor("0.85")
    if len(x) < 4:
        axes.set_title(escaped(f"{title}: too few points"), fontsize=9, loc="left")
        return
    triangles = Triangulation(*x.T)
    spread = np.ptp(x[triangles.triangles], axis=1) * (np.array(GRID)[::-1] - 1) / (hw[1], hw[0])
    triangles.set_mask((spread > 1.5).any(1))
    drawn = axes.tripcolor(
        triangles, np.maximum(value, 1e-4), shading="gouraud", cmap="viridis", norm=LogNorm()
    )
    axes.set_title(escaped(f"{title}: median {np.median(value):.2g} px"), fontsize=9, loc="left")
    figure.colorbar(drawn, ax=axes, shrink=0.8)


def draw_images(
    calibration: Calibration,
    chosen: Sequence[tuple[str, FrameKey]],
    detected: Mapping[str, BoardViews],
    photos: Photos,
) -> Figure:
    """Draw images with used points (dots), left-out ones (red circles) and enlarged residuals.

    Args:
        chosen: camera and moment of each image, at least one, each in `detected`.
        detected: all detections by camera.
        photos: images by camera (all of `chosen`) and moment; without one, its points are drawn alone.

    Raises:
        ValueError, OSError: if an image cannot be read.
    """
    columns = min(3, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(10.4, 2.9 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid:
        axes.set_axis_off()
    for axes, (name, key) in zip(grid, chosen):
        _draw_image(axes, calibration, name, key, detected[name], photos)
    return figure


def worst_images(calibration: Calibration, detected: Mapping[str, BoardViews]) -> list[tuple[str, FrameKey]]:
    """List images (camera, moment) that do not fit, then those with most points left out; at most `DRAWN`."""
    worst = [(m.camera, m.frame) for m in misfits(calibration.fit)]
    left_out: dict[tuple[str, FrameKey], int] = {}
    for name, v in detected.items():
        used = {key: len(d.ids) for key, d in calibration.views[name].seen.items()}
        left_out |= {(name, key): len(d.ids) - used.get(key, 0) for key, d in v.seen.items()}
    worst += sorted((image for image, count in left_out.items() if count), key=lambda image: -left_out[image])
    return list(dict.fromkeys(worst))[:DRAWN]


def _draw_image(
    axes: Any, calibration: Calibration, name: str, key: FrameKey, views: BoardViews, photos: Photos
) -> None:
    """Draw an image, its corners, left-out ones in red, and residuals as arrows."""
    image_key = str(key).split(" board ")[0]  # of several boards in it
    photo = next((photo for other, photo in photos[name].items() if str(other) == image_key), None)
    if photo is not None:
        scale = THUMBNAIL / views.hw[1]
        small = cv2.resize(photo.read(), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        axes.imshow(small, cmap="gray", extent=_extent(views.hw))
    used = calibration.views[name].seen.get(key)
    x = views.seen[key].x
    kept = np.zeros(len(x), dtype=bool) if used is None else (x[:, None] == used.x[None]).all(-1).any(1)
    axes.plot(*x[kept].T, ".", ms=2, color=COLOURS[0])
    axes.plot(*x[~kept].T, "o", ms=5, mfc="none", color="red")
    text = f"{name} {key}: {int((~kept).sum())} of {len(x)} left out"
    if key in calibration.frames and used is not None:
        problem = calibration.fit.problem
        mine = problem.seen[name].block == calibration.frames.index(key)
        r = problem.residuals[name][mine]
        _draw_arrows(axes, problem.seen[name].x[mine], r, 0.06 * views.hw[1], "orange")
        text += f", {frame_rms(problem)[name][key]:.2f} px"
    axes.set_title(escaped(text), fontsize=9)


def _draw_arrows(axes: Any, x: np.ndarray, r: np.ndarray, length: float, colour: str) -> float:
    """Draw residuals as arrows, the longest `length` pixels long; returns the longest residual."""
    longest = float(np.linalg.norm(r, axis=1).max())
    arrows = length / max(longest, 1e-9) * r
    axes.quiver(*x.T, *arrows.T, angles="xy", scale_units="xy", scale=1, width=0.004, color=colour)
    return longest


def escaped(text: str) -> str:
    """Escape text so that matplotlib does not parse it as a formula."""
    return text.replace("$", r"\$")
