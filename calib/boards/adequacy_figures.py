"""Figures of a camera's adequacy, and of the images that fit worst."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from arraygeom.viz import COLOURS

from .adequacy import half_difference, intrinsics_of, uncertainty
from .intrinsics import BoardViews
from .photos import FrameKey, Photos
from .rig import Calibration
from .validation import frame_rms, misfits

THUMBNAIL = 480
"""Width of a drawn image, pixels."""
DRAWN = 6
"""Images drawn at most."""


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
        if name in halves:
            x, off = halves[name]
            length = np.linalg.norm(off, axis=1)
            _map(row[2], figure, known.camera.hw, x, length, f"{name}: halves of the frames")
            row[2].quiver(*x[::3].T, *off[::3].T, angles="xy", color="white", width=0.003)
        else:
            row[2].set_axis_off()
            row[2].set_title("too few frames to compare halves", fontsize=9)
    return figure


def _map(axes: Any, figure: Figure, hw: tuple[int, int], x: np.ndarray, value: np.ndarray, title: str) -> None:
    drawn = axes.tripcolor(*x.T, np.maximum(value, 1e-4), shading="gouraud", cmap="viridis", norm=LogNorm())
    axes.set(xlim=(0, hw[1]), ylim=(hw[0], 0), aspect="equal", xticks=[], yticks=[])
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
    found = [(m.camera, calibration.frames[m.block]) for m in misfits(calibration.fit)]
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
        text += f", {frame_rms(calibration.fit.problem)[name][block]:.2f} px"
    axes.set_title(escaped(text), fontsize=9)


def _photo(photos: Mapping[FrameKey, Any], key: FrameKey) -> Any | None:
    """The image of a view, which may be of one of several boards in it."""
    by_text = {str(k): photo for k, photo in photos.items()}
    return by_text.get(str(key).split(" board ")[0])


def escaped(text: str) -> str:
    """Text that matplotlib does not parse as formulas."""
    return text.replace("$", r"\$")
