"""More that cameras make of light than training needs: lenses, filters, bands, chains of steps from files.

A chain is a list of steps, applied in order to images (B, C, H, W) with values 0..1. Light adds up in linear
values only, so a chain for ordinary images begins with `DecodeSRGB()` and ends with `EncodeSRGB()`:

    [DecodeSRGB(), Spectral("luminance"), DiscBlur(1.5), Noise(2000, 5), Clip(), EncodeSRGB(), Quantise(8)]

K' = A K with the A that `record` returns, and `record_array` composes it into the rig.
"""

from .chain import LitStep, OpticalImage, Recorded, record, record_array
from .grids import Crop, Demosaic, Mosaic
from .optics import Defocus, DiscBlur, MotionBlur, Vignetting, circle_of_confusion
from .recipe import STEPS, read_chain, read_chains
from .spectral import DecodeSRGB, EncodeSRGB, Exposure, Gamma, Spectral

__all__ = [
    "STEPS",
    "Crop",
    "DecodeSRGB",
    "Defocus",
    "Demosaic",
    "DiscBlur",
    "EncodeSRGB",
    "Exposure",
    "Gamma",
    "LitStep",
    "Mosaic",
    "MotionBlur",
    "OpticalImage",
    "Recorded",
    "Spectral",
    "Vignetting",
    "circle_of_confusion",
    "read_chain",
    "read_chains",
    "record",
    "record_array",
]
