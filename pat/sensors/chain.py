"""Chains of steps, and what each does to images, pixels and cameras."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom.camera import Camera
from arraygeom.pixels import HW, map_homogeneous, pixel_grid
from arraygeom.rig import Rig
from arraygeom.sampling import sample


@dataclass(frozen=True)
class OpticalImage:
    """Images in a chain, with depth, motion and camera of the same pixels where known.

    `depth` in metres along the optical axis; `motion` (x, y) in pixels a second; `camera` with K of these pixels;
    `pixels` is A with x ~ A x_first (float64).
    """

    image: Float[Tensor, "b c h w"]
    pixels: Float[Tensor, "3 3"]
    depth: Float[Tensor, "b h w"] | None = None
    motion: Float[Tensor, "b 2 h w"] | None = None
    camera: Camera | None = None

    @property
    def hw(self) -> HW:
        """Height and width."""
        return self.image.shape[-2], self.image.shape[-1]

    def resampled(self, A: Float[Tensor, "3 3"], image: Float[Tensor, "b c2 h2 w2"]) -> OpticalImage:
        """New images whose pixels are x' ~ A x; depth and motion are those of the nearest old pixels."""
        hw = image.shape[-2], image.shape[-1]
        if hw == self.hw and torch.equal(A, torch.eye(3, dtype=A.dtype)):
            return replace(self, image=image)
        depth = None if self.depth is None else _nearest_values(self.depth[:, None], A, hw)[:, 0]
        motion = None if self.motion is None else _rotated(_nearest_values(self.motion, A, hw), A)
        camera = None if self.camera is None else self.camera.transformed(A, hw)
        return OpticalImage(image, A @ self.pixels, depth, motion, camera)


def _nearest_values(values: Tensor, A: Tensor, hw: HW) -> Tensor:
    old = map_homogeneous(torch.linalg.inv(A)[:2], pixel_grid(hw, dtype=values.dtype, device=values.device))
    return sample(values, old[None], interpolation="nearest", extended=True).values


def _rotated(motion: Tensor, A: Tensor) -> Tensor:
    return torch.einsum("ij,bjhw->bihw", A[:2, :2].to(motion), motion)


class Step(ABC):
    """One step of the formation of an image. Subclasses define `apply`, or `expose` if they need depth or motion."""

    def pixel_matrix(self, hw: HW) -> Float[Tensor, "3 3"]:
        """A with x_after ~ A x_before for an image of height and width `hw`."""
        return torch.eye(3, dtype=torch.float64)

    @abstractmethod
    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c2 h2 w2"]:
        """The images after the step."""

    def expose(self, light: OpticalImage, generator: Generator) -> OpticalImage:
        """The images after the step, with depth, motion and camera."""
        return light.resampled(self.pixel_matrix(light.hw), self.apply(light.image, generator))


class LitStep(Step):
    """A step that needs depth, motion or the camera: it defines `expose`."""

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The images after the step, where depth, motion and camera are not needed after all."""
        return self.expose(OpticalImage(image, torch.eye(3, dtype=torch.float64)), generator).image

    @abstractmethod
    def expose(self, light: OpticalImage, generator: Generator) -> OpticalImage:
        """The images after the step, with depth, motion and camera."""


class Recorded(NamedTuple):
    """Images after a chain, and A with x_after ~ A x_before (float64)."""

    image: Float[Tensor, "b c h w"]
    pixels: Float[Tensor, "3 3"]


def record(
    image: Float[Tensor, "b c h w"],
    steps: Sequence[Step],
    generator: Generator,
    *,
    depth: Float[Tensor, "b h w"] | None = None,
    motion: Float[Tensor, "b 2 h w"] | None = None,
    camera: Camera | None = None,
) -> Recorded:
    """Apply the steps in order.

    `depth` (metres) and `camera` are needed by `Defocus`, `motion` (pixels a second) by `MotionBlur` without a
    velocity of its own. Raises ValueError if a step lacks what it needs.
    """
    light = OpticalImage(image, torch.eye(3, dtype=torch.float64), depth, motion, camera)
    for step in steps:
        light = step.expose(light, generator)
    return Recorded(light.image, light.pixels)


class RecordedArray(NamedTuple):
    """Images of every camera after its chain, and the rig of those images."""

    images: dict[str, Float[Tensor, "b _ _ _"]]
    rig: Rig


def record_array(
    images: Mapping[str, Float[Tensor, "b _ _ _"]],
    rig: Rig,
    chains: Mapping[str, Sequence[Step]],
    *,
    seed: int,
    depth: Mapping[str, Float[Tensor, "b _ _"]] | None = None,
    motion: Mapping[str, Float[Tensor, "b 2 _ _"]] | None = None,
) -> RecordedArray:
    """Each camera's chain on its images; cameras without one record the ideal image.

    Each camera draws from its own generator, seeded by `seed` and its name, independently of the other cameras. The
    rig's cameras are transformed as the steps transform the pixels. Raises ValueError for a camera that
    the rig does not have.
    """
    recorded = {}
    for name, image in images.items():
        view = rig[name]
        recorded[name], pixels = record(
            image,
            chains.get(name, ()),
            generator_for(seed, name, device=image.device),
            depth=(depth or {}).get(name),
            motion=(motion or {}).get(name),
            camera=view if isinstance(view, Camera) else None,
        )
        rig = rig.transformed(name, pixels, (recorded[name].shape[-2], recorded[name].shape[-1]))
    for name in chains:
        rig.require(name)
    return RecordedArray(recorded, rig)


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
