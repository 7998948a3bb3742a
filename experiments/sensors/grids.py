"""The grid of pixels: cropping, colour filters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom.pixels import HW, shift_matrix
from pat.media.raw import demosaiced
from pat.sensors import Step

Pattern = Literal["RGGB", "GRBG", "BGGR", "GBRG"]
_KORNIA = {"RGGB": "BG", "GRBG": "GB", "BGGR": "RG", "GBRG": "GR"}
"""kornia's names of the patterns. It is imported where it is used: that takes a quarter of a second."""


@dataclass(frozen=True)
class Crop(Step):
    """Only a window of the sensor is read: `hw` from row `top` and column `left` on."""

    top: int
    left: int
    hw: HW

    def pixel_matrix(self, hw: HW) -> Float[Tensor, "3 3"]:
        return shift_matrix(self.left, self.top)

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h2 w2"]:
        """The window. Raises ValueError where it leaves the image."""
        (h, w), (height, width) = self.hw, image.shape[-2:]
        if min(self.top, self.left) < 0 or self.top + h > height or self.left + w > width:
            raise ValueError(
                f"crop: {w}x{h} from ({self.left}, "
                f"{self.top}) leaves the image of {width}x{height}: give a window in it"
            )
        return image[..., self.top : self.top + h, self.left : self.left + w]


@dataclass(frozen=True)
class Mosaic(Step):
    """A Bayer filter: each pixel keeps one of R, G and B. `pattern` is read from the top left, row by row."""

    pattern: Pattern = "RGGB"

    def __post_init__(self) -> None:
        _known(self.pattern)

    def apply(self, image: Float[Tensor, "b 3 h w"], generator: Generator) -> Float[Tensor, "b 1 h w"]:
        """The raw images. Raises ValueError for odd sizes."""
        _even(image)
        from kornia.color import CFA, rgb_to_raw

        return rgb_to_raw(image, CFA[_KORNIA[self.pattern]])


@dataclass(frozen=True)
class Demosaic(Step):
    """Colours from a raw image: bilinear (kornia; differentiable) or edge-aware (as raws are developed).

    The gradient of "edge-aware" is that of "bilinear".
    """

    pattern: Pattern = "RGGB"
    method: Literal["bilinear", "edge-aware"] = "bilinear"

    def __post_init__(self) -> None:
        _known(self.pattern)

    def apply(self, image: Float[Tensor, "b 1 h w"], generator: Generator) -> Float[Tensor, "b 3 h w"]:
        """The images in colour. Raises ValueError for odd sizes."""
        from kornia.color import CFA, raw_to_rgb

        _even(image)
        bilinear = raw_to_rgb(image, CFA[_KORNIA[self.pattern]])
        if self.method == "bilinear":
            return bilinear
        edge_aware = torch.stack([demosaiced(raw, self.pattern) for raw in image.detach()])
        return bilinear + (edge_aware - bilinear).detach()


def _known(pattern: str) -> None:
    if pattern not in _KORNIA:
        raise ValueError(f"a colour filter pattern is one of {', '.join(_KORNIA)}, got '{pattern}'")


def _even(image: Tensor) -> None:
    if image.shape[-2] % 2 or image.shape[-1] % 2:
        raise ValueError(
            f"a colour filter needs even sizes, got {image.shape[-1]}x{image.shape[-2]}: crop first"
        )
