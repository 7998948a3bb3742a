"""Networks that remove noise of a known level from an image."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad, pixel_shuffle, pixel_unshuffle

from ..media.colour import OPPONENT
from ..support.blocks import UNet, channels_last
from ..support.settings import size


@dataclass(frozen=True)
class DenoiserSettings:
    """Settings of the denoisers' inputs.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    multiple: int = size(8, "Images are padded to multiples of this")
    scale: float = size(4.0, "So many times larger deviations are given to networks: about as values")


SETTINGS = DenoiserSettings()


@dataclass(frozen=True)
class DenoiserConfig:
    """Configuration of the denoisers' U-Nets.

    Attributes:
        widths: channels at 1/2, 1/4 and 1/8 size.
        blocks: number of residual blocks, as for `UNet`.
    """

    widths: tuple[int, int, int] = (48, 96, 128)
    blocks: int = 2


class Denoising(nn.Module):
    """Network that estimates noise in units of its standard deviation, and subtracts it.

    Made with random weights. Where the deviation is 0 an image stays as it is.

    Args:
        bands: number of channels of an image.
        config: widths and depth of the U-Net.
    """

    def __init__(self, bands: int, config: DenoiserConfig) -> None:
        super().__init__()
        self.network = UNet(8 * bands, config.widths, 4 * bands, blocks=config.blocks)
        nn.init.zeros_(self.network.last.weight)

    def forward(
        self, image: Float[Tensor, "b c h w"], deviation: Float[Tensor, "b c h w"]
    ) -> Float[Tensor, "b c h w"]:
        """Denoise images of any size.

        Args:
            image: noisy images, values 0..1, of `bands` channels and the weights' type; torch refuses others.
            deviation: standard deviation of each value's noise.

        Returns:
            Images of the same shape, not clipped; differentiable.
        """
        h, w = image.shape[-2:]
        inputs = torch.cat([image - 0.5, SETTINGS.scale * deviation], 1)
        inputs = pad(inputs, (0, -w % SETTINGS.multiple, 0, -h % SETTINGS.multiple), mode="replicate")
        noise = pixel_shuffle(self.network(channels_last(pixel_unshuffle(inputs, 2))).float(), 2)[..., :h, :w]
        return image - deviation * noise


def opponent(rgb: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Compute brightness and two colour differences, on orthogonal axes of unit length."""
    return torch.einsum("ij,bjhw->bihw", rgb.new_tensor(OPPONENT), rgb)


def opponent_deviation(deviation: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Compute the standard deviation of `opponent` bands from those of independent red, green and blue."""
    return torch.einsum("ij,bjhw->bihw", deviation.new_tensor(OPPONENT).square(), deviation.square()).sqrt()


def rgb_of_opponent(bands: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Compute red, green and blue from `opponent` bands: its inverse."""
    return torch.einsum("ji,bjhw->bihw", bands.new_tensor(OPPONENT), bands)


class LowLightNetwork(nn.Module):
    """Denoisers of images of one band and of three, with random weights; it is not called itself.

    Attributes:
        config: size of the networks.
        band: `Denoising` of each band by itself, (b, 1, h, w).
        colour: `Denoising` of RGB images.
    """

    def __init__(self, config: DenoiserConfig = DenoiserConfig()) -> None:
        super().__init__()
        self.config = config
        self.band, self.colour = (Denoising(bands, config) for bands in (1, 3))
