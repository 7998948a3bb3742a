"""Layered scenes in low light, denoised view by view and fused: what the joint denoiser learns from."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from arraygeom import Epipolar, sample
from arraygeom.fields.grid import FieldOnGrid
from pat.matching.inputs import Inputs
from pat.media.colour import luminance
from pat.networks.collaborative import without_noise
from pat.networks.denoiser import LowLightNetwork, NoisyView
from pat.networks.protocol import FusionNetwork, fused_at_once
from pat.sensors import NoiseLevel, generator_for
from pat.synthesis.layered import LayeredScenes
from pat.synthesis.photos import PhotoBank
from pat.synthesis.rigs import below, one_of
from pat.training.config import GENERAL, RECTIFIED
from pat.training.samples import enlarged, pair_of

HW = (128, 256)
"""Height and width of alpha in the scenes."""
TOGETHER = 4
"""Scenes made at once."""
KEPT = 40
"""Groups of scenes that windows are drawn from, the last ones made."""
STEPS = 16
"""Steps for which one group is added."""
EARLIER = 7
"""Groups that are there before the first step."""


class NoisyScene(NamedTuple):
    """A fused scene (B, 3, H, W), what it was fused from, at alpha's pixels, and the ideal image."""

    image: Tensor
    alpha: NoisyView
    beta: NoisyView
    confidence: Tensor
    ground_truth: Tensor

    @property
    def stacked(self) -> Tensor:
        """All in one tensor (B, 19, H, W)."""
        return torch.cat([self.image, *self.alpha, *self.beta, self.confidence, self.ground_truth], 1)

    @classmethod
    def of_stacked(cls, stacked: Tensor) -> NoisyScene:
        """The inverse of `stacked`."""
        image, a, b, c, d, e, f, confidence, ideal = stacked.split([3, 1, 1, 1, 3, 3, 3, 1, 3], 1)
        return cls(image, NoisyView(a, b, c), NoisyView(d, e, f), confidence, ideal)


def noise_levels(count: int, g: Generator) -> NoiseLevel:
    """Random levels: 15 to 3,000 electrons at white, up to 5 of read noise, or 1 to 60 of 255 anywhere."""
    draw, light = torch.rand(4, count, 1, 1, 1, generator=g), bool(below(2, g))
    electrons, constant = 15 * 200 ** draw[0], (draw[2] < 0.3) & (not light)
    shot = torch.where(constant, 0.0, 1 / electrons)
    read = torch.where(constant, 60 ** draw[3] / 255, 5 * draw[1].square() / electrons)
    return NoiseLevel(shot, read, "light" if light else "values")


def noisy(image: Tensor, level: NoiseLevel, g: Generator) -> tuple[Tensor, Tensor]:
    """The image as recorded, unbiased, and its deviation as one would state it, up to some 8 % wrong."""
    recorded = level.recorded(image, g)
    wrong = (0.08 * torch.randn(len(image), 1, 1, 1, generator=g)).exp()
    return level.unbiased(recorded), level.deviation(recorded) * wrong


class NoisyScenes:
    """Windows of scenes by the number of the step: a pure function of it and the seed."""

    def __init__(
        self, photos: PhotoBank, fusion: FusionNetwork, denoiser: LowLightNetwork, seed: int
    ) -> None:
        self.fusion, self.denoiser, self.seed = fusion, denoiser, seed
        rigs = (
            replace(RECTIFIED, resolutions=(1.0, 0.5, 0.5)),
            replace(GENERAL, resolutions=(1.0, 0.5, 0.5)),
        )
        self.makers = [LayeredScenes(photos, rig, hw=HW, seed=seed) for rig in rigs]

    def steps(self, batch: int, side: int, *, start: int = 0) -> Iterator[NoisyScene]:
        """Windows of each step from step `start` on."""
        first = start // STEPS
        kept = deque(map(self.group, range(max(first - KEPT + 1, -EARLIER), first + 1)), maxlen=KEPT)
        for step in itertools.count(start):
            if step > start and step % STEPS == 0:
                kept.append(self.group(step // STEPS))
            yield windows_of(kept, batch, side, generator_for(self.seed, "windows", step))

    @torch.no_grad()
    def group(self, number: int) -> Tensor:
        """One group of scenes, stacked, in half precision."""
        g = generator_for(self.seed, "scenes", number)
        scene = one_of(self.makers, g).sample(TOGETHER, g)
        dark = (0.4 + 1.2 * torch.rand(TOGETHER, 1, 1, 1, generator=g)).clamp(max=1.0)
        ideal, other = (dark * image for image in scene.images)
        level = noise_levels(TOGETHER, g)
        second = level if below(2, g) else noise_levels(TOGETHER, g)
        alpha = _view(self.denoiser.band, luminance(ideal), level, g)
        beta = NoisyView(*(enlarged(part, HW) for part in _view(self.denoiser.colour, other, second, g)))
        field = FieldOnGrid.of(Epipolar(), pair_of(scene, 1, g))
        found = fused_at_once(self.fusion, Inputs.of(alpha.denoised, [beta.denoised], [field]))
        where = found.position[0].movedim(1, -1).float()
        warped = NoisyView(*(sample(part, where).values for part in beta))
        return NoisyScene(
            found.image.float(), alpha, warped, found.confidence[0][:, None].float(), ideal
        ).stacked.half()


def windows_of(groups: Sequence[Tensor], batch: int, side: int, g: Generator) -> NoisyScene:
    """Random square parts of scenes, flipped and transposed."""
    found = []
    for _ in range(batch):
        scenes = one_of(groups, g)
        i, y, x = (below(n, g) for n in (len(scenes), HW[0] - side + 1, HW[1] - side + 1))
        flips = torch.randint(2, (3,), generator=g).tolist()
        found.append(flipped(scenes[i, :, y : y + side, x : x + side].float(), flips))
    return NoisyScene.of_stacked(torch.stack(found))


def flipped(image: Float[Tensor, "c n n"], flips: Sequence[int]) -> Float[Tensor, "c n n"]:
    """A square image upside down, left to right and transposed, each where its number is not 0."""
    image = image.flip([axis for axis in (1, 2) if flips[axis - 1]])
    return image.mT if flips[2] else image


def _view(denoiser: nn.Module, ideal: Tensor, level: NoiseLevel, g: Generator) -> NoisyView:
    recorded, deviation = noisy(ideal, level, g)
    return NoisyView(recorded, without_noise(denoiser, recorded, deviation), deviation)
