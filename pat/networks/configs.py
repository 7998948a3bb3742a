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
    """Widths of the features at 1/2, 1/4, 1/8 and 1/16 of the size, of the keys, and of the judgement.

    Attention reaches `window` pixels to either side of the match, with `taps` samples. Colour is propagated
    within alpha in one round for each of `propagation_steps`, the spacing of 7 x 7 pixels at 1/4.
    `keep_luminance` lets the network add colour to alpha, never luminance. `completion` has widths at 1/2,
    1/4 and 1/8, of what completes colours in the end; none without such a part.
    """

    widths: tuple[int, int, int, int] = (16, 32, 40, 48)
    fine_dim: int = 8
    window: float = 3.0
    taps: int = 13
    judge_dim: int = 16
    confidence_dim: int = 24
    propagation_dim: int = 8
    propagation_steps: tuple[int, ...] = (1, 3, 8)
    bands: int = 3
    keep_luminance: bool = True
    completion: tuple[int, ...] = ()


@dataclass(frozen=True)
class BandwisePATConfig(GuidedPATConfig):
    """GuidedPAT's, for one band, which need not have alpha's luminance."""

    bands: int = 1
    keep_luminance: bool = False

    def __post_init__(self) -> None:
        if self.bands != 1 or self.keep_luminance:
            raise ValueError(
                "BandwisePAT fuses one band at a time: leave bands at 1 and keep_luminance at false"
            )


CONFIGS = {"PAT": PATConfig, "GuidedPAT": GuidedPATConfig, "BandwisePAT": BandwisePATConfig}
"""By the name of the network."""
