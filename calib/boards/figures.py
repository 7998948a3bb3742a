"""Figures of a calibration: the rig, residuals, coverage, uncertainty, the images that fit worst."""

from __future__ import annotations

import base64
from collections.abc import Mapping
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

from arraygeom import Rig
from arraygeom.viz import COLOURS, draw_rig, show_image

from .adequacy import CELLS, Coverage
from .detect import BoardViews
from .photos import FrameKey, Photos
from .rig import Calibration
from .rig_diff import RigDifference
from .uncertainty import GRID, beta_covariance, half_difference, intrinsics_of, rig_covariance, uncertainty
from .validation import frame_rms, misfits

THUMBNAIL = 480
"""Width of a drawn image, pixels."""
DRAWN = 6
"""Images drawn at most."""


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
            escaped(name), (x, z), (0, -4), textcoords="offset points", fontsize=8, color=colour, va="top", ha="center"
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
        axes.plot([frames.index(key) for key in rms], list(rms.values()), "o", ms=4, color=colour, label=escaped(name))
    step = max(1, len(frames) // 30)
    axes.set_xticks(range(0, len(frames), step), [escaped(str(f)) for f in frames[::step]], fontsize=7, rotation=60)
    axes.set(ylim=(0, None), xlabel="frame", ylabel="RMS residual (px)")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(fontsize=8, frameon=False, loc="outside right upper")
    return figure


def draw_camera(calibration: Calibration, name: str, covered: Coverage) -> Figure:
    """One camera: observed points; the median residual of each part of the image, magnified; their scatter."""
    seen, r = calibration.fit.problem.seen[name], calibration.fit.problem.residuals()[name]
    hw = calibration.views[name].hw
    figure = Figure(figsize=(10.4, 10.4 / 3.4 * min(1.6, max(0.8, 1.33 * hw[0] / hw[1])) + 0.5), layout="compressed")
    left, middle, right = figure.subplots(1, 3)
    show_image(left, hw)
    left.imshow(np.where(covered.cells, np.nan, 1.0), extent=_extent(hw), cmap="Reds", vmin=0, vmax=4, aspect="equal")
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
    axes.quiver(*at.T, *(magnify * arrows).T, angles="xy", scale_units="xy", scale=1, width=0.004, color=COLOURS[1])
    axes.set_title(f"median residuals, longest {longest:.3f} px", fontsize=9)


def draw_uncertainty(calibration: Calibration, at: tuple[float, float]) -> Figure:
    """By beta (rows) and depth (columns): the deviation of the predicted pixel, over the first camera's image."""
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
            deviation[usable] = np.sqrt(np.linalg.eigvalsh(pixels[usable])[:, -1])
            shown = axes.imshow(
                deviation.reshape(len(ys), len(xs)), extent=_extent((h, w)), cmap="viridis", norm=LogNorm()
            )
            axes.set(xticks=[], yticks=[])
            median = float(np.median(deviation[usable])) if usable.any() else float("nan")
            axes.set_title(f"{escaped(beta)} of {escaped(alpha)}, {depth:.3g} m: median {median:.2f} px", fontsize=9)
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
    """A row per camera: uncertainty of projection at two depths, and the difference between halves of the frames."""
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


def _map(axes: Any, figure: Figure, hw: tuple[int, int], x: np.ndarray, value: np.ndarray, title: str) -> None:
    """Values at pixels of `grid_points`; what lies between pixels that are no neighbours is grey."""
    triangles = Triangulation(*x.T)
    spread = np.ptp(x[triangles.triangles], axis=1) * (np.array(GRID)[::-1] - 1) / (hw[1], hw[0])
    triangles.set_mask((spread > 1.5).any(1))
    drawn = axes.tripcolor(triangles, np.maximum(value, 1e-4), shading="gouraud", cmap="viridis", norm=LogNorm())
    axes.set(xlim=(0, hw[1]), ylim=(hw[0], 0), aspect="equal", xticks=[], yticks=[], facecolor="0.85")
    axes.set_title(escaped(f"{title}: median {np.median(value):.2g} px"), fontsize=9, loc="left")
    figure.colorbar(drawn, ax=axes, shrink=0.8)


def draw_worst_images(calibration: Calibration, detected: Mapping[str, BoardViews], photos: Photos) -> Figure | None:
    """The images with most points left out or largest residuals: points used, left out (red), residuals enlarged."""
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
        r = calibration.fit.problem.residuals()[name][mine]
        enlarge = 0.06 * views.hw[1] / max(float(np.linalg.norm(r, axis=1).max()), 1e-9)
        at = calibration.fit.problem.seen[name].x[mine]
        axes.quiver(*at.T, *(enlarge * r).T, angles="xy", scale_units="xy", scale=1, width=0.004, color="orange")
        text += f", {frame_rms(calibration.fit.problem)[name][key]:.2f} px"
    axes.set_title(escaped(text), fontsize=9)


def _photo(photos: Mapping[FrameKey, Any], key: FrameKey) -> Any | None:
    """The image of a view, which may be of one of several boards in it."""
    by_text = {str(k): photo for k, photo in photos.items()}
    return by_text.get(str(key).split(" board ")[0])


def escaped(text: str) -> str:
    """Text that matplotlib does not parse as formulas."""
    return text.replace("$", r"\$")


def draw_difference(found: RigDifference) -> Figure:
    """How far two rigs' pixels differ, at the nearest and the farthest depth, and depths by each pair, in percent."""
    panels = []
    for name, camera in found.cameras.items():
        for depth in (camera.depth.min(), camera.depth.max()):
            at = camera.depth == depth
            panels.append((f"{name}, {depth:.3g} m: pixels", camera.x[at], np.linalg.norm(camera.change[at], axis=1)))
    for name, by_pair in found.depths.items():
        for depth in (by_pair.depth.min(), by_pair.depth.max()):
            at = by_pair.depth == depth
            panels.append(
                (f"depth by {found.alpha} and {name}, {depth:.3g} m: %", by_pair.x[at], 100 * by_pair.change[at])
            )
    figure = Figure(figsize=(9, 2.7 * len(panels) / 2), layout="constrained")
    for i, (title, x, values) in enumerate(panels, 1):
        axes: Any = figure.add_subplot(len(panels) // 2, 2, i)
        signed = "%" in title
        most = float(np.nanquantile(np.abs(values), 0.98)) if len(values) else 1.0
        shown = axes.scatter(
            *x.T,
            c=values,
            s=22,
            marker="s",
            cmap="RdBu" if signed else "viridis",
            vmin=-most if signed else 0,
            vmax=most,
        )
        figure.colorbar(shown, ax=axes)
        axes.set_title(escaped(title), fontsize=9)
        axes.set(aspect="equal", xticks=[], yticks=[])
        axes.invert_yaxis()
    return figure
