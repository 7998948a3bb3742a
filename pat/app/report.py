"""Web page of a fused frame: one HTML file with everything in it."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, Rig
from arraygeom.runtime.threads import in_parallel
from arraygeom.viz import COLOURS, frustum, frustum_size

from ..fusion.frame import Frame, picture_of
from ..media.colour import to_bytes
from ..media.figures import colour_depth, reduced
from ..media.images import Images
from ..support.memory import how_many_fit

LONGEST = 1600
"""Pixels of the longer side of images in the page, at most."""
QUALITY = 90
"""Quality of JPEG images."""
UNCONFIDENT = (230, 30, 120)
"""Colour that covers pixels without confidence."""
LETTER, LINE = 8.0, 16.0
"""Width of a letter and height of a line of the drawing's labels, in its units."""
PAGE = Path(__file__).with_name("report.html")


class Facts(NamedTuple):
    """Texts and figures for the page of a result.

    Attributes:
        notes: sentences on what was found and corrected.
        warnings: warnings, with advice.
        seconds: duration of the fusion; None if unknown.
        memory: peak memory in bytes; None if unknown.
        unit: unit of depths.
        classical: classical baseline (c, h, w) at alpha's view, as a layer to compare with; None for none.
    """

    notes: Sequence[str] = ()
    warnings: Sequence[str] = ()
    seconds: float | None = None
    memory: float | None = None
    unit: str = "m"
    classical: Float[Tensor, "_ _ _"] | None = None


def report_page(frame: Frame, images: Images, rig: Rig, alpha: str, facts: Facts) -> str:
    """Compose the HTML page of a fused frame: images under a slider, overlays, the rig, figures.

    Args:
        frame: fused frame.
        images: images (c, h, w), values 0..1, of alpha and the betas; shown as a mean unless c is 1 or 3.
        rig: rig of the images, drawn if some depth is known.
        alpha: name of alpha.
        facts: notes, warnings and figures.

    Returns:
        The HTML; images are reduced to `LONGEST` pixels of the longer side.
    """
    layers = {f"alpha: {alpha}": images[alpha]}
    layers |= {f"beta: {name}": images[name] for name in rig.betas(alpha) if name in images}
    if facts.classical is not None:
        layers["classical"] = facts.classical
    layers["fused"] = frame.image
    overlays: dict[str, Callable[[], str]] = {"confidence": lambda: shares_layer(frame.confidence)}
    depths, extent, legend = frame.depth[frame.depth.isfinite()], "", ""
    if len(depths):
        overlays["depth"] = lambda: data_url(colour_depth(frame.depth))
        (near, far), unit = (f"{d:.3g}" for d in np.percentile(depths.cpu().numpy(), (1, 99))), facts.unit
        extent = f"{near} to {far} {unit}, for 98% of the pixels"
        legend = f"depth: near, {near} {unit} <i></i> far, {far} {unit}; unknown is black"
        legend = f'<p class="legend" hidden>{legend}</p>'
    tasks: list[Callable[[], str]] = [
        *(partial(data_url, picture_of(layer)) for layer in layers.values()),
        *overlays.values(),
    ]
    urls = dict(zip((*layers, *overlays), in_parallel(tasks, most=how_many_fit(100 * LONGEST**2))))
    return filled_page(
        f"{' + '.join(name for name in rig.names if name in images)}, fused",
        frame.depth.shape,
        {name: urls[name] for name in layers},
        {name: urls[name] for name in overlays},
        _figures(frame, extent, facts),
        facts,
        RIG=rig_drawing(rig, alpha) if len(depths) else "",
        LEGEND=legend,
    )


def filled_page(
    title: str,
    hw: Sequence[int],
    layers: Mapping[str, str],
    overlays: Mapping[str, str],
    figures: Mapping[str, str],
    facts: Facts,
    **parts: str,
) -> str:
    """Fill the page's template.

    Args:
        title: title of the page.
        hw: height and width of the images.
        layers: URLs of images to compare, by name.
        overlays: URLs of overlays to switch, by name.
        figures: values of the table, by title.
        facts: notes and warnings; the rest is not used.
        parts: "RIG", which is needed, and "LEGEND", both as HTML.

    Returns:
        The HTML, with all texts but URLs and `parts` escaped.
    """
    h, w = hw
    parts = {"LEGEND": "", **parts, "TITLE": html.escape(title), "RATIO": f"calc({w} / {h})"}
    rows = [f"<tr><th>{html.escape(key)}<td>{html.escape(value)}" for key, value in figures.items()]
    parts["FACTS"] = "\n".join(rows)
    parts["WARNINGS"] = _listed("<h2>Warnings</h2>", facts.warnings, kind="warnings")
    folded = _listed("", facts.notes, kind="notes")
    parts["NOTES"] = folded and f"<details><summary>What was found and corrected</summary>{folded}</details>"
    named = {name: html.escape(name) for name in (*layers, *overlays)}
    parts["LAYERS"] = "\n".join(
        f'<img class="layer" data-name="{named[name]}" alt="{named[name]}" src="{url}">'
        for name, url in layers.items()
    )
    parts["OVERLAYS"] = "\n".join(
        f'<img class="overlay" id="{named[name]}" alt="{named[name]}" src="{url}" hidden>'
        for name, url in overlays.items()
    )
    said = {**named, "confidence": "confidence (covered where it is low)"}
    parts["SWITCHES"] = "\n".join(
        f'<label><input type="checkbox" data-overlay="{named[name]}"> {said[name]}</label>'
        for name in overlays
    )
    page = PAGE.read_text(encoding="utf-8")
    return re.sub(r"{{(\w+)}}", lambda match: parts[match[1]], page)  # at once: a name may be as a part's


