"""The steps of a recording: blur, coarser pixels, noise, saturation, digits; and seeds."""

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

from arraygeom.pixels import HW, resize_matrix


class Step(ABC):
    """One step of the formation of an image."""

    @abstractmethod
    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c2 h2 w2"]:
        """The images after the step."""

    def pixel_matrix(self, hw: HW) -> Float[Tensor, "3 3"]:
        """A with x_after ~ A x_before for images of height and width `hw` (float64): the identity if the step
        keeps the grid of pixels."""
        return torch.eye(3, dtype=torch.float64)


def record(
    image: Float[Tensor, "b c h w"], steps: Sequence[Step], generator: Generator
) -> Float[Tensor, "b c2 h2 w2"]:
    """The images after the steps, applied in order."""
    for step in steps:
        image = step.apply(image, generator)
    return image


@dataclass(frozen=True)
class BoxBlur(Step):
    """Mean over a square of an odd number of pixels; the border is replicated."""

    width: int

    def __post_init__(self) -> None:
        if self.width < 1 or self.width % 2 == 0:
            raise ValueError(f"the width of a box blur must be an odd number of pixels, got {self.width}")

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        return _separably(image, image.new_full((self.width,), 1 / self.width))


@dataclass(frozen=True)
class GaussianBlur(Step):
    """Uniform Gaussian defocus; sigma in pixels."""

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
    """Another number of pixels for the same field of view: c' = (c + 0.5) s - 0.5.

    `to` is a factor (sizes are rounded, and the factor along each axis is what they give) or a (height,
    width). "area" is what a sensor with larger pixels records: it keeps the mean of the image exactly.
    "bicubic" is the usual antialiased resize with a = -0.5.
    """

    to: float | HW
    method: Literal["area", "bicubic"] = "area"

    def __post_init__(self) -> None:
        if min(self.to if isinstance(self.to, tuple) else (self.to,)) <= 0:
            raise ValueError(f"resample: give a positive factor or a (height, width), got {self.to}")

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
    """(new, old): the share of each old pixel in each new one, rows adding up to 1."""
    edge = torch.arange(new + 1, dtype=torch.float64) * (old / new)
    pixel = torch.arange(old, dtype=torch.float64)
    overlap = torch.minimum(edge[1:, None], pixel + 1) - torch.maximum(edge[:-1, None], pixel)
    return overlap.clamp(min=0) * (new / old)


@dataclass(frozen=True)
class Noise(Step):
    """Shot and read noise, on linear values of which 1 stands for `full_well` electrons; `read` in electrons.

    Variance in electrons is the signal plus `read`^2. "gaussian" draws from a normal of that variance, and is
    differentiable; "poisson" counts electrons (whole numbers before the read noise), which differs visibly
    below about ten of them; its gradient is that of the mean.
    """

    full_well: float
    read: float = 0.0
    counts: Literal["gaussian", "poisson"] = "gaussian"

    def __post_init__(self) -> None:
        if self.full_well <= 0 or self.read < 0:
            got = f"{self.full_well:g} and {self.read:g}"
            raise ValueError(f"noise: wanted full_well > 0 and read >= 0 electrons, got {got}")

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        if self.counts == "poisson":
            return self._counted(image, generator)
        variance = (image.clamp(min=0) * self.full_well + self.read**2) / self.full_well**2
        return image + (variance + 1e-20).sqrt() * normal(image.shape, image, generator)

    def _counted(self, image: Tensor, generator: Generator) -> Tensor:
        expected = (image.detach().clamp(min=0) * self.full_well).to(generator.device)
        electrons = torch.poisson(expected, generator=generator).to(image)
        electrons = electrons + self.read * normal(image.shape, image, generator)
        return image + (electrons / self.full_well - image).detach()


@dataclass(frozen=True)
class Clip(Step):
    """Saturation: values clipped to 0..1."""

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        return image.clamp(0, 1)


@dataclass(frozen=True)
class Quantise(Step):
    """Clipped to 0..1 and rounded to 2^bits levels. The gradient passes as if nothing were rounded."""

    bits: int = 8

    def __post_init__(self) -> None:
        if self.bits < 1:
            raise ValueError(f"quantise: bits must be 1 or more, got {self.bits}")

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        levels = 2**self.bits - 1
        clipped = image.clamp(0, 1)
        return clipped + ((clipped * levels).round() / levels - clipped).detach()


