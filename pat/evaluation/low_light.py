"""Low light: views with the noise of few electrons, the rival that denoises each by itself, and figures of both.

`python -m pat.evaluation.low_light --middlebury DIR` prints a table.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import tyro
from jaxtyping import Float
from skimage.restoration import denoise_nl_means
from torch import Generator, Tensor

from arraygeom import Rectified

from ..data.pairs import PAPER_DISPARITY, StereoPair, middlebury_pairs
from ..fusion.fuse import fuse
from ..fusion.low_light import Noise
from ..networks.protocol import FusionNetwork
from ..networks.weights import load_weights
from ..sensors import NoiseLevel, generator_for
from .baseline import classical_fusion
from .metrics import score
from .protocols import MonoColourTask, mono_colour_task, rectified_rig
from .tables import markdown_table

READ_NOISE = 2.0
"""Electrons, as of a good camera today."""


def low_light(
    image: Float[Tensor, "c h w"], electrons: float, read_noise: float, generator: Generator
) -> Float[Tensor, "c h w"]:
    """An ideal sRGB image as a camera records it that counts so many electrons at white, with read noise (electrons).

    Poisson and read noise are added in linear light, which is clipped to 0..1 and sRGB-encoded.
    """
    return NoiseLevel.of_electrons(electrons, read_noise).recorded(image[None], generator)[0]


def non_local_means(image: Float[Tensor, "c h w"], deviation: float) -> Float[Tensor, "c h w"]:
    """scikit-image's non-local means for noise of a known standard deviation (Buades et al. 2005; Darbon et al. 2008).

    Patches of 5 x 5 pixels within 6 pixels, h = 0.8 deviations, as its documentation advises.
    """
    given = image.movedim(0, -1).numpy()
    found = denoise_nl_means(
        given, patch_size=5, patch_distance=6, h=0.8 * deviation, sigma=deviation, fast_mode=True, channel_axis=-1
    )
    return torch.from_numpy(np.ascontiguousarray(found.reshape(given.shape))).movedim(-1, 0).to(image)


class NoisyTask(NamedTuple):
    """A task in low light: its views are noisy, of these levels; `ideal` is the same without noise."""

    task: MonoColourTask
    ideal: MonoColourTask
    noise: Mapping[str, NoiseLevel]

    @classmethod
    def of(cls, ideal: MonoColourTask, level: NoiseLevel, *names: object) -> NoisyTask:
        """Both views recorded with noise of one level, drawn by these names."""
        views = zip(("alpha", "beta"), ideal[:2])
        alpha, beta = (level.recorded(image[None], generator_for(0, *names, name))[0] for name, image in views)
        return cls(MonoColourTask(alpha, beta, ideal.ground_truth), ideal, {"alpha": level, "beta": level})

    def fused(self, network: FusionNetwork, *, stated: bool = True) -> Tensor:
        """The fusion, the noise levels stated or estimated."""
        alpha, beta, _ = self.task
        h, w = alpha.shape[1:]
        rig = rectified_rig((h, w), {"beta": (beta.shape[1], beta.shape[2])}, PAPER_DISPARITY)
        noise: Noise = self.noise if stated else "estimate"
        field, images = Rectified(PAPER_DISPARITY, alpha_is="left"), {"alpha": alpha, "beta": beta}
        return fuse(network, rig, images, alpha="alpha", field=field, noise=noise).image

    def denoised_then_classical(self) -> Tensor:
        """The classical baseline on views denoised by non-local means that know the true deviation of the noise."""
        pairs = zip(self.task[:2], self.ideal[:2])
        alpha, beta = (non_local_means(noisy, float((noisy - ideal).std())) for noisy, ideal in pairs)
        return classical_fusion(alpha, beta, PAPER_DISPARITY)


class LowLightRow(NamedTuple):
    """PSNR and SSIM of one method on one pair at so many electrons."""

    pair: str
    electrons: float
    method: str
    psnr: float
    ssim: float


def low_light_rows(
    network: FusionNetwork, pairs: Iterable[StereoPair], electrons: Iterable[float], *, rate: int = 2
) -> list[LowLightRow]:
    """Every method's scores on each pair, beta reduced `rate` times, at each number of electrons at white."""
    rows = []
    levels = {n: NoiseLevel.of_electrons(n, READ_NOISE) for n in electrons}
    for pair in pairs:
        for n, level in levels.items():
            noisy = NoisyTask.of(mono_colour_task(pair, rate), level, pair.name, n)
            images = {
                "classical": classical_fusion(*noisy.task[:2], PAPER_DISPARITY),
                "non-local means, classical": noisy.denoised_then_classical(),
                "fusion": noisy.fused(network),
                "fusion, noise estimated": noisy.fused(network, stated=False),
            }
            scores = {name: score(image.clamp(0, 1), noisy.ideal.ground_truth) for name, image in images.items()}
            rows += [LowLightRow(pair.name, n, name, *found) for name, found in scores.items()]
    return rows


def low_light_markdown(rows: Iterable[LowLightRow]) -> str:
    """A line for each pair and number of electrons, then their means; PSNR / SSIM."""
    cells: dict[tuple[str, float], dict[str, list[tuple[float, float]]]] = {}
    for row in rows:
        for key in ((row.pair, row.electrons), ("**mean**", row.electrons)):
            cells.setdefault(key, {}).setdefault(row.method, []).append((row.psnr, row.ssim))
    ordered = sorted(cells.items(), key=lambda item: (item[0][0] == "**mean**", -item[0][1]))
    methods = list(ordered[0][1])
    lines = [
        [pair, f"{electrons:g}", *("{:.2f} / {:.4f}".format(*np.mean(found[m], 0)) for m in methods)]
        for (pair, electrons), found in ordered
    ]
    return markdown_table(["pair", "electrons", *methods], lines)


@dataclass(frozen=True)
class LowLightCommand:
    """Print the scores of fusion in low light beside the classical baseline, with and without denoising."""

    middlebury: Path
    """Folder of Middlebury scenes."""
    names: tuple[str, ...] = ()
    """Only scenes whose names contain one of these."""
    electrons: tuple[float, ...] = (1000, 200, 50)
    """Electrons at white."""
    rate: int = 2
    """How many times beta is reduced."""
    weights: str = "mono-colour"
    """Weights of the fusion."""

    def run(self) -> None:
        """Measure and print."""
        pairs = (p for p in middlebury_pairs(self.middlebury) if not self.names or any(n in p.name for n in self.names))
        print(low_light_markdown(low_light_rows(load_weights(self.weights), pairs, self.electrons, rate=self.rate)))


if __name__ == "__main__":
    tyro.cli(LowLightCommand, prog="python -m pat.evaluation.low_light").run()
