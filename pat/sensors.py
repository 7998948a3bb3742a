"""The forward model: what becomes of an ideal picture until a camera has recorded it.

A chain is a list of steps, applied in order to pictures (B, C, H, W) with values 0..1 on any device. Light adds up
in linear values only, so a chain for ordinary pictures begins with `Linear()` and ends with `Coded()`:

    [Linear(), Spectral("luminance"), Disc(1.5), Resample(0.5), Noise(2000, 5), Clip(), Coded(), Quantise(8)]

Steps with randomness draw it from the generator given to `record`, separately for each picture of the batch.
Steps that change the pixel grid say how through `pixel_matrix`; K' = A K with the A that `record` returns.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor
from torch.nn.functional import conv2d, interpolate, pad

from arraygeom.pixels import HW, resize_matrix
from arraygeom.sensor import Band

_RGB_NANOMETRES = (600.0, 540.0, 460.0)
_RGB_SIGMA = 35.0
_REC601 = (0.299, 0.587, 0.114)


class Step(ABC):
    """One thing that happens to a picture. Subclasses say what in `apply`."""

    @abstractmethod
    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c2 h2 w2"]:
        """The pictures afterwards."""

    def pixel_matrix(self, hw: HW) -> Float[Tensor, "3 3"]:
        """A with x_after ~ A x_before for a picture of height and width `hw`."""
        return torch.eye(3, dtype=torch.float64)


class Recorded(NamedTuple):
    """Pictures after a chain, and A with x_after ~ A x_before (float64)."""

    image: Float[Tensor, "b c h w"]
    pixels: Float[Tensor, "3 3"]


def record(image: Float[Tensor, "b c h w"], steps: Sequence[Step], generator: Generator) -> Recorded:
    """Apply the steps in order."""
    pixels = torch.eye(3, dtype=torch.float64)
    for step in steps:
        pixels = step.pixel_matrix((image.shape[-2], image.shape[-1])) @ pixels
        image = step.apply(image, generator)
    return Recorded(image, pixels)


@dataclass(frozen=True)
class Linear(Step):
    """sRGB coding to linear light (IEC 61966-2-1)."""

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The linear values; the straight part of the curve continues below zero."""
        toe = image <= 0.04045
        return torch.where(toe, image / 12.92, ((torch.where(toe, 0.5, image) + 0.055) / 1.055) ** 2.4)


@dataclass(frozen=True)
class Coded(Step):
    """Linear light to sRGB coding, the inverse of `Linear`."""

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The coded values."""
        toe = image <= 0.04045 / 12.92
        return torch.where(toe, 12.92 * image, 1.055 * torch.where(toe, 0.5, image) ** (1 / 2.4) - 0.055)


@dataclass(frozen=True)
class Exposure(Step):
    """Linear light times a gain: exposure time, aperture and amplification together."""

    gain: float | Tensor

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The brighter or darker pictures, not clipped."""
        return image * self.gain


