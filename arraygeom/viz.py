"""Drawings of rigs, fields and residuals. Functions return a figure and show nothing.

Figures are made without pyplot, so there is no global state: `figure.savefig("rig.png")`, or leave the figure
as the last line of a notebook's cell.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle, pairwise
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .camera import Camera
from .epipolar import epipolar_distance, epipolar_lines
from .fields import ReceptiveField, recorded_field
from .fields.protocol import sampling_locations
from .fields.widened import direction
from .pair import Pair
from .pixels import HW
from .rig import Rig
from .runtime.extras import needs
from .runtime.text import length_unit
from .segments import Segments

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c564b", "#5c5c5c")
"""Okabe and Ito's palette, which colour-blind readers can tell apart."""


# The rig in space -------------------------------------------------------------------------------------------


def draw_rig(rig: Rig, *, alpha: str | None = None) -> Figure:
    """Draw a single rig in three dimensions: calibrated cameras' frusta and names, and alpha's depth range.

    Up in the figure is -y of the world.

    Args:
        alpha: camera whose view from near to far is drawn, if it is calibrated; None for the first that is.
            Bounds that would dwarf the rig (beyond 6 times its extent, or infinite) are left out.

    Raises:
        ValueError: if no camera is calibrated, and, in a rig with a depth range, for an unknown alpha.
        ImportError: without matplotlib.
    """
    cameras = calibrated(rig)
    figure = new_figure(figsize=(5.2, 4.6), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d", proj_type="ortho")
    size = frustum_size(cameras)
    middle = fmean(float(camera.centre[0]) for camera in cameras.values())
    for colour, (name, camera) in zip(cycle(COLOURS), cameras.items()):
        for line in frustum(camera, size):
            axes.plot(*_upright(line), color=colour, lw=1.1)
        side = "right" if float(camera.centre[0]) <= middle else "left"
        axes.text(*_upright(numpy(camera.centre)), f" {name} ", color=colour, fontsize=8, ha=side, va="top")
    for line in depth_outline(rig, cameras, alpha):
        axes.plot(*_upright(line), color="0.6", lw=0.8, ls="--")
    _equal_axes(axes)
    unit = length_unit(rig)
    axes.set(xlabel=f"x ({unit})", ylabel=f"z ({unit})", zlabel=f"-y ({unit})")
    axes.tick_params(labelsize=7, pad=-1)
    axes.locator_params(nbins=5)
    axes.view_init(elev=24, azim=-62)
    figure.suptitle(rig.name, fontsize=10)
    return figure


def calibrated(rig: Rig) -> dict[str, Camera]:
    """Return the calibrated cameras of a rig, by name.

    Raises:
        ValueError: if there are none.
    """
    cameras = {n: c for n, c in rig.cameras.items() if isinstance(c, Camera)}
    if not cameras:
        raise ValueError("no camera of this rig is calibrated: there is nothing to draw in space")
    return cameras


def frustum_size(cameras: Mapping[str, Camera]) -> float:
    """Return a length of frusta that suits the distances between the cameras, metres."""
    extent = extent_of(cameras)
    return 0.45 * extent / max(1.0, len(cameras) ** 0.5) if extent > 0 else 0.1


def extent_of(cameras: Mapping[str, Camera]) -> float:
    """Return the largest distance between two cameras, metres."""
    centres = torch.stack([c.centre.detach().double().cpu() for c in cameras.values()])
    return float(torch.cdist(centres, centres).max())


def frustum(camera: Camera, length: float) -> list[np.ndarray]:
    """Return a camera's frustum to a depth: lines from its centre to the image's corners, and the border.

    Returns:
        Four arrays (2, 3) and the border's (65, 3) of world points, metres; see `seen_at` for wide lenses.
    """
    border = seen_at(camera, image_border(camera.hw), length)
    centre = numpy(camera.centre)
    corners = border[:: len(border) // 4][:4]
    return [np.stack([centre, corner]) for corner in corners] + [border]


def depth_outline(rig: Rig, cameras: Mapping[str, Camera], alpha: str | None) -> list[np.ndarray]:
    """Return the lines around alpha's view: borders at near and at far, and edges between them.

    Args:
        cameras: calibrated cameras of the rig.
        alpha: name of alpha; None for the first of `cameras`.

    Returns:
        Arrays (n, 3) of world points, as `seen_at` gives them; none without a depth range, or if alpha is not
        calibrated. A bound beyond 6 times the rig's extent is left out, and the edges then.

    Raises:
        ValueError: for an unknown alpha, if the rig has a depth range.
    """
    if rig.depth is None or (alpha and rig.require(alpha) not in cameras):
        return []
    camera = cameras[alpha or next(iter(cameras))]
    limit = 6 * (extent_of(cameras) or 0.05)
    depths = [float(d) for d in rig.depth if float(d) <= limit]
    borders = [seen_at(camera, image_border(camera.hw), d) for d in depths]
    edges = zip(*(b[:: len(b) // 4][:4] for b in borders)) if len(borders) == 2 else []
    return borders + [np.stack(edge) for edge in edges]


def image_border(hw: HW) -> Float[Tensor, "n 2"]:
    """Return points around an image's area from its first corner back to it, 16 a side, float64 pixels."""
    h, w = hw
    corners = torch.tensor([[0.0, 0], [w, 0], [w, h], [0, h], [0, 0]], dtype=torch.float64) - 0.5
    steps = torch.arange(16, dtype=torch.float64)[:, None] / 16
    sides = [a + steps * (b - a) for a, b in pairwise(corners)]
    return torch.cat([*sides, corners[:1]])


def seen_at(camera: Camera, x: Float[Tensor, "n 2"], depth: float) -> np.ndarray:
    """Compute world points of pixels at a depth.

    Pixels outside the lens model's range are moved towards the mean of all until they are inside, and rays
    more than 53 degrees off axis are cut at 1 / 0.6 of the depth: a fisheye's border would be at infinity.

    Returns:
        Points (n, 3), metres; NaN where the lens has no ray on four fifths of that way.
    """
    camera = camera.to(torch.float64)
    middle = x.mean(0)
    inwards = middle + torch.linspace(1, 0.2, 33).to(x)[:, None, None] * (x - middle)
    rays, valid = camera.rays(inwards)
    outermost = valid.int().argmax(0)[None, :, None].expand(1, -1, 3)
    start, ray = (t.gather(0, outermost)[0] for t in (camera.ray_origins(inwards), rays))
    ray = ray / ray.norm(dim=-1, keepdim=True)
    points = camera.cam_from_world.inverse().apply(start + depth * ray / ray[:, 2:].clamp(min=0.6))
    return numpy(torch.where(valid.any(0)[:, None], points, torch.nan))


# Receptive fields -------------------------------------------------------------------------------------------


def draw_fields(
    rig: Rig,
    alpha: str,
    x: Float[Tensor, "n 2"],
    *,
    field: ReceptiveField | Mapping[str, ReceptiveField] | None = None,
    images: Mapping[str, Any] | None = None,
) -> Figure:
    """Draw alpha's pixels x, and their sampling locations in every beta in the same colours.

    Segments are lines with a dot at their start (near, of a field bounded by depth), positions are dots.

    Args:
        x: pixels of alpha, as the fields take them: by default as recorded.
        field: field of all betas, or fields by name; None, or no field of a beta, for `recorded_field`.
        images: images by camera, as `show_image` takes them; None, or none of a camera, for an empty frame.

    Raises:
        ValueError: for an unknown camera, and as `recorded_field` or the field raises it for a pair.
        ImportError: without matplotlib.
    """
    names = (alpha, *rig.betas(alpha))
    images = images or {}
    figure = new_figure(figsize=_sheet([rig[n].hw for n in names]), layout="constrained")
    for index, name in enumerate(names):
        axes = figure.add_subplot(1, len(names), 1 + index)
        show_image(axes, rig[name].hw, images.get(name))
        axes.set_title(f"{name} (alpha)" if name == alpha else name, fontsize=9)
        if name == alpha:
            axes.scatter(*numpy(x).T, c=_colours(len(x)), s=22, edgecolors="white", linewidths=0.7)
            continue
        pair = rig.pair(alpha, name)
        chosen = field.get(name) if isinstance(field, Mapping) else field
        draw_sampling_locations(axes, chosen or recorded_field(pair), pair, x)
    return figure


def draw_sampling_locations(axes: Axes, field: ReceptiveField, pair: Pair, x: Float[Tensor, "n 2"]) -> None:
    """Draw the sampling locations in beta of some alpha pixels into `axes`, each in its own colour.

    Segments are lines with a dot at their start; positions are dots; invalid ones are left out.

    Raises:
        ValueError: as the field raises it for this pair.
        TypeError: for an object that is no field.
    """
    locations = sampling_locations(field, pair, x)
    for i, colour in enumerate(_colours(len(x))):
        if isinstance(locations, Segments):
            if locations.valid[i]:
                (x0, y0), (x1, y1) = numpy(locations.start[i]), numpy(locations.end[i])
                axes.plot([x0, x1], [y0, y1], color="white", lw=3.0, alpha=0.6, solid_capstyle="round")
                axes.plot([x0, x1], [y0, y1], color=colour, lw=1.6, solid_capstyle="round")
                axes.plot(x0, y0, "o", color=colour, ms=4, mec="white", mew=0.6)
        else:
            axes.scatter(*numpy(locations.xy[i][locations.mask[i]]).T, color=colour, s=1.5, linewidths=0)


# How well it fits -------------------------------------------------------------------------------------------


class NearLine(NamedTuple):
    """Parts of epipolar lines next to points of beta.

    Attributes:
        curve: 65 points along the line (a curve, for lenses), pixels of beta; NaN where its lens ends.
        distance: distance of the point from its line, pixels of beta; 0 where there is no line.
    """

    curve: Float[Tensor, "n p 2"]
    distance: Float[Tensor, " n"]


def near_line(pair: Pair, x: Float[Tensor, "n 2"], y: Float[Tensor, "n 2"], half: float) -> NearLine:
    """Compute the lines of alpha's points x where they pass beta's points y, `half` pixels to each side.

    Returns:
        Curves, and distances to the line's nearest point; all pixels are of images as recorded.

    Raises:
        ValueError: as `Pair.fundamental`.
    """
    F = pair.fundamental.to(torch.float64)
    (x_pinhole, _), (y_pinhole, _) = pair.alpha.undistort(x.double()), pair.beta.undistort(y.double())
    line = epipolar_lines(F, x_pinhole)
    nearest = y_pinhole - epipolar_distance(F, x_pinhole, y_pinhole)[:, None] * direction(line[:, :2])
    along = torch.stack([-line[:, 1], line[:, 0]], -1)
    points = nearest[:, None] + torch.linspace(-half, half, 65).double()[:, None] * direction(along)[:, None]
    curve, valid = pair.beta.distort(points)
    return NearLine(
        torch.where(valid[..., None], curve, torch.nan), (pair.beta.distort(nearest)[0] - y).norm(dim=-1)
    )


def draw_matches(
    rig: Rig,
    alpha: str,
    matches: Mapping[str, tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2"]]],
    images: Mapping[str, Any],
) -> Figure:
    """Draw patches around points matched between alpha and each beta, with the lines that the rig gives.

    Seven matches of each beta at most, spread over the image: above, alpha's patch, 18 pixels to either side
    of the point; below, beta's around the match, with the line of alpha's point and the distance in pixels.

    Args:
        matches: points (x, y) of alpha and of the beta, by beta, in pixels as recorded; at least one, and one
            match of each.
        images: images by camera, as `show_image` takes them; none of a camera for an empty frame.

    Raises:
        ImportError: without matplotlib.
        ValueError: for an unknown camera, no matches, and as `Pair.fundamental`.
    """
    count, half = 7, 18
    _require_matches(*(len(x) for x, _ in matches.values()))
    figure = new_figure(figsize=(1.55 * count, 3.7 * len(matches)), layout="constrained")
    parts: Any = figure.subfigures(len(matches), 1, squeeze=False)
    for row, (subfigure, (name, (x, y))) in enumerate(zip(parts[:, 0], matches.items())):
        near = near_line(rig.pair(alpha, name), x, y, 2 * half)
        chosen = _spread(x, min(count, len(x)))
        factor = max(rig[name].hw) / max(rig[alpha].hw)
        axes = subfigure.subplots(2, count, squeeze=False)
        for blank in axes.flat:
            blank.set_axis_off()
        for column, i in enumerate(chosen):
            _draw_patch(axes[0][column], rig[alpha].hw, images.get(alpha), numpy(x[i]), half)
            below = axes[1][column]
            _draw_patch(below, rig[name].hw, images.get(name), numpy(y[i]), half * factor)
            below.plot(*numpy(near.curve[i]).T, color=COLOURS[1 + row % 7], lw=1.4)
            below.set_title(f"{float(near.distance[i]):.2f} px off", fontsize=9)
        median = float(near.distance.nanmedian())
        subfigure.suptitle(
            f"{alpha} (above) and {name} (below): "
            f"{len(x)} matched points, {median:.2f} px from their lines (median)",
            fontsize=10,
        )
    return figure


def _require_matches(*counts: int) -> None:
    if not min(counts, default=0):
        raise ValueError("no matches to draw: give one or more of each beta")


def _draw_patch(axes: Axes, hw: HW, image: Any, middle: np.ndarray, half: float) -> None:
    """Draw an image around a point, marked by a small cross that does not cover it."""
    show_image(axes, hw, image)
    for span in ([0.12, 0.35], [-0.12, -0.35]):
        ends = np.array(span) * half
        for dx, dy in ((ends, 0 * ends), (0 * ends, ends)):
            axes.plot(middle[0] + dx, middle[1] + dy, color="gold", lw=1.2)
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] + half, middle[1] - half))
    axes.set_axis_on()


def _spread(x: Float[Tensor, "n 2"], count: int) -> list[int]:
    """Indices of points far from each other: each next one is the farthest from those before."""
    chosen = [int((x - x.mean(0)).norm(dim=-1).argmin())]
    while len(chosen) < count:
        chosen.append(int(torch.cdist(x, x[chosen]).amin(1).argmax()))
    return sorted(chosen, key=lambda i: float(x[i, 0]))


def draw_residuals(
    pair: Pair,
    x_alpha: Float[Tensor, "n 2"],
    x_beta: Float[Tensor, "n 2"],
    *,
    image: Any = None,
) -> Figure:
    """Draw measured matches against the geometry: distances from beta's points to their epipolar lines.

    Left, each distance across its line, enlarged if need be so that the median is 2 % of the width; right,
    their histogram.

    Args:
        x_alpha: matches in alpha, one or more, undistorted pixels.
        x_beta: matches in beta, undistorted pixels.
        image: beta's undistorted image, as `show_image` takes it; None for an empty frame.

    Raises:
        ValueError: for no matches, and as `Pair.fundamental`.
        ImportError: without matplotlib.
    """
    with needs("plots", "drawing"):
        from matplotlib.collections import LineCollection
    _require_matches(len(x_alpha))
    line = epipolar_lines(pair.fundamental.to(x_alpha.dtype), x_alpha)
    distance = epipolar_distance(pair.fundamental.to(x_alpha.dtype), x_alpha, x_beta)
    size = distance.abs()
    median = float(size.median())
    magnify = max(1.0, float(np.round(0.02 * pair.beta.hw[1] / max(median, 1e-9), 0)))
    ends = numpy(x_beta - magnify * distance[:, None] * direction(line[:, :2]))
    figure = new_figure(figsize=(8.4, 3.4), layout="constrained")
    axes, histogram = figure.subplots(1, 2, width_ratios=[1.5, 1])
    show_image(axes, pair.beta.hw, image)
    limit = max(float(size.quantile(0.95)), 1e-9)
    arrows = LineCollection(
        list(np.stack([numpy(x_beta), ends], 1)),
        array=numpy(size),
        cmap="viridis",
        clim=(0, limit),
        linewidths=1.3,
    )
    axes.add_collection(arrows)
    axes.set_title(f"distance to the epipolar line, {magnify:g} times as long", fontsize=9)
    figure.colorbar(arrows, ax=axes, label="pixels", shrink=0.85)
    histogram.hist(numpy(distance.clamp(-2 * limit, 2 * limit)), bins=41, color=COLOURS[0])
    histogram.set_title(f"{len(distance)} matches, median {median:.2f} px", fontsize=9)
    histogram.set(xlabel="signed distance (pixels)", ylabel="matches")
    histogram.spines[["top", "right"]].set_visible(False)
    return figure


# Shared -----------------------------------------------------------------------------------------------------


def new_figure(**options: Any) -> Figure:
    """Make a matplotlib figure outside pyplot.

    Raises:
        ImportError: without matplotlib.
    """
    with needs("plots", "drawing"):
        from matplotlib.figure import Figure
    return Figure(**options)


def show_image(axes: Axes, hw: HW, image: Any = None) -> None:
    """Show an image, or an empty frame of its size, in `axes`, with pixel centres at whole numbers.

    Args:
        hw: height and width of the frame; an image of another size is not refused.
        image: tensor or array (H, W), (H, W, 1 or 3; 4 with opacity) or (1 or 3, H, W); None for the frame
            alone. Floats are 0 to 1, integers up to their type's largest.

    Raises:
        TypeError: for an image of another shape.
    """
    h, w = hw
    if image is not None:
        pixels = np.asarray(image.detach().cpu() if isinstance(image, Tensor) else image)
        pixels = pixels.transpose(1, 2, 0) if pixels.ndim == 3 and pixels.shape[0] in (1, 3) else pixels
        white = np.iinfo(pixels.dtype).max if np.issubdtype(pixels.dtype, np.integer) else 1
        grey = pixels.ndim == 3 and pixels.shape[-1] == 1
        options: dict[str, Any] = {"cmap": "gray", "interpolation": "antialiased", "aspect": "equal"}
        axes.imshow((pixels[..., 0] if grey else pixels) / np.float32(white), vmin=0, vmax=1, **options)
    axes.set(xlim=(-0.5, w - 0.5), ylim=(h - 0.5, -0.5), aspect="equal", xticks=[], yticks=[])
    axes.set_facecolor("0.94")


def numpy(x: Tensor) -> np.ndarray:
    """Return a tensor's values as float64 array, without gradient, on the CPU."""
    return x.detach().cpu().double().numpy()


def _sheet(sizes: list[HW], height: float = 2.6) -> tuple[float, float]:
    """Size of a figure in inches for images side by side, at most 16 wide."""
    width = sum(height * w / h for h, w in sizes)
    shrink = min(1.0, 16 / width)
    return width * shrink, height * shrink + 0.3


def _colours(n: int) -> list[Any]:
    if n <= len(COLOURS):
        return list(COLOURS[:n])
    from matplotlib import colormaps

    return list(colormaps["turbo"](np.linspace(0.05, 0.95, n)))


def _upright(X: np.ndarray) -> np.ndarray:
    """Convert world axes (x, y down, z ahead) to the figure's (x, z, up)."""
    x, y, z = np.moveaxis(X, -1, 0)
    return np.stack([x, z, -y])


def _equal_axes(axes: Any) -> None:
    """Scale all axes alike."""
    limits = np.array([getattr(axes, f"get_{a}lim")() for a in "xyz"])
    spans = np.maximum(np.diff(limits)[:, 0], 0.35 * np.diff(limits).max())
    middles = limits.mean(1)
    for a, middle, span in zip("xyz", middles, spans):
        getattr(axes, f"set_{a}lim")(middle - span / 2, middle + span / 2)
    axes.set_box_aspect(spans, zoom=0.95)
