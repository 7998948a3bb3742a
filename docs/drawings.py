"""The drawings of the concepts page, from the sample array: python docs/drawings.py."""

from __future__ import annotations

from pathlib import Path

import torch
from matplotlib.figure import Figure

from arraygeom import Dense, Epipolar, EpipolarLine, HomographyDisplacement, Local, NearestVoxels, Rectified
from arraygeom.viz import draw_fields, draw_rig, draw_sampling_locations, show_image
from pat.app.sample_array import ALPHA, BETA, SampleArray, load_sample
from pat.media.figures import save_figure

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


def main() -> None:
    """Write them all."""
    array = load_sample()
    x = torch.tensor([[60.0, 60], [150, 90], [330, 210], [420, 60], [520, 320], [600, 200]])
    save_figure(draw_rig(array.rig, alpha=ALPHA), OUT / "rig.png", dpi=80)
    save_figure(draw_fields(array.rig, ALPHA, x, images=array.images), OUT / "segments.jpg", dpi=80)
    save_figure(families(array, x[1::2]), OUT / "families.jpg", dpi=80)


if __name__ == "__main__":
    main()