@dataclass(frozen=True)
class Spectral(Step):
    """What a sensor with another spectral response sees of an RGB picture.

    "rgb" leaves it; "luminance" is Rec. 601 (0.299, 0.587, 0.114); a `Band` is one channel: the three channels
    taken as Gaussians at 600, 540 and 460 nm of sigma 35 nm, weighted by how much of each a Gaussian band of that
    centre and full width at half maximum collects, and scaled so that white stays white. An RGB picture does
    not hold a spectrum: this approximation is right for greys and only plausible for colours.
    """

    response: Literal["rgb", "luminance"] | Band

    def __post_init__(self) -> None:
        if self.response not in ("rgb", "luminance") and not isinstance(self.response, Band):
            raise ValueError(f'response must be "rgb", "luminance" or a Band, got {self.response!r}')
        if isinstance(self.response, Band) and not 400 <= self.response.centre <= 700:
            raise ValueError(
                f"an RGB picture tells nothing of a band at {self.response.centre:g} nm; use 400 to 700 nm"
            )

    def apply(self, image: Float[Tensor, "b 3 h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """One channel, or three for "rgb"."""
        if self.response == "rgb":
            return image
        weights = _REC601 if self.response == "luminance" else band_weights(self.response)
        return (image * image.new_tensor(weights)[:, None, None]).sum(1, keepdim=True)


def band_weights(band: Band) -> tuple[float, float, float]:
    """Weights of R, G and B that add up to 1 (see `Spectral`).

    >>> [round(w, 2) for w in band_weights(Band(600, 40))]
    [0.77, 0.23, 0.0]
    """
    variance = (band.width / (8 * math.log(2)) ** 0.5) ** 2 + _RGB_SIGMA**2
    exponents = [-((band.centre - c) ** 2) / (2 * variance) for c in _RGB_NANOMETRES]
    overlaps = [math.exp(e - max(exponents)) for e in exponents]
    r, g, b = (o / sum(overlaps) for o in overlaps)
    return r, g, b


@dataclass(frozen=True)
class BoxBlur(Step):
    """Mean over a square of an odd number of pixels; the border is continued."""

    width: int

    def __post_init__(self) -> None:
        if self.width < 1 or self.width % 2 == 0:
            raise ValueError(f"the width of a box blur must be an odd number of pixels, got {self.width}")

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The blurred pictures."""
        kernel = image.new_full((self.width,), 1 / self.width)
        return _convolved(_convolved(image, kernel[None]), kernel[:, None])


@dataclass(frozen=True)
class GaussianBlur(Step):
    """Uniform Gaussian defocus; sigma in pixels."""

    sigma: float | Tensor

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The blurred pictures."""
        r = math.ceil(4 * _value(self.sigma))
        x = torch.arange(-r, r + 1, dtype=image.dtype, device=image.device)
        kernel = torch.exp(-0.5 * (x / max(self.sigma, 1e-6)) ** 2)
        kernel = kernel / kernel.sum()
        return _convolved(_convolved(image, kernel[None]), kernel[:, None])


@dataclass(frozen=True)
class DiscBlur(Step):
    """Uniform defocus by a round aperture: the mean over a disc, its radius in pixels, its rim one pixel soft."""

    radius: float | Tensor

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The blurred pictures."""
        n = math.ceil(_value(self.radius) + 0.5)
        x = torch.arange(-n, n + 1, dtype=image.dtype, device=image.device)
        kernel = (self.radius + 0.5 - torch.hypot(x[:, None], x[None])).clamp(0, 1)
        return _convolved(image, kernel / kernel.sum())


def _value(x: float | Tensor) -> float:
    return float(x.detach()) if isinstance(x, Tensor) else float(x)


def _convolved(image: Tensor, kernel: Tensor) -> Tensor:
    """Each channel with the odd-sized kernel (kh, kw), the border continued."""
    h, w = kernel.shape
    planes = pad(image.flatten(0, 1)[:, None], (w // 2, w // 2, h // 2, h // 2), mode="replicate")
    return conv2d(planes, kernel[None, None]).view(image.shape)


@dataclass(frozen=True)
class Resample(Step):
    """Another number of pixels for the same field of view: c' = (c + 0.5) s - 0.5.

    `to` is a factor (sizes are rounded, and the factor along each axis is what they give) or a (height, width).
    "area" is what a sensor with larger pixels records: it keeps the mean of the picture exactly. "bicubic" is
    the usual antialiased resize with a = -0.5.
    """

    to: float | HW
    method: Literal["area", "bicubic"] = "area"

    def hw(self, hw: HW) -> HW:
        """The size that comes out for a size that goes in."""
        if isinstance(self.to, tuple):
            return self.to
        return max(round(hw[0] * self.to), 1), max(round(hw[1] * self.to), 1)

    def pixel_matrix(self, hw: HW) -> Float[Tensor, "3 3"]:
        """The resize matrix."""
        return resize_matrix(hw, self.hw(hw))

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h2 w2"]:
        """The resized pictures."""
        h, w = image.shape[-2:]
        new = self.hw((h, w))
        if self.method == "bicubic":
            return interpolate(image, new, mode="bicubic", align_corners=False, antialias=True)
        return _area_weights(h, new[0]).to(image) @ image @ _area_weights(w, new[1]).to(image).mT


def _area_weights(old: int, new: int) -> Tensor:
    """(new, old): the share of each old pixel in each new one, rows adding up to 1."""
    edge = torch.arange(new + 1, dtype=torch.float64) * (old / new)
    pixel = torch.arange(old, dtype=torch.float64)
    overlap = torch.minimum(edge[1:, None], pixel + 1) - torch.maximum(edge[:-1, None], pixel)
    return overlap.clamp(min=0) * (new / old)


@dataclass(frozen=True)
class Noise(Step):
    """Shot and read noise, on linear values of which 1 stands for `full_well` electrons.

    Variance in electrons is the signal plus `read`^2. Drawn as a Gaussian of that variance, so that it is
    differentiable; true Poisson counts differ visibly below about ten electrons only.
    """

    full_well: float
    read: float = 0.0

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The noisy pictures, not clipped."""
        variance = (image.clamp(min=0) * self.full_well + self.read**2) / self.full_well**2
        return image + (variance + 1e-20).sqrt() * _normal(image.shape, image, generator)


@dataclass(frozen=True)
class Clip(Step):
    """Saturation: values held between 0 and 1."""

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The clipped pictures."""
        return image.clamp(0, 1)


@dataclass(frozen=True)
class Quantise(Step):
    """Clipped to 0..1 and rounded to 2^bits levels. The gradient passes as if nothing were rounded."""

    bits: int = 8

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The rounded pictures."""
        levels = 2**self.bits - 1
        clipped = image.clamp(0, 1)
        return clipped + ((clipped * levels).round() / levels - clipped).detach()


@dataclass(frozen=True)
class Jitter(Step):
    """Cameras never agree: each picture gets its own gain, gamma and white balance, then is clipped.

    The logarithms of gain, gamma and of each channel's balance are normal with these standard deviations. Meant
    for coded values.
    """

    gain: float = 0.05
    gamma: float = 0.05
    balance: float = 0.03

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The changed pictures."""
        b, c = image.shape[:2]
        gain = self.gain * _normal((b, 1), image, generator) + self.balance * _normal((b, c), image, generator)
        gamma = self.gamma * _normal((b, 1, 1, 1), image, generator)
        return (image.clamp(min=1e-6) ** gamma.exp() * gain.exp()[..., None, None]).clamp(0, 1)


@dataclass(frozen=True)
class Case:
    """One way in which the two pictures of a pair are degraded."""

    name: str
    alpha: tuple[Step, ...] = ()
    beta: tuple[Step, ...] = ()


def paper_cases(blur: int = 5) -> tuple[Case, Case, Case, Case]:
    """The paper's four augmentations for two inputs; each is to be drawn with probability 1/4.

    The paper does not give the blur; here it is a box of `blur` pixels.
    """
    reduced = (Resample(0.5, "bicubic"), Resample(2.0, "bicubic"), Clip())
    return (
        Case("blur alpha", alpha=(BoxBlur(blur),)),
        Case("blur beta", beta=(BoxBlur(blur),)),
        Case("reduce beta", beta=reduced),
        Case("blur and reduce beta", beta=(BoxBlur(blur), *reduced)),
    )


class Pairs(NamedTuple):
    """Degraded pictures of both cameras, and which case each pair of the batch met."""

    alpha: Float[Tensor, "b ca ha wa"]
    beta: Float[Tensor, "b cb hb wb"]
    case: Int[Tensor, " b"]


def augment(
    alpha: Float[Tensor, "b ca ha wa"],
    beta: Float[Tensor, "b cb hb wb"],
    cases: Sequence[Case],
    generator: Generator,
) -> Pairs:
    """Degrade each pair of a batch by one of the cases, all equally likely. Sizes must come out as they went in."""
    drawn = torch.randint(len(cases), (len(alpha),), generator=generator, device=generator.device)
    alpha, beta = alpha.clone(), beta.clone()
    for i, case in enumerate(cases):
        met = (drawn == i).nonzero()[:, 0].to(alpha.device)
        if len(met):
            alpha[met] = _same_size(alpha[met], case.alpha, generator, case.name)
            beta[met] = _same_size(beta[met], case.beta, generator, case.name)
    return Pairs(alpha, beta, drawn)


def _same_size(image: Tensor, steps: Sequence[Step], generator: Generator, name: str) -> Tensor:
    degraded = record(image, steps, generator).image
    if degraded.shape != image.shape:
        old, new = tuple(image.shape[1:]), tuple(degraded.shape[1:])
        raise ValueError(
            f'case "{name}" turns {old} into {new}; the cases of a batch must keep the size: add a Resample'
        )
    return degraded


def _normal(shape: Sequence[int], like: Tensor, generator: Generator) -> Tensor:
    noise = torch.randn(tuple(shape), generator=generator, device=generator.device, dtype=like.dtype)
    return noise.to(like.device)
