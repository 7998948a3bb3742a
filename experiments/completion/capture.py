"""What the fusion of pairs gives to the completion, kept as planes of 8 bits.

They are alpha, confidence, and chroma of the ground truth, of the image as it is, and of the candidates'
differences from that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pat.fusion.fuse import FuseSettings
from pat.lab.data.pairs import StereoPair
from pat.lab.evaluation.protocols import mono_colour_task, rectified_fusion
from pat.matching.match import Matcher, match
from pat.media.colour import to_luma_chroma
from pat.networks.completion import CANDIDATES, Completion, differences
from pat.networks.guided import GuidedPAT
from pat.sensors.noise_level import NoiseLevel

RATES = (1, 2, 2, 2, 4, 4, 8)
"""By which beta is reduced, one of them at random."""
NOISY = 0.15
"""Share of recordings in low light, 50 to 2,000 electrons at white."""
READ_NOISE = 2.0
LEVELS = 180.0
"""Levels of 8 bits to 1, of chroma."""
PLANES = 2 + 2 * (2 + CANDIDATES)


class Recorder(Completion):
    """In a completion's place: keeps what it is given, and leaves the image as it is."""

    def __init__(self) -> None:
        super().__init__((1, 1, 1))

    def forward(
        self, alpha: Tensor, confidence: Tensor, mixed: Tensor, candidates: Sequence[Tensor]
    ) -> Tensor:
        """The image as it is."""
        self.given = alpha, confidence, mixed, candidates
        return mixed


def fused_at_random(network: GuidedPAT, pair: StereoPair, seed: int, matcher: Matcher = match) -> Tensor:
    """Fuse a pair recorded at random, left as alpha, its largest disparity known; returns left as it is."""
    assert pair.max_disparity is not None
    rng, g = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    alpha, beta, truth, _ = mono_colour_task(pair, int(rng.choice(RATES)))
    noise = None
    if rng.random() < NOISY:
        level = NoiseLevel.of_electrons(float(np.exp(rng.uniform(np.log(50), np.log(2000)))), READ_NOISE)
        alpha, beta = (level.recorded(image[None], g)[0] for image in (alpha, beta))
        noise = {"alpha": level, "beta": level}
    settings = FuseSettings(response="rec601", align=False, noise=noise)
    rectified_fusion(network, settings=settings, matcher=matcher)(alpha, beta, pair.max_disparity)
    return truth


def captured(
    network: GuidedPAT, pair: StereoPair, seed: int, matcher: Matcher = match
) -> Float[Tensor, "p h w"]:
    """The planes of a pair recorded at random, left as alpha, its largest disparity known; `matcher` is as of
    `fuse`."""
    recorder = network.completion = Recorder()
    truth = fused_at_random(network, pair, seed, matcher)
    alpha, confidence, mixed, candidates = recorder.given
    colours = [to_luma_chroma(c)[1] for c in (mixed, *differences(confidence, mixed, candidates))]
    h, w = truth.shape[1:]
    planes = torch.cat([alpha, confidence, *colours], 1)[0, :, :h, :w]
    return torch.cat([planes[:2], to_luma_chroma(truth)[1], planes[2:]])


def levels(planes: Float[Tensor, "p h w"]) -> Tensor:
    """Planes as bytes; `values` is the inverse."""
    return torch.cat([planes[:2] * 255, planes[2:] * LEVELS + 128]).round().clamp(0, 255).byte()


def values(planes: Tensor) -> Float[Tensor, "*b p h w"]:
    """Numbers of planes as bytes."""
    light, colours = planes.float().split([2, PLANES - 2], -3)
    return torch.cat([light / 255, (colours - 128) / LEVELS], -3)
