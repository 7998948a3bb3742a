"""The sample array that ships with the package, and the report on its fusion."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from arraygeom import Rig

from .classical import classical_fusion_calibrated
from .fuse import FusedFrame
from .images import luminance, read_image
from .results import colour_depth, save_panels

SAMPLE = Path(__file__).parent / "sample"
ALPHA, BETA = "mono", "colour"


class SampleArray(NamedTuple):
    """A mono alpha and a colour beta of different focal lengths and poses, and alpha's view in true colour."""

    rig: Rig
    images: dict[str, Tensor]
    truth: Float[Tensor, "3 h w"]


def load_sample() -> SampleArray:
    """The sample array."""
    rig = Rig.load(SAMPLE / "rig.yaml")
    images = {name: read_image(SAMPLE / f"{name}.png") for name in rig.names}
    return SampleArray(rig, {**images, ALPHA: luminance_of(images[ALPHA])}, read_image(SAMPLE / "truth.png"))


def luminance_of(picture: Float[Tensor, "_ h w"]) -> Float[Tensor, "1 h w"]:
    """The picture itself if it is grey, else its luminance."""
    return picture if picture.shape[0] == 1 else luminance(picture)


def classical(rig: Rig, images: dict[str, Tensor], alpha: str, beta: str) -> Float[Tensor, "3 h w"]:
    """The classical baseline on a calibrated pair of a rig, both cameras pinholes."""
    pair = rig.pair(alpha, beta)
    a, b = pair.cameras
    pose = pair.beta_from_alpha
    near, far = (float(d) for d in pair.depth_range)
    return classical_fusion_calibrated(
        luminance_of(images[alpha]), images[beta], a.K, b.K, pose.R, pose.t, depth=(near, far)
    )


def report_figure(sample: SampleArray, baseline: Tensor, frame: FusedFrame, path: Path) -> None:
    """One figure: inputs, the classical baseline, the fusion, ground truth, depth and confidence."""
    panels = {
        "alpha: mono": sample.images[ALPHA],
        "beta: colour": sample.images[BETA],
        "ground truth": sample.truth,
        "classical": baseline,
        "fusion": frame.image,
        "depth (bright is near)": colour_depth(frame.depth),
        "confidence": frame.confidence[None],
        "fusion's error x 5": (frame.image.clamp(0, 1) - sample.truth).abs() * 5,
    }
    save_panels(panels, path, columns=4)
