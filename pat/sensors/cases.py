"""Cases: how the images of a pair are degraded, one drawn for each pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

from .steps import BoxBlur, Clip, Resample, Step, record


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
    """Degrade each pair of a batch by one of the cases, all equally likely. Sizes must come out as they went in."""
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
