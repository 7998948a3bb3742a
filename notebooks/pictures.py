"""Pictures of the notebooks: curves and images side by side, sharp on dense displays too.

Figures are shown as SVG, or as PNG where they hold images; importing this module also lets the notebooks find
`experiments`, which lies beside the packages and is not installed with them.
"""

from __future__ import annotations

import csv
import sys
import warnings
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from tempfile import mkdtemp

import torch
from IPython import get_ipython
from IPython.core.pylabtools import print_figure
from IPython.display import Markdown
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.collections import TriMesh
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from arraygeom import Pair, ReceptiveField, Rig
from arraygeom.fields.protocol import sampling_locations
from arraygeom.segments import Segments
from arraygeom.viz import COLOURS, draw_sampling_locations, show_image
from pat.fusion.frame import Frame
from pat.lab.evaluation.tables import markdown_table
from pat.lab.farm.backends import LayeredSettings
from pat.lab.synthesis.blender import RenderSettings, render
from pat.lab.synthesis.check import CheckLimits
from pat.lab.synthesis.rendered import Rendered
from pat.media.colour import exposed, srgb_image
from pat.media.figures import GAP, draw_panels
from pat.media.figures import colour_depth as depth_picture
from pat.media.images import write_image
from pat.support.metrics import score

__all__ = ["depth_picture", "exposed"]

SHOWN, STORED = 640, 760
"""Width of a picture on the page, and the most pixels across that are kept of it."""

sys.path.append(str(Path(__file__).parents[1]))


def panels(images: Mapping[str, Float[Tensor, "_ _ _"]], columns: int = 2) -> Image.Image:
    """Draw images side by side, with their names above them, at whole multiples of their own size."""
    own, most = next(iter(images.values())).shape[-1], STORED // columns - GAP
    across = own * (most // own) if own <= most else most
    return draw_panels(images, columns=columns, width=columns * (across + GAP) / 110)


def curves(x: str, y: str, **lines: tuple[Sequence[float], Sequence[float]]) -> Figure:
    """Draw curves of points (x, y) by name, with the axes' labels; an underscore in a name is a space."""
    figure = Figure(figsize=(5.2, 2.8), layout="constrained")
    axes = figure.subplots()
    for colour, (name, points) in zip(COLOURS, lines.items()):
        axes.plot(*points, "o-", ms=3, color=colour, label=name.replace("_", " "))
    if len(lines) > 1:
        axes.legend(frameon=False)
    axes.set(xlabel=x, ylabel=y)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def locations(
    pair: Pair, image: Tensor, x: Float[Tensor, "n 2"], *fields: ReceptiveField, window: tuple = ()
) -> Figure:
    """Draw where fields sample beta for alpha's pixels, on beta's pale grey image, and count their samples.

    `window` is the part of the image that is shown: left, right, bottom, top, pixels.
    """
    figure = Figure(figsize=(5.2, 3.4), layout="constrained")
    axes = figure.subplots()
    show_image(axes, pair.beta.hw, image.mean(0, keepdim=True) * 0.35 + 0.65)
    for field in fields:
        draw_sampling_locations(axes, field, pair, x)
    if window:
        axes.set(xlim=window[:2], ylim=window[2:])
    else:
        counts = [samples(pair, field, x) for field in fields]
        axes.set_title(f"{', '.join(map(str, counts))} samples a pixel", fontsize=9)
    return figure


def samples(pair: Pair, field: ReceptiveField, x: Float[Tensor, "n 2"]) -> int:
    """Count the samples that a field takes in beta for a pixel of alpha; the most of some pixels."""
    found = sampling_locations(field, pair, x)
    return int(found.length.max()) + 1 if isinstance(found, Segments) else found.xy.shape[-2]


def bars(y: str, rows: Mapping[str, Mapping[str, float]], bottom: float = 0.0) -> Figure:
    """Draw a group of bars for each row, one bar for each of its values, with a legend above."""
    figure = Figure(figsize=(6.4, 2.8), layout="constrained")
    axes = figure.subplots()
    names = list(next(iter(rows.values())))
    for i, (name, colour) in enumerate(zip(names, ("0.6", *COLOURS))):
        places = [k + (i - (len(names) - 1) / 2) * 0.8 / len(names) for k in range(len(rows))]
        axes.bar(places, [row[name] for row in rows.values()], 0.74 / len(names), color=colour, label=name)
    axes.set_xticks(range(len(rows)), list(rows))
    axes.set(ylabel=y, ylim=(bottom, None))
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=len(names), frameon=False, fontsize=8)
    return figure


def table(head: Sequence[str], rows: Mapping[str, Sequence[object]]) -> Markdown:
    """Show rows by name as a table; numbers with two places."""
    lines = [
        [name, *(f"{v:.2f}" if isinstance(v, float) else str(v) for v in row)] for name, row in rows.items()
    ]
    return Markdown(markdown_table(head, lines))


def scores(ground_truth: Float[Tensor, "3 h w"], **images: Frame | Float[Tensor, "_ h w"]) -> Markdown:
    """Show PSNR and SSIM of images or frames by name, against the ground truth."""
    rows = {}
    for name, image in images.items():
        tensor = image.image if isinstance(image, Frame) else image
        found = score(tensor.expand_as(ground_truth).clamp(0, 1), ground_truth)
        rows[name.replace("_", " ")] = (f"{found.psnr:.2f}", f"{found.ssim:.4f}")
    return table(["", "PSNR, dB", "SSIM"], rows)


