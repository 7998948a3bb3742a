"""The drawings of the pages and the figures of README: python docs/drawings.py [--only NAME]."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from arraygeom import (
    Dense,
    Epipolar,
    EpipolarLine,
    HomographyDisplacement,
    Local,
    NearestVoxels,
    Rectified,
)
from arraygeom.runtime.atomic import write_atomically
from arraygeom.viz import draw_fields, draw_rig, draw_sampling_locations, show_image
from pat import FuseSettings, fuse
from pat.app.cli.parser import script
from pat.app.demo import as_real_cameras
from pat.app.sample_array import ALPHA, BETA, SampleArray, load_sample
from pat.media.colour import to_bytes
from pat.media.figures import colour_depth, save_figure

OUT = Path(__file__).parent / "drawings"
FAMILIES = {
    "Epipolar": Epipolar(),
    "EpipolarLine": EpipolarLine(),
    "HomographyDisplacement(15)": HomographyDisplacement(15.0),
    "NearestVoxels(96, 40)": NearestVoxels(96, 40),
    "Rectified(40)": Rectified(40, alpha_is="either"),
    "Local(9, spacing=3)": Local(9, spacing=3.0),
    "Dense(12)": Dense(12),
}


WIDE, GAP = 902, 8
"""Width of the fused image in figures of two in and one out, and the space between images, pixels."""


def table() -> Image.Image:
    """Two in, one out, with depth: the sample array, in low light."""
    array, noise = as_real_cameras(load_sample())
    frame = fuse(array.images, array.rig, alpha=ALPHA, settings=FuseSettings(noise=noise))
    words = {
        "in: a mono camera, in low light": array.images[ALPHA],
        "in: a wide colour camera, in low light": array.images[BETA],
        "out: the mono camera's view, fused": frame.image,
    }
    return two_in_one_out(words, depth=colour_depth(frame.depth))


def two_in_one_out(words: dict[str, Tensor], depth: Tensor | None = None) -> Image.Image:
    """Draw two images above each other, a large one beside them, depth in its corner, words on all."""
    first, _, fused = words.values()
    high = round(WIDE * fused.shape[-2] / fused.shape[-1])
    above = (high - GAP) // 2
    beside = round(above * first.shape[-1] / first.shape[-2])
    drawn = Image.new("RGB", (beside + GAP + WIDE, high), "white")
    boxes = [(0, 0, beside, above), (0, high - above, beside, above), (beside + GAP, 0, WIDE, high)]
    for (word, image), box in zip(words.items(), boxes):
        paste(drawn, image, box, word)
    if depth is not None:
        wide, margin = WIDE // 4, 12
        inset = round(wide * fused.shape[-2] / fused.shape[-1])
        at = (drawn.width - wide - margin, high - inset - margin)
        drawn.paste("white", (at[0] - 2, at[1] - 2, at[0] + wide + 2, at[1] + inset + 2))
        paste(drawn, depth, (*at, wide, inset), "out: depth, red is near")
    return drawn


def paste(drawn: Image.Image, image: Tensor, box: tuple[int, int, int, int], word: str) -> None:
    """Put an image into a box (left, top, width, height), cut to its shape, with a word in its corner."""
    left, top, width, height = box
    pixels = to_bytes(image.clamp(0, 1).expand(3, -1, -1)).transpose(1, 2, 0)
    picture = Image.fromarray(pixels)
    factor = max(width / picture.width, height / picture.height)
    size = round(factor * picture.width), round(factor * picture.height)
    picture = picture.resize(size, Image.Resampling.LANCZOS)
    x, y = (size[0] - width) // 2, (size[1] - height) // 2
    drawn.paste(picture.crop((x, y, x + width, y + height)), (left, top))
    font = ImageFont.load_default(20 if width > WIDE / 2 else 16)
    text = ImageDraw.Draw(drawn, "RGBA")
    end = left + 16 + text.textlength(word, font)
    text.rectangle((left, top, end, top + font.size + 12), (0, 0, 0, 150))
    text.text((left + 8, top + 5), word, "white", font)


def save(image: Image.Image, name: str) -> None:
    """Write an image as JPEG, atomically."""
    with write_atomically(OUT / name) as temporary:
        image.save(temporary, "JPEG", quality=92, subsampling=0)


def families(array: SampleArray, x: torch.Tensor) -> Figure:
    """Each family's answer for the same pixels, on the pale image of beta."""
    pair = array.rig.pair(ALPHA, BETA)
    figure = Figure(figsize=(11, 5), layout="constrained")
    for axes, (name, field) in zip(figure.subplots(2, 4).flat, [("alpha's pixels", None), *FAMILIES.items()]):
        if field is None:
            show_image(axes, pair.alpha.hw, array.images[ALPHA] * 0.5 + 0.5)
            for pixel in x:
                axes.plot(*pixel.tolist(), "o", ms=6)
        else:
            show_image(axes, pair.beta.hw, array.images[BETA] * 0.4 + 0.6)
            draw_sampling_locations(axes, field, pair, x)
        axes.set_title(name, fontsize=9)
    return figure


@dataclass
class Drawings:
    """Draw the documentation's pictures into docs/drawings."""

    only: str | None = None
    """One of table, rig, segments, families."""

    def run(self) -> None:
        """Write them. Raises ValueError for a name that is none."""
        array = load_sample()
        x = torch.tensor([[60.0, 60], [150, 90], [330, 210], [420, 60], [520, 320], [600, 200]])
        drawings = {
            "table": lambda: save(table(), "table.jpg"),
            "rig": lambda: save_figure(draw_rig(array.rig, alpha=ALPHA), OUT / "rig.png", dpi=80),
            "segments": lambda: save_figure(
                draw_fields(array.rig, ALPHA, x, images=array.images), OUT / "segments.jpg", dpi=80
            ),
            "families": lambda: save_figure(families(array, x[1::2]), OUT / "families.jpg", dpi=80),
        }
        if self.only not in {None, *drawings}:
            raise ValueError(f"--only: expected one of {', '.join(drawings)}, got {self.only}")
        for name, draw in drawings.items():
            if self.only in (None, name):
                draw()


if __name__ == "__main__":
    script(Drawings).run()
