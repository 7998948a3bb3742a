"""Training of the denoisers: `python -m experiments.low_light.training --photos DIR --out runs/low-light`.

First those of single views, on photographs with noise of random kind and level; then that of the fused image,
on layered scenes that are recorded with such noise, denoised view by view, and fused.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import torch
import tyro
from torch import Generator, Tensor, nn

from experiments.fit import Losses, fit, recipe_text
from pat.media.colour import luminance
from pat.networks.denoiser import LowLightNetwork
from pat.networks.weights import load_denoiser, load_weights, save_weights
from pat.sensors import generator_for
from pat.support.locks import folder_lock
from pat.synthesis.photos import PhotoBank
from pat.synthesis.rigs import below
from pat.training.losses import image_loss

from .noisy_scenes import NoisyScenes, flipped, noise_levels, noisy

VIEWS, FUSED = "views.safetensors", "best.safetensors"


@dataclass(frozen=True)
class DenoiserTraining:
    """A recipe. The same command continues a run that stopped; its result is an uninterrupted run's."""

    photos: tuple[Path, ...] = ()
    """Folders of photographs."""
    out: Path = Path("runs/low-light")
    """Folder for weights and checkpoints."""
    start: Path | None = None
    """File of weights to go on from."""
    fusion: str = "mono-colour"
    """Weights by which the scenes of the second part are fused."""
    steps: tuple[int, int] = (6000, 6000)
    """Steps of the denoisers of single views, and of that of the fused image."""
    batch: int = 32
    """Windows in a batch."""
    side: int = 64
    """Side of a window, pixels."""
    rate: float = 2e-3
    """Learning rate of Adam, which falls along half a cosine."""
    save: int = 250
    """Steps between checkpoints."""
    seed: int = 0
    """Random seed."""
    cache: Path | None = None
    """File (.npz) that caches the photographs."""
    precision: Literal["float32", "bfloat16"] = "bfloat16"
    """Precision of convolutions."""


def train_denoiser(config: DenoiserTraining) -> Path:
    """Train both parts; returns the file of the weights.

    Raises ValueError where there are no photographs, or the folder holds a run of another recipe.
    """
    with folder_lock(config.out):
        torch.manual_seed(config.seed)
        network = load_denoiser(config.start).requires_grad_(True) if config.start else LowLightNetwork()
        bank = PhotoBank.load(*config.photos, cache=config.cache, seed=config.seed)
        if config.steps[0]:
            single = nn.ModuleDict({"band": network.band, "colour": network.colour})
            _fit(config, 0, single, partial(view_losses, config, bank, network))
            _save(network, config, config.out / VIEWS)
        network.eval().requires_grad_(False)
        network.fused.train().requires_grad_(True)
        scenes = NoisyScenes(bank, load_weights(config.fusion), network, config.seed)
        _fit(config, 1, network.fused, partial(fused_losses, config, scenes, network))
        _save(network, config, config.out / FUSED)
    return config.out / FUSED


def _fit(config: DenoiserTraining, part: int, network: nn.Module, losses: Losses) -> None:
    """Train the first or the second part, and leave the averaged weights in the network."""
    averaged = fit(
        network,
        losses,
        config.out / ("views", "fused")[part],
        recipe_text(config),
        steps=config.steps[part],
        rate=config.rate,
        save=config.save,
        validate=config.save,
    )
    network.load_state_dict(averaged.state_dict())


def view_losses(
    config: DenoiserTraining, bank: PhotoBank, network: LowLightNetwork, start: int
) -> Iterator[Tensor]:
    """Of the denoisers of single views, on photographs."""
    for step in itertools.count(start):
        g = generator_for(config.seed, "views", step)
        halves = windows(bank, config.batch, config.side, g).split(-(-config.batch // 2))
        parts = [(d, x) for c in halves for d, x in ((network.band, luminance(c)), (network.colour, c))]
        given = [(d, x, *noisy(x, noise_levels(len(x), g), g)) for d, x in parts]
        with _autocast(config):
            found = [image_loss(d(recorded, deviation), x) for d, x, recorded, deviation in given]
        yield torch.stack(found).mean()


def fused_losses(
    config: DenoiserTraining, scenes: NoisyScenes, network: LowLightNetwork, start: int
) -> Iterator[Tensor]:
    """Of the denoiser of the fused image, on layered scenes."""
    for scene in scenes.steps(config.batch, config.side, start=start):
        with _autocast(config):
            image = network(scene.image, scene.alpha, scene.beta, scene.confidence)
        yield image_loss(image, scene.ground_truth)


def _autocast(config: DenoiserTraining) -> torch.autocast:
    return torch.autocast("cpu", torch.bfloat16, enabled=config.precision == "bfloat16")


def windows(bank: PhotoBank, count: int, side: int, g: Generator) -> Tensor:
    """Square parts of photographs (count, 3, side, side), some reduced, darkened, flipped and transposed."""
    found = []
    for _ in range(count):
        texture, level = (below(n, g) for n in (len(bank), 2))
        w, h = bank.wh[texture, level].tolist()
        x, y = (below(max(n - side, 0) + 1, g) for n in (w, h))
        flips, gain = torch.randint(2, (3,), generator=g).tolist(), float(torch.rand((), generator=g))
        image = flipped(bank.window(texture, level, (x, y), side), flips)
        found.append(image * min(0.4 + 1.2 * gain, 1.0))
    return torch.stack(found)


def _save(network: LowLightNetwork, config: DenoiserTraining, path: Path) -> None:
    """Write weights in half precision."""
    copy = LowLightNetwork(network.config)
    copy.load_state_dict(network.state_dict())
    save_weights(copy.half(), path, facts={"recipe": recipe_text(config)})


if __name__ == "__main__":
    print(train_denoiser(tyro.cli(DenoiserTraining, prog="python -m experiments.low_light.training")))