def sweep(name: str, measure: str) -> Figure:
    """Draw a sweep of the ablation: `measure` is psnr or peaks, a curve each field, 95 % intervals."""
    from experiments.evaluation.sweep_report import draw_sweep, shipped_rows
    from experiments.evaluation.sweeps import SWEEPS

    figure = Figure(figsize=(6.4, 2.8), layout="constrained")
    axes = figure.subplots()
    draw_sweep(axes, [row for row in shipped_rows() if row.sweep == name], measure)
    axes.set(xlabel=SWEEPS[name][0])
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    return figure


def scratch() -> Path:
    """Make a new empty folder for what a notebook writes."""
    return Path(mkdtemp())


def has_blender() -> bool:
    """Tell whether scenes can be rendered."""
    from pat.lab.synthesis.blender.environment import blender_python

    try:
        return bool(blender_python())
    except ValueError:
        return False


def still_lifes(rig: Rig, out: Path, count: int) -> list[Rendered]:
    """Render still lifes for a rig into folders of `out`; without Blender, planes with patterns."""
    from experiments.scenes.still_life import still_life

    for seed in range(count):
        folder = out / f"{seed:06d}"
        if has_blender():
            render(still_life(seed, rig), rig, folder, settings=RenderSettings(width=rig["mono"].hw[1]))
        else:
            LayeredSettings().renderer(rig, CheckLimits())(seed, folder)
    return [Rendered(folder) for folder in sorted(out.iterdir())]


def view(scene: Rendered, camera: str) -> Float[Tensor, "3 h w"]:
    """Return what a camera of a rendered scene sees, as a picture."""
    return srgb_image(scene.frame(camera).rgb)


def photographs(out: Path) -> Path:
    """Write four of scikit-image's photographs into a folder, and return it."""
    from skimage import data

    for name in ("astronaut", "chelsea", "coffee", "rocket"):
        photograph = torch.from_numpy(getattr(data, name)()[..., :3].copy()).movedim(-1, 0) / 255
        write_image(out / f"{name}.png", photograph)
    return out


def losses_of(run: Path) -> list[float]:
    """Return the means of ten successive steps' losses of a training run."""
    rows = list(csv.DictReader((run / "steps.csv").open()))
    return torch.tensor([float(row["loss"]) for row in rows]).unfold(0, 10, 1).mean(1).tolist()


def psnr_column(markdown: str) -> dict[str, float]:
    """Return the first column of a system's table by the method's name."""
    cells = [line.split("|")[1:3] for line in markdown.splitlines() if line.startswith("| ")]
    found = {name.strip(): value.strip() for name, value in reversed(cells)}
    return {name: float(found[name]) for name in ("alpha alone", "classical", "fusion")}


def is_drawing(figure: Figure) -> bool:
    """Tell whether a figure has few lines, points and words only: no images, and no maps in colours."""
    return not any(
        axes.images or any(isinstance(c, TriMesh) or len(c.get_paths()) > 200 for c in axes.collections)
        for axes in figure.axes
    )


def svg(figure: Figure) -> str | None:
    """Return a drawing as SVG; None for one with images."""
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "notebooks"}):
        return print_figure(figure, "svg", metadata={"Date": None}) if is_drawing(figure) else None


def png(figure: Figure) -> tuple[bytes, dict[str, int]] | None:
    """Return a figure with images as PNG, shown at 90 pixels to the inch; None for a drawing."""
    if is_drawing(figure):
        return None
    image = Image.open(BytesIO(print_figure(figure, "png", dpi=120, base64=False)))
    return as_png(image, round(image.width * 90 / 120), Image.Dither.NONE)


def frame_png(frame: Frame) -> tuple[bytes, dict[str, int]]:
    """Return a frame's own picture as `as_png` does."""
    image = Image.open(BytesIO(frame._repr_png_()))
    return as_png(image.resize((STORED, round(image.height * STORED / image.width))))


def as_png(
    image: Image.Image, width: int = SHOWN, dither: Image.Dither = Image.Dither.FLOYDSTEINBERG
) -> tuple[bytes, dict[str, int]]:
    """Return an image as PNG of 256 colours, chosen for it, and the size it is shown with, `width` across.

    Colours are spread over all that occur, so that a small thing keeps its own: a third of a full PNG's size.
    """
    file = BytesIO()
    full = image.convert("RGB")
    palette = full.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=5)
    full.quantize(palette=palette, dither=dither).save(file, "PNG", optimize=True)
    return file.getvalue(), {"width": width, "height": round(image.height * width / image.width)}


def say(message: Warning | str, *_: object) -> None:
    """Print a warning without the place in the notebook's cells."""
    print(f"warning: {message}")


if (shell := get_ipython()) is not None:
    warnings.showwarning = say
    formatters = shell.display_formatter.formatters
    formatters["image/svg+xml"].for_type(Figure, svg)
    formatters["image/png"].for_type(Figure, png)
    formatters["image/png"].for_type(Image.Image, as_png)
    formatters["image/png"].for_type(Frame, frame_png)
    formatters["image/jpeg"].for_type(Image.Image, lambda image: None)
