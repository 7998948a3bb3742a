"""The forward model: how a camera records an ideal image.

A chain is a list of steps, applied in order to images (B, C, H, W) with values 0..1 on any device. Light adds up
in linear values only, so a chain for ordinary images begins with `DecodeSRGB()` and ends with `EncodeSRGB()`:

    [DecodeSRGB(), Spectral("luminance"), DiscBlur(1.5), Noise(2000, 5), Clip(), EncodeSRGB(), Quantise(8)]

Steps with randomness draw it from the generator given to `record`, separately for each image of the batch.
Steps that change the pixel grid define `pixel_matrix`; K' = A K with the A that `record` returns, and
`record_array` composes it into the rig.
"""

from .cases import DegradationCase, Pairs, augment, paper_cases
from .chain import LitStep, OpticalImage, Recorded, RecordedArray, Step, generator_for, record, record_array, seed_for
from .electronics import Clip, Exposure, Jitter, Noise, Quantise
from .grids import Crop, Demosaic, Mosaic, Resample
from .noise_level import NoiseLevel
from .optics import BoxBlur, Defocus, DiscBlur, GaussianBlur, MotionBlur, Vignetting, circle_of_confusion
from .recipe import STEPS, read_chain, read_chains
from .spectral import DecodeSRGB, EncodeSRGB, Gamma, Spectral, band_weights, curve_weights

__all__ = [
    "STEPS",
    "BoxBlur",
    "Clip",
    "Crop",
    "DecodeSRGB",
    "Defocus",
    "DegradationCase",
    "Demosaic",
    "DiscBlur",
    "EncodeSRGB",
    "Exposure",
    "Gamma",
    "GaussianBlur",
    "Jitter",
    "LitStep",
    "Mosaic",
    "MotionBlur",
    "Noise",
    "NoiseLevel",
    "OpticalImage",
    "Pairs",
    "Quantise",
    "Recorded",
    "RecordedArray",
    "Resample",
    "Spectral",
    "Step",
    "Vignetting",
    "augment",
    "band_weights",
    "circle_of_confusion",
    "curve_weights",
    "generator_for",
    "paper_cases",
    "read_chain",
    "read_chains",
    "record",
    "record_array",
    "seed_for",
]
