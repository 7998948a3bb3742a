"""What cameras record of ideal images: responses, filters, motion; chains of steps from files.

A chain is a list of steps, applied in order to images (B, C, H, W) with values 0..1. Light adds up in linear
values only, so a chain for ordinary images begins with `DecodeSRGB()` and ends with `EncodeSRGB()`:

    [DecodeSRGB(), Spectral("luminance"), GaussianBlur(1), Noise(2000), Clip(), EncodeSRGB(), Quantise(8)]
"""

from .chain import record_array
from .recipe import STEPS, read_chain, read_chains
from .steps import DecodeSRGB, EncodeSRGB, Exposure, Mosaic, MotionBlur, Spectral

__all__ = [
    "STEPS",
    "DecodeSRGB",
    "EncodeSRGB",
    "Exposure",
    "Mosaic",
    "MotionBlur",
    "Spectral",
    "read_chain",
    "read_chains",
    "record_array",
]
