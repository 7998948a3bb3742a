"""Training of the denoisers: `python -m experiments.low_light.training --photos DIR --out runs/low-light`.

On windows of photographs with noise of random kind and level.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from experiments.fit import Recipe, command, recipe_text
from pat.lab.synthesis.photos import PhotoBank
from pat.lab.synthesis.rigs import below
from pat.lab.training.losses import image_loss
from pat.media.colour import luminance
from pat.networks.denoiser import LowLightNetwork
from pat.networks.weights import load_denoiser, save_weights
from pat.sensors import NoiseLevel, generator_for


@dataclass(frozen=True, kw_only=True)
class DenoiserTraining(Recipe):
    """A recipe; windows of a batch are of each network."""

    photos: tuple[Path, ...] = ()
    """Folders of photographs."""
    out: Path = Path("runs/low-light")
    start: Path | None = None
    """File of weights to go on from."""
    steps: int = 7000
    batch: int = 64
    side: int = 128
    cache: Path | None = None
    """File (.npz) that caches the photographs."""


def train_denoiser(config: DenoiserTraining) -> Path:
    """Train both networks; returns the file of the weights.

    Raises ValueError where there are no photographs, or the folder holds a run of another recipe.
    """
    with config.folder():
        network = load_denoiser(config.start).requires_grad_(True) if config.start else LowLightNetwork()
        network = network.to(config.device)
        bank = PhotoBank.load(*config.photos, cache=config.cache, seed=config.seed)
        config.train(network, partial(losses, config, bank, network))
        facts = {"recipe": recipe_text(config)}
        save_weights(network, config.out / "best.safetensors", facts=facts, in_bytes=True)
    return config.out / "best.safetensors"


def losses(
    config: DenoiserTraining, bank: PhotoBank, network: LowLightNetwork, start: int
) -> Iterator[Tensor]:
    """Yield the loss of each step from one on."""
    for step in itertools.count(start):
        g = generator_for(config.seed, "views", step)
        colours = windows(bank, config.batch, config.side, g)
        losses = []
        for denoiser, ideal in ((network.band, luminance(colours)), (network.colour, colours)):
            recorded, deviation = noisy(ideal, noise_levels(len(ideal), g), g)
            with config.autocast():
                image = denoiser(recorded.to(config.device), deviation.to(config.device))
            losses.append(image_loss(image, ideal.to(config.device)))
        yield torch.stack(losses).mean()


def windows(bank: PhotoBank, count: int, side: int, g: Generator) -> Tensor:
    """Square parts of photographs (count, 3, side, side), some reduced, darkened, flipped and transposed."""
    windows = []
    for _ in range(count):
        texture, level = (below(n, g) for n in (len(bank), 2))
        w, h = bank.wh[texture, level].tolist()
        x, y = (below(max(n - side, 0) + 1, g) for n in (w, h))
        flips, gain = torch.randint(2, (3,), generator=g).tolist(), float(torch.rand((), generator=g))
        windows.append(flipped(bank.window(texture, level, (x, y), side), flips) * min(0.4 + 1.2 * gain, 1.0))
    return torch.stack(windows)


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


def flipped(image: Float[Tensor, "c n n"], flips: Sequence[int]) -> Float[Tensor, "c n n"]:
    """A square image upside down, left to right and transposed, each where its number is not 0."""
    image = image.flip([axis for axis in (1, 2) if flips[axis - 1]])
    return image.mT if flips[2] else image


if __name__ == "__main__":
    command(train_denoiser, DenoiserTraining, "python -m experiments.low_light.training")
