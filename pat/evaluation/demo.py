"""The figure of the sample array's fusion."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from ..data.sample_array import ALPHA, BETA, SampleArray
from ..fusion.results import Frame
from ..media.figures import colour_depth, save_panels


def save_demo_figure(sample: SampleArray, baseline: Tensor, frame: Frame, path: Path) -> None:
    """One figure: inputs, the classical baseline, the fusion, ground truth, depth and confidence."""
    panels = {
        "alpha: mono": sample.images[ALPHA],
        "beta: colour": sample.images[BETA],
        "ground truth": sample.ground_truth,
        "classical": baseline,
        "fusion": frame.image,
        "depth (red is near)": colour_depth(frame.depth),
        "confidence": frame.confidence[None],
        "fusion's error x 5": (frame.image.clamp(0, 1) - sample.ground_truth).abs() * 5,
    }
    save_panels(panels, path, columns=4)
