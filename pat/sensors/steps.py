"""Steps of a recording: blur, coarser pixels, noise, saturation, quantisation; and their seeds."""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor
from torch.nn.functional import conv2d, interpolate, pad

from arraygeom.checks import check_above, check_hw
from arraygeom.pixels import HW, resize_matrix


class Step(ABC):
    """Base class of one step in the formation of an image, such as blur or noise.

    A subclass defines `apply(image, generator)` of images (b, c, h, w), and `pixel_matrix` too if it moves or
    resizes the pixel grid.
    """

    @abstractmethod
    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c2 h2 w2"]:
        """Apply the step to images (b, c, h, w), with randomness from `generator`.

        Returns:
            Images after the step; a step may change channels and size.
        """

    def pixel_matrix(self, hw: HW) -> Float[Tensor, "3 3"]:
        """Matrix from pixel positions before the step to those after it.

        Args:
            hw: height and width before the step.

        Returns:
            A (3, 3) with (x, y, 1) after the step ~ A (x, y, 1) before it, float64 on the CPU; the identity
            for a step that keeps the pixel grid.
        """
        return torch.eye(3, dtype=torch.float64)


def record(
    image: Float[Tensor, "b c h w"], steps: Sequence[Step], generator: Generator
) -> Float[Tensor, "b c2 h2 w2"]:
    """Apply steps to images in order.

    Returns:
        Images after the last step; `image` itself for no steps.
    """
    for step in steps:
        image = step.apply(image, generator)
    return image


@dataclass(frozen=True)
class BoxBlur(Step):
    """Mean over a square with replicated border.

    Attributes:
        width: side of the square, an odd number of pixels; others raise ValueError.
    """

    width: int

    def __post_init__(self) -> None:
        if self.width < 1 or self.width % 2 == 0:
            raise ValueError(f"the width of a box blur must be an odd number of pixels, got {self.width}")

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        return _separably(image, image.new_full((self.width,), 1 / self.width))


@dataclass(frozen=True)
class GaussianBlur(Step):
    """Uniform Gaussian defocus with replicated border, differentiable in sigma.

    Attributes:
        sigma: standard deviation in pixels, a number or a tensor without axes; ValueError if it is negative,
            infinite or NaN. 0 changes nothing, and has no gradient in sigma.
    """

    sigma: float | Tensor

    def __post_init__(self) -> None:
        if not 0 <= float(torch.as_tensor(self.sigma).detach()) < math.inf:
            raise ValueError(f"gaussian blur: sigma must be 0 or more pixels, got {self.sigma}")

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        r = math.ceil(4 * float(torch.as_tensor(self.sigma).detach()))
        x = torch.arange(-r, r + 1, dtype=image.dtype, device=image.device)
        kernel = torch.exp(-0.5 * (x / max(self.sigma, 1e-6)) ** 2)
        return _separably(image, kernel / kernel.sum())


@dataclass(frozen=True)
class Resample(Step):
    """Change of the number of pixels for the same field of view: c' = (c + 0.5) s - 0.5.

    Attributes:
        to: a factor (sizes are rounded, to 1 pixel at least, which changes the factor along each axis), or a
            tuple (height, width).
        method: "area" models a sensor with larger pixels and keeps each channel's mean; "bicubic" is the
            usual antialiased resize with a = -0.5, which may leave 0..1.

    Raises:
        ValueError: for a factor that is not above 0 and finite, a size that is not in whole pixels, or
            another method.
    """

    to: float | HW
    method: Literal["area", "bicubic"] = "area"

    def __post_init__(self) -> None:
        check_hw(self.to) if isinstance(self.to, tuple) else check_above(0, itself=False, to=self.to)
        if self.method not in ("area", "bicubic"):
            raise ValueError(f"resample: method is 'area' or 'bicubic', got {self.method!r}")

    def hw(self, hw: HW) -> HW:
        if isinstance(self.to, tuple):
            return self.to
        return max(round(hw[0] * self.to), 1), max(round(hw[1] * self.to), 1)

    def pixel_matrix(self, hw: HW) -> Float[Tensor, "3 3"]:
        return resize_matrix(hw, self.hw(hw))

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h2 w2"]:
        h, w = image.shape[-2:]
        new = self.hw((h, w))
        if self.method == "bicubic":
            return interpolate(image, new, mode="bicubic", align_corners=False, antialias=True)
        return _area_weights(h, new[0]).to(image) @ image @ _area_weights(w, new[1]).to(image).mT


def _area_weights(old: int, new: int) -> Tensor:
    """Matrix (new, old) with the share of each old pixel in each new one; rows sum to 1."""
    edge = torch.arange(new + 1, dtype=torch.float64) * (old / new)
    pixel = torch.arange(old, dtype=torch.float64)
    overlap = torch.minimum(edge[1:, None], pixel + 1) - torch.maximum(edge[:-1, None], pixel)
    return overlap.clamp(min=0) * (new / old)


@dataclass(frozen=True)
class Noise(Step):
    """Shot and read noise on linear values, from a normal distribution of variance signal + read^2.

    The signal is in electrons, 0 for negative values. The result is not clipped, and differentiable.

    Attributes:
        full_well: electrons at value 1, more than 0.
        read: standard deviation of the read noise in electrons, 0 or more.

    Raises:
        ValueError: for numbers outside these ranges, infinity or NaN.
    """

    full_well: float
    read: float = 0.0

    def __post_init__(self) -> None:
        check_above(0, itself=False, full_well=self.full_well)
        check_above(0, read=self.read)

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        variance = (image.clamp(min=0) * self.full_well + self.read**2) / self.full_well**2
        return image + (variance + 1e-20).sqrt() * normal(image.shape, image, generator)