@dataclass(frozen=True)
class Jitter(Step):
    """A random gain, gamma and white balance for each image, clipped to 0..1.

    The logarithms of gain, gamma and of each channel's balance are normal with these standard deviations.
    Meant for sRGB-encoded values.
    """

    gain: float = 0.05
    gamma: float = 0.05
    normalisation: float = 0.03

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        b, c = image.shape[:2]
        gain = self.gain * normal((b, 1), image, generator)
        gain = gain + self.normalisation * normal((b, c), image, generator)
        gamma = self.gamma * normal((b, 1, 1, 1), image, generator)
        return (image.clamp(min=1e-6) ** gamma.exp() * gain.exp()[..., None, None]).clamp(0, 1)


def _separably(image: Tensor, kernel: Tensor) -> Tensor:
    return convolved(convolved(image, kernel[None]), kernel[:, None])


def convolved(image: Tensor, kernel: Tensor) -> Tensor:
    """Each channel with the odd-sized kernel (kh, kw), the border replicated."""
    h, w = kernel.shape
    planes = pad(image.flatten(0, 1)[:, None], (w // 2, w // 2, h // 2, h // 2), mode="replicate")
    return conv2d(planes, kernel[None, None]).view(image.shape)


def generator_for(seed: int, *names: object, device: torch.device | str = "cpu") -> Generator:
    """A generator seeded by names, the same on every machine.

    >>> generator_for(0, "mono", 3).initial_seed() == generator_for(0, "mono", 3).initial_seed()
    True
    >>> generator_for(0, "mono", 3).initial_seed() == generator_for(0, "mono", 4).initial_seed()
    False
    """
    return Generator(device=device).manual_seed(seed_for(seed, *names))


def seed_for(seed: int, *names: object) -> int:
    """A seed of 63 bits from another one and names."""
    digest = hashlib.sha256("/".join(map(str, (seed, *names))).encode()).digest()
    return int.from_bytes(digest[:8], "big") >> 1


def normal(shape: Sequence[int], like: Tensor, generator: Generator) -> Tensor:
    """Standard normal numbers from a generator, on the device of `like`."""
    noise = torch.randn(tuple(shape), generator=generator, device=generator.device, dtype=like.dtype)
    return noise.to(like.device)


@dataclass(frozen=True)
class DegradationCase:
    """One way in which the two images of a pair are degraded."""

    name: str
    alpha: tuple[Step, ...] = ()
    beta: tuple[Step, ...] = ()


def paper_cases() -> tuple[DegradationCase, ...]:
    """The paper's four augmentations for two inputs; each is drawn with probability 1/4.

    The paper does not give the blur; here it is a box of 5 pixels.
    """
    reduced = (Resample(0.5, "bicubic"), Resample(2.0, "bicubic"), Clip())
    return (
        DegradationCase("blur alpha", alpha=(BoxBlur(5),)),
        DegradationCase("blur beta", beta=(BoxBlur(5),)),
        DegradationCase("reduce beta", beta=reduced),
        DegradationCase("blur and reduce beta", beta=(BoxBlur(5), *reduced)),
    )


class Pairs(NamedTuple):
    """Degraded images of both cameras, and the case of each pair of the batch."""

    alpha: Float[Tensor, "b ca ha wa"]
    beta: Float[Tensor, "b cb hb wb"]
    case: Int[Tensor, " b"]


def augment(
    alpha: Float[Tensor, "b ca ha wa"],
    beta: Float[Tensor, "b cb hb wb"],
    cases: Sequence[DegradationCase],
    generator: Generator,
) -> Pairs:
    """Degrade each pair of a batch by one of the cases, all equally likely. Sizes must not change."""
    drawn = torch.randint(len(cases), (len(alpha),), generator=generator, device=generator.device)
    alpha, beta = alpha.clone(), beta.clone()
    for i, case in enumerate(cases):
        index = (drawn == i).nonzero()[:, 0].to(alpha.device)
        if len(index):
            alpha[index] = _same_size(alpha[index], case.alpha, generator, case.name)
            beta[index] = _same_size(beta[index], case.beta, generator, case.name)
    return Pairs(alpha, beta, drawn)


def _same_size(image: Tensor, steps: Sequence[Step], generator: Generator, name: str) -> Tensor:
    degraded = record(image, steps, generator)
    if degraded.shape != image.shape:
        old, new = tuple(image.shape[1:]), tuple(degraded.shape[1:])
        raise ValueError(
            f'case "{name}" changes {old} to {new}; the cases of a batch must keep the size: add a Resample'
        )
    return degraded
