"""An array of two cameras before layered photographs: harder than the sample array, on which bounds were set."""

from pathlib import Path

from pat.data.sample_array import ALPHA, BETA, SampleArray
from pat.data.sample_array import load_sample as load

__all__ = ["ALPHA", "BETA", "load_sample"]


def load_sample() -> SampleArray:
    """The array, in place of the package's."""
    return load(Path(__file__).parent / "layered")
