"""Figures of samples: recorded images of a patch, search segments of some pixels, ground truth and depth."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from arraygeom.fields import recorded_field
from arraygeom.viz import COLOURS, draw_sampling_locations, numpy, show_image
from pat.media.figures import colour_depth

from .dataset import Patch

SHOWN = 6
"""Pixels of alpha whose fields are drawn."""


def draw_patches(patches: Sequence[Patch]) -> Figure:
    """One line for each patch: alpha and betas as recorded with a few pixels' fields, ground truth, depth."""
    columns = len(patches[0].images) + 2
    h, w = patches[0].ground_truth.shape[-2:]
    figure = Figure(figsize=(3.2 * columns, (3.2 * h / w + 0.35) * len(patches)), layout="constrained")
    for row, patch in enumerate(patches):
        x = _pixels(patch.rig[patch.alpha].hw)
        further = ("ground truth", patch.ground_truth), ("depth", colour_depth(patch.depth))
        for column, (name, image) in enumerate([*patch.images.items(), *further]):
            axes = figure.add_subplot(len(patches), columns, row * columns + column + 1)
            show_image(axes, (image.shape[-2], image.shape[-1]), image.expand(3, -1, -1).clamp(0, 1))
            axes.set_title(f"{name} (alpha)" if column == 0 else name, fontsize=8)
            if column == 0:
                axes.scatter(*numpy(x).T, c=COLOURS[: len(x)], s=18, edgecolors="white", linewidths=0.6)
            elif column < len(patch.images):
                pair = patch.rig.pair(patch.alpha, name)
                draw_sampling_locations(axes, recorded_field(pair), pair, x)
    return figure


def _pixels(hw: tuple[int, int]) -> Float[Tensor, "n 2"]:
    """A few pixels all over an image, in a zigzag."""
    across = (torch.arange(SHOWN) + 0.5) / SHOWN * hw[1]
    down = torch.tensor([0.25, 0.75]).repeat(SHOWN)[:SHOWN] * hw[0]
    return torch.stack([across, down], -1).floor()
