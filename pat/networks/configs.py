"""Configurations of the networks. Torch is not imported: the command line reads them for its options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class PATConfig:
    """Configuration of PAT; the default is the paper's network. Values are not checked here.

    Attributes:
        betas: number of betas.
        in_channels: number of channels of each image; an image of one channel is repeated.
        out_channels: number of bands of the fused image.
        dim: width D of the features.
        scale: enlargement s by pixel shuffle.
        residual: True to add the network's output to alpha (of one channel or `out_channels`) in place of
            replacing it, so that alpha's own detail cannot be lost.
        interpolation: interpolation of beta's samples.
        block_bias: True for biases in residual blocks, which the authors' code has not.
        fusion_bias: True for a bias of the 1x1 fusion, as the authors' code has.
        values_after_block: True for values computed from the features of the keys, as in the authors' code.
        normalised: True for one more input channel of every image: the mean of its channels, without mean
            and contrast of its surroundings, which a grey and a colour camera see alike.
        equal_resolution: True if `fuse` resizes betas to about alpha's angular resolution first.
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
    """Configuration of GuidedPAT. Values are not checked here.

    Attributes:
        bands: number of bands of the fused image; None for all bands of the betas.
        keep_luminance: True if alpha gets the betas' colour without its luminance (Rec. 601; without the
            share `Inputs.luminance` of it), which needs three bands; without `bands` it has no effect.
        learned: True for matching with trained networks; False for classical matching, semi-global with a
            left-right check, whose confidence is 0 or 1.
    """

    bands: int | None = 3
    keep_luminance: bool = True
    learned: bool = True


CONFIGS = {"PAT": PATConfig, "GuidedPAT": GuidedPATConfig}
"""Class of the configuration by name of the network."""
