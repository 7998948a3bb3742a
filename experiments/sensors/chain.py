"""Chains of steps, and what each does to images, pixels and cameras."""

from __future__ import annotations

from abc import abstractmethod
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
from pat.sensors import Step, generator_for


@dataclass(frozen=True)
class OpticalImage:
    """Images in a chain, with depth and camera of the same pixels where known.

    `depth` in metres along the optical axis; `camera` with K of these pixels; `pixels` is A with x ~ A
    x_first (float64).
    """

    image: Float[Tensor, "b c h w"]
    pixels: Float[Tensor, "3 3"]
    depth: Float[Tensor, "b h w"] | None = None
    camera: Camera | None = None

    @property
    def hw(self) -> HW:
        """Height and width."""
        return self.image.shape[-2], self.image.shape[-1]

    def resampled(self, A: Float[Tensor, "3 3"], image: Float[Tensor, "b c2 h2 w2"]) -> OpticalImage:
        """New images whose pixels are x' ~ A x; depth is that of the nearest old pixels."""
        hw = image.shape[-2], image.shape[-1]
        if hw == self.hw and torch.equal(A, torch.eye(3, dtype=A.dtype)):
            return replace(self, image=image)
        depth = self.depth
        if depth is not None:
            grid = pixel_grid(hw, dtype=depth.dtype, device=depth.device)
            old = map_homogeneous(torch.linalg.inv(A)[:2], grid)[None]
            depth = sample(depth[:, None], old, interpolation="nearest", extended=True).values[:, 0]
        camera = None if self.camera is None else self.camera.transformed(A, hw)
        return OpticalImage(image, A @ self.pixels, depth, camera)


class LitStep(Step):
    """A step that needs depth or the camera: it defines `expose`."""

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        """The images after the step, where depth and camera are not needed after all."""
        return self.expose(OpticalImage(image, torch.eye(3, dtype=torch.float64)), generator).image

    @abstractmethod
    def expose(self, light: OpticalImage, generator: Generator) -> OpticalImage:
        """The images after the step, with depth and camera."""


def exposed(step: Step, light: OpticalImage, generator: Generator) -> OpticalImage:
    """The images after any step."""
    if isinstance(step, LitStep):
        return step.expose(light, generator)
    return light.resampled(step.pixel_matrix(light.hw), step.apply(light.image, generator))


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
    camera: Camera | None = None,
) -> Recorded:
    """Apply the steps in order.

    `depth` (metres) and `camera` are needed by `Defocus`. Raises ValueError if a step lacks what it needs.
    """
    light = OpticalImage(image, torch.eye(3, dtype=torch.float64), depth, camera)
    for step in steps:
        light = exposed(step, light, generator)
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
) -> RecordedArray:
    """Each camera's chain on its images; cameras without one record the ideal image.

    Each camera draws from its own generator, seeded by `seed` and its name, independently of the other
    cameras. The rig's cameras are transformed as the steps transform the pixels. Raises ValueError for a
    camera that the rig does not have.
    """
    recorded = {}
    for name, image in images.items():
        view = rig[name]
        recorded[name], pixels = record(
            image,
            chains.get(name, ()),
            generator_for(seed, name, device=image.device),
            depth=(depth or {}).get(name),
            camera=view if isinstance(view, Camera) else None,
        )
        rig = rig.transformed(name, pixels, (recorded[name].shape[-2], recorded[name].shape[-1]))
    for name in chains:
        rig.require(name)
    return RecordedArray(recorded, rig)
