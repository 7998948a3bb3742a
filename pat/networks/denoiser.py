"""Networks removing noise of a known level: from one image, and from a fused one with every view's help."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, pad, pixel_shuffle, pixel_unshuffle

from ..media.colour import OPPONENT
from ..support.settings import size, tuned
from .guided import UNet


@dataclass(frozen=True)
class DenoiserSettings:
    """Of what the denoisers are given."""

    multiple: int = size(8, "Images are padded to multiples of this")
    scale: float = size(
        4.0,
        "Deviations and differences are given to networks this many times larger: "
        "then they are about as large as values",
    )
    blur: int = tuned(2, "Source not recorded: radius of the blur of colour differences, pixels")
    colour_noise: float = tuned(
        0.02, "Source not recorded: the deviation at which half of that blur is taken"
    )


SETTINGS = DenoiserSettings()


@dataclass(frozen=True)
class DenoiserConfig:
    """Widths at 1/2, 1/4 and 1/8 size: the networks' for one band, for three, and for the fused image."""

    band: tuple[int, int, int] = (24, 32, 32)
    colour: tuple[int, int, int] = (32, 32, 32)
    fused: tuple[int, int, int] = (32, 40, 48)


class NoisyView(NamedTuple):
    """A view as recorded, without its noise, and the noise's standard deviation; each (B, C, H, W)."""

    recorded: Tensor
    denoised: Tensor
    deviation: Tensor

    @property
    def removed(self) -> Tensor:
        """What was taken for noise."""
        return self.recorded - self.denoised


class Denoising(nn.Module):
    """An image minus its noise, estimated in units of a standard deviation: at 0 it stays as it is."""

    def __init__(self, bands: int, widths: tuple[int, int, int], *, further: int = 0) -> None:
        super().__init__()
        self.network = UNet(4 * (2 * bands + further), widths, 4 * bands)
        nn.init.zeros_(self.network.last.weight)

    def forward(
        self,
        image: Float[Tensor, "b c h w"],
        deviation: Float[Tensor, "b c h w"],
        *further: Float[Tensor, "b _ h w"],
    ) -> Float[Tensor, "b c h w"]:
        """Of any size; `further` are other images of the same pixels."""
        h, w = image.shape[-2:]
        given = torch.cat([image - 0.5, SETTINGS.scale * deviation, *further], 1)
        given = pad(given, (0, -w % SETTINGS.multiple, 0, -h % SETTINGS.multiple), mode="replicate")
        noise = pixel_shuffle(self.network(pixel_unshuffle(given, 2)).float(), 2)[..., :h, :w]
        return image - deviation * noise


class ColourDenoising(nn.Module):
    """A colour image minus its noise, by brightness and two colour differences, on orthogonal axes.

    Brightness loses noise that the network estimates, as in `Denoising`. Colour differences are first
    blurred, the more the noisier they are, and the network adds what that took: most of it is known from
    brightness, and a network this small need not hold the noise of every band.
    """

    def __init__(self, widths: tuple[int, int, int]) -> None:
        super().__init__()
        self.network = UNet(4 * 3 + 3 + 2, widths, 4 * 3)
        nn.init.zeros_(self.network.last.weight)

    def forward(
        self, image: Float[Tensor, "b 3 h w"], deviation: Float[Tensor, "b 3 h w"]
    ) -> Float[Tensor, "b 3 h w"]:
        """Of any size."""
        h, w = image.shape[-2:]
        enough = (0, -w % SETTINGS.multiple, 0, -h % SETTINGS.multiple)
        bands = pad(opponent(image - 0.5), enough, mode="replicate")
        noise = pad(opponent_deviation(deviation), enough, mode="replicate")
        blurred = avg_pool2d(pad(bands, (SETTINGS.blur,) * 4, mode="replicate"), 2 * SETTINGS.blur + 1, 1)
        share = noise.square() / (noise.square() + SETTINGS.colour_noise**2)
        share = torch.cat([torch.zeros_like(share[:, :1]), share[:, 1:]], 1)
        base = torch.lerp(bands, blurred, share)
        given = pixel_unshuffle(bands, 2), SETTINGS.scale * avg_pool2d(noise, 2), avg_pool2d(bands[:, 1:], 2)
        found = pixel_shuffle(self.network(torch.cat(given, 1)).float(), 2)
        return 0.5 + rgb_of_opponent(base - noise * found)[..., :h, :w]


def opponent(rgb: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Brightness and two colour differences, on orthogonal axes of unit length."""
    return torch.einsum("ij,bjhw->bihw", rgb.new_tensor(OPPONENT), rgb)


def opponent_deviation(deviation: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """The standard deviation of `opponent` bands from those of independent red, green and blue."""
    return torch.einsum("ij,bjhw->bihw", deviation.new_tensor(OPPONENT).square(), deviation.square()).sqrt()


def rgb_of_opponent(bands: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """The inverse of `opponent`."""
    return torch.einsum("ji,bjhw->bihw", bands.new_tensor(OPPONENT), bands)


class LowLightNetwork(nn.Module):
    """Denoisers of one band, of a colour image, and of a fused image."""

    def __init__(self, config: DenoiserConfig = DenoiserConfig()) -> None:
        super().__init__()
        self.config = config
        self.band = Denoising(1, config.band)
        self.colour = ColourDenoising(config.colour)
        self.fused = Denoising(3, config.fused, further=9)

    def forward(
        self,
        image: Float[Tensor, "b 3 h w"],
        alpha: NoisyView,
        beta: NoisyView,
        confidence: Float[Tensor, "b 1 h w"],
    ) -> Float[Tensor, "b 3 h w"]:
        """The image fused from denoised views, corrected by both views as they were recorded.

        `beta` is warped to alpha's pixels: right where the confidence is high.
        """
        gain = _gain(beta.denoised, image, confidence)
        difference, removed = gain * beta.denoised - image, gain * beta.removed
        deviation = (alpha.deviation + gain * beta.deviation) / 2
        seen = [SETTINGS.scale * x for x in (alpha.removed, alpha.deviation, difference, removed)]
        return self.fused(image, deviation, *seen, confidence)


def over_flips(network: Callable[..., Tensor], *images: Float[Tensor, "b _ h w"]) -> Tensor:
    """The mean of a network's results on images as they are and flipped: its own errors average out."""
    total: Tensor | float = 0.0
    for axes in ((), (-1,), (-2,), (-2, -1)):
        total = total + network(*(image.flip(axes) for image in images)).flip(axes)
    return torch.as_tensor(total) / 4


def _gain(image: Tensor, like: Tensor, weight: Tensor) -> Tensor:
    """The factor (B, 1, 1, 1) that makes an image about as bright as another."""
    product, square = ((weight * image * other).flatten(1).sum(1) for other in (like, image))
    return ((product + 1e-3) / (square + 1e-3)).clamp(0.2, 5.0)[:, None, None, None]
