"""Two cameras before layered photographs: harder than the sample array, on which bounds were set."""

from pathlib import Path

from pat.app.sample_array import ALPHA, BETA, SampleArray
from pat.app.sample_array import load_sample as load

__all__ = ["ALPHA", "BETA", "load_sample", "middle_of_sample"]


def load_sample() -> SampleArray:
    """The array, in place of the package's."""
    return load(Path(__file__).parent / "layered")


def middle_of_sample() -> SampleArray:
    """The middle of alpha's view of it, a fifth, and what beta sees of that."""
    sample = load_sample()
    window, of_beta = (..., slice(104, 296), slice(192, 448)), (..., slice(84, 300), slice(130, 418))
    rig = sample.rig.crop(ALPHA, 104, 192, (192, 256)).crop(BETA, 84, 130, (216, 288))
    images = {ALPHA: sample.images[ALPHA][window], BETA: sample.images[BETA][of_beta]}
    return SampleArray(rig, images, sample.ground_truth[window])
