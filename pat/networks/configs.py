"""The networks' configurations. Torch is not imported: the command line reads them for its options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class PATConfig:
    """The paper's network by default.

    `betas` is their number, `in_channels` that of each image (an image with fewer is repeated), `dim` the
    width D, `scale` the enlargement s by pixel shuffle. `residual` adds the network's answer to alpha instead
    of replacing it, so that alpha's own detail cannot be lost. `interpolation` is how beta is sampled.

    Where the authors' code has another layout: `block_bias` of residual blocks, `fusion_bias` of the 1x1
    fusion, and `values_after_block`, values made of the features that keys are made of. `normalised` gives
    the features one more channel of every image, its luminance with the mean and the contrast of its
    surroundings taken away: what a grey and a colour camera see alike. `equal_resolution` has betas resized
    to about alpha's angular resolution first.
    """

    betas: int = 1
    in_channels: int = 3
    out_channels: int = 3
    dim: int = 64
    scale: int = 1
    residual: bool = False
    interpolation: Literal["nearest", "bilinear"] = "nearest"
    block_bias: bool = True
    fusion_bias: bool = False
    values_after_block: bool = False
    normalised: bool = False
    equal_resolution: bool = False


@dataclass(frozen=True)
class GuidedPATConfig:
    """Bands of the image; None: all of the betas'.

    `keep_luminance` lets the network add colour to alpha, never luminance. Without `learned` matching is
    classical: semi-global with a left-right check, nothing trained, and no stated certainty.
    """

    bands: int | None = 3
    keep_luminance: bool = True
    learned: bool = True


CONFIGS = {"PAT": PATConfig, "GuidedPAT": GuidedPATConfig}
"""By the name of the network."""