def rig_drawing(rig: Rig, alpha: str) -> str:
    """Draw the calibrated cameras from above as inline SVG, the world's x to the right and z upwards.

    Args:
        rig: rig of single cameras, not a batch.
        alpha: name of alpha, which is marked.

    Returns:
        The SVG and a line on it, as HTML; empty without a calibrated camera.
    """
    cameras = {name: camera for name, camera in rig.cameras.items() if isinstance(camera, Camera)}
    if not cameras:
        return ""
    size = frustum_size(cameras)
    lines = {n: [line[:, [0, 2]] * (1, -1) for line in frustum(c, size)] for n, c in cameras.items()}
    points = np.concatenate([line for some in lines.values() for line in some])
    low, extent = points.min(0), float(np.ptp(points, axis=0).max()) or 1.0
    drawn, labels = [], list[tuple[float, float, float]]()
    for i, name in enumerate(cameras):
        colour = COLOURS[i % len(COLOURS)]
        shown = [(line - low) / extent * 300 + 30 for line in lines[name]]
        for line in shown:
            text = " ".join(f"{x:.1f},{y:.1f}" for x, y in line)
            drawn.append(f'<polyline points="{text}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        label = name + (" (alpha)" if name == alpha else "")
        (x, y), half = shown[0][0], LETTER * len(label) / 2
        y += LINE
        for left, right, above in sorted(labels, key=lambda place: place[2]):
            if left < x + half and right > x - half and abs(above - y) < LINE:
                y = above + LINE
        labels.append((x - half, x + half, y))
        text = html.escape(label)
        drawn.append(f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" text-anchor="middle">{text}</text>')
    wide, high = np.ptp(points, axis=0) / extent * 300 + 60
    high = max(high, *(y + LINE / 2 for _, _, y in labels))
    return (
        f'<svg viewBox="0 0 {wide:.0f} {high:.0f}" role="img" aria-label="the rig from '
        f'above">{"".join(drawn)}</svg>'
        "<p>The cameras from above, each with the field of view that it has.</p>"
    )


def _figures(frame: Frame, extent: str, facts: Facts) -> dict[str, str]:
    h, w = frame.depth.shape
    figures = {"size": f"{w} x {h} pixels", "mean confidence": f"{float(frame.confidence.mean()):.2f}"}
    figures["confidence above 0.5"] = f"{float((frame.confidence > 0.5).float().mean()):.0%} of the pixels"
    if extent:
        figures["depth"] = extent
    if facts.seconds is not None:
        figures["time"] = f"{facts.seconds:.0f} s"
    if facts.memory is not None:
        figures["memory"] = f"{facts.memory / 2**30:.1f} GiB at most"
    return figures


def data_url(image: Float[Tensor, "c h w"]) -> str:
    """Encode an image of one or three bands as the URL of a JPEG whose longer side is at most `LONGEST`
    pixels."""
    pixels = to_bytes(reduced(image, LONGEST).detach().cpu().expand(3, -1, -1).flip(0)).transpose(1, 2, 0)
    _, content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return f"data:image/jpeg;base64,{base64.b64encode(content.tobytes()).decode()}"


def shares_layer(confidence: Float[Tensor, "h w"]) -> str:
    """Encode a map of 0..1 as the URL of a PNG that covers pixels the more, the lower their value."""
    cover = 1 - reduced(confidence[None].detach().cpu(), LONGEST)
    colour = torch.tensor(UNCONFIDENT[::-1])[:, None, None] / 255
    layers = torch.cat([colour.expand(3, *cover.shape[1:]), 0.85 * cover])
    _, content = cv2.imencode(".png", to_bytes(layers).transpose(1, 2, 0))
    return f"data:image/png;base64,{base64.b64encode(content.tobytes()).decode()}"


def _listed(title: str, lines: Iterable[str], *, kind: str) -> str:
    """Section of the page with a title, as HTML, and a list; empty without lines."""
    items = "".join(f"<li>{html.escape(line)}" for line in lines)
    return f'<section class="{kind}">{title}<ul>{items}</ul></section>' if items else ""
