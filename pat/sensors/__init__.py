"""Forward model: the steps by which a camera records an ideal image.

A list of steps is applied in order to images (B, C, H, W) with values 0..1, on any device. Random steps draw
from the generator given to `record`, separately for each image of the batch.
"""

from .noise_level import NoiseLevel
from .steps import (
    BoxBlur,
    Clip,
    GaussianBlur,
    Jitter,
    Noise,
    Quantise,
    Resample,
    Step,
    augment,
    generator_for,
    record,
    seed_for,
)

__all__ = [
    "BoxBlur",
    "Clip",
    "GaussianBlur",
    "Jitter",
    "Noise",
    "NoiseLevel",
    "Quantise",
    "Resample",
    "Step",
    "augment",
    "generator_for",
    "record",
    "seed_for",
]