@dataclass(frozen=True)
class Clip(Step):
    """Saturation: clips values to 0..1."""

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        return image.clamp(0, 1)


@dataclass(frozen=True)
class Quantise(Step):
    """Clipping to 0..1 and rounding to 2^bits levels; gradients pass as if only clipped.

    Attributes:
        bits: bits of a value, 1 or more; fewer raise ValueError, other types than integers TypeError.
    """

    bits: int = 8

    def __post_init__(self) -> None:
        check_above(1, whole=True, bits=self.bits)

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        levels = 2**self.bits - 1
        clipped = image.clamp(0, 1)
        return clipped + ((clipped * levels).round() / levels - clipped).detach()


@dataclass(frozen=True)
class Jitter(Step):
    """Random gain, gamma and white balance of sRGB values, drawn for each image of the batch.

    A value v becomes gain · channel gain · v^gamma, clipped to 0..1; gains and gamma are log-normal about 1.

    Attributes:
        gain: standard deviation of the natural logarithm of the gain of all channels.
        gamma: standard deviation of the natural logarithm of gamma, one for all channels.
        normalisation: standard deviation of the natural logarithm of each channel's own gain.

    Raises:
        ValueError: for a deviation that is negative, infinite or NaN.
    """

    gain: float = 0.05
    gamma: float = 0.05
    normalisation: float = 0.03

    def __post_init__(self) -> None:
        check_above(0, gain=self.gain, gamma=self.gamma, normalisation=self.normalisation)

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        b, c = image.shape[:2]
        gain = self.gain * normal((b, 1), image, generator)
        gain = gain + self.normalisation * normal((b, c), image, generator)
        gamma = self.gamma * normal((b, 1, 1, 1), image, generator)
        return (image.clamp(min=1e-6) ** gamma.exp() * gain.exp()[..., None, None]).clamp(0, 1)


def _separably(image: Tensor, kernel: Tensor) -> Tensor:
    return convolved(convolved(image, kernel[None]), kernel[:, None])


def convolved(image: Tensor, kernel: Tensor) -> Tensor:
    """Return the image, each channel convolved with a kernel (kh, kw) of odd sides (others fail).

    The border is replicated.
    """
    h, w = kernel.shape
    planes = pad(image.flatten(0, 1)[:, None], (w // 2, w // 2, h // 2, h // 2), mode="replicate")
    return conv2d(planes, kernel[None, None]).view(image.shape)


def generator_for(seed: int, *names: object, device: torch.device | str = "cpu") -> Generator:
    """Make a random generator seeded by a number and names: the same numbers on every machine.

    >>> generator_for(0, "mono", 3).initial_seed() == generator_for(0, "mono", 3).initial_seed()
    True
    >>> generator_for(0, "mono", 3).initial_seed() == generator_for(0, "mono", 4).initial_seed()
    False
    """
    return Generator(device=device).manual_seed(seed_for(seed, *names))


def seed_for(seed: int, *names: object) -> int:
    """Derive a seed of 63 bits from another seed and names."""
    digest = hashlib.sha256("/".join(map(str, (seed, *names))).encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def normal(shape: Sequence[int], like: Tensor, generator: Generator) -> Tensor:
    """Draw standard normal numbers of a shape from a generator, on the device and of the type of `like`."""
    noise = torch.randn(tuple(shape), generator=generator, device=generator.device, dtype=like.dtype)
    return noise.to(like.device)


class Pairs(NamedTuple):
    """Images of both cameras degraded by `augment`.

    Attributes:
        alpha: alpha's images.
        beta: beta's images.
        case: case of each pair, 0 to 3 as `augment` numbers them, int64, on the generator's device.
    """

    alpha: Float[Tensor, "b ca ha wa"]
    beta: Float[Tensor, "b cb hb wb"]
    case: Int[Tensor, " b"]


def augment(
    alpha: Float[Tensor, "b ca ha wa"], beta: Float[Tensor, "b cb hb wb"], generator: Generator
) -> Pairs:
    """Degrade each pair of a batch by one of the paper's four cases, drawn at random, all equally likely.

    0: alpha blurred; 1: beta blurred; 2: beta reduced to half the size and back (bicubic, clipped to 0..1);
    3: beta blurred, then reduced and back. The paper does not state the blur; here it is a box of 5 pixels.

    Args:
        alpha: alpha's images.
        beta: beta's images, as many, with even sides: odd ones fail in cases 2 and 3 with RuntimeError.
        generator: random generator.

    Returns:
        New images of the same shapes, with the case of each pair.
    """
    blur: tuple[Step, ...] = (BoxBlur(5),)
    reduced: tuple[Step, ...] = (Resample(0.5, "bicubic"), Resample(2.0, "bicubic"), Clip())
    cases: list[tuple[tuple[Step, ...], tuple[Step, ...]]]
    cases = [(blur, ()), ((), blur), ((), reduced), ((), blur + reduced)]
    drawn = torch.randint(len(cases), (len(alpha),), generator=generator, device=generator.device)
    alpha, beta = alpha.clone(), beta.clone()
    for i, (of_alpha, of_beta) in enumerate(cases):
        index = (drawn == i).nonzero()[:, 0].to(alpha.device)
        if len(index):
            alpha[index] = record(alpha[index], of_alpha, generator)
            beta[index] = record(beta[index], of_beta, generator)
    return Pairs(alpha, beta, drawn)
