"""Chains of steps for the cameras of an array."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom.rig import Rig
from pat.sensors import Step, generator_for


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
) -> RecordedArray:
    """Each camera's chain on its images; cameras without one record the ideal image.

    Each camera draws from its own generator, seeded by `seed` and its name, independently of the other
    cameras. The rig's cameras are transformed as the steps transform the pixels. Raises ValueError for a
    camera that the rig does not have.
    """
    for name in chains:
        rig.require(name)
    recorded = {}
    for name, image in images.items():
        generator = generator_for(seed, name, device=image.device)
        A = torch.eye(3, dtype=torch.float64)
        for step in chains.get(name, ()):
            A = step.pixel_matrix((image.shape[-2], image.shape[-1])) @ A
            image = step.apply(image, generator)
        recorded[name] = image
        rig = rig.transformed(name, A, (image.shape[-2], image.shape[-1]))
    return RecordedArray(recorded, rig)
