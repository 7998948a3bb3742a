"""The sample array that ships with the package."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig
from pat.media.colour import luminance_of

from ..media.images import read_image

SAMPLE = Path(__file__).parent / "sample"


ALPHA, BETA = "mono", "colour"


class SampleArray(NamedTuple):
    """A mono alpha and a colour beta of different focal lengths and poses, and alpha's view in true colour."""

    rig: Rig
    images: dict[str, Tensor]
    ground_truth: Float[Tensor, "3 h w"]


def load_sample(folder: Path = SAMPLE) -> SampleArray:
    """The sample array, or another one of a folder with the same files."""
    rig = Rig.load(folder / "rig.yaml")
    images = {name: read_image(folder / f"{name}.png") for name in rig.names}
    return SampleArray(rig, {**images, ALPHA: luminance_of(images[ALPHA])}, read_image(folder / "truth.png"))
