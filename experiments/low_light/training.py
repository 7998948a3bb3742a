"""Training of the denoisers: `python -m experiments.low_light.training --photos DIR --out runs/low-light`.

First those of single views, on photographs with noise of random kind and level; then that of the fused image,
on layered scenes that are recorded with such noise, denoised view by view, and fused.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import torch
import tyro
from torch import Generator, Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from pat.media.colour import luminance
from pat.networks.denoiser import LowLightNetwork
from pat.networks.weights import load_denoiser, load_weights, save_weights
from pat.sensors import generator_for
from pat.support.locks import folder_lock
from pat.synthesis.photos import PhotoBank
from pat.synthesis.rigs import below
from pat.training.checkpoints import collect, newest_checkpoint, restore, write_checkpoint
from pat.training.losses import image_loss

from .noisy_scenes import NoisyScenes, flipped, noise_levels, noisy

AVERAGE = 300
"""Time constant, in steps, of the weight average that is saved."""
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
            losses = partial(view_losses, config, bank, network)
            single.load_state_dict(fit(config, "views", single, losses, config.steps[0]).state_dict())
            _save(network, config, config.out / VIEWS)
        network.eval().requires_grad_(False)
        network.fused.train().requires_grad_(True)
        scenes = NoisyScenes(bank, load_weights(config.fusion), network, config.seed)
        losses = partial(fused_losses, config, scenes, network)
        fused = fit(config, "fused", network.fused, losses, config.steps[1])
        network.fused.load_state_dict(fused.state_dict())
        _save(network, config, config.out / FUSED)
    return config.out / FUSED


Losses = Callable[[int], Iterator[Tensor]]
"""The loss of each step from a given one on, computed when it is asked for."""


def view_losses(
    config: DenoiserTraining, bank: PhotoBank, network: LowLightNetwork, start: int
) -> Iterator[Tensor]:
    """Of the denoisers of single views, on photographs."""
    for step in range(start, 2**62):
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


def fit(config: DenoiserTraining, name: str, network: nn.Module, losses: Losses, steps: int) -> nn.Module:
    """Train a network for so many steps, or the rest of them; returns it with averaged weights."""
    folder = config.out / name
    average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(1 - 1 / AVERAGE))
    adam = torch.optim.Adam(network.parameters(), lr=config.rate, betas=(0.9, 0.99))
    step = _restored(config, folder, network, adam, average)
    total = 0.0
    found = losses(step)
    while step < steps:
        for group in adam.param_groups:
            group["lr"] = config.rate * min(0.5 + 0.5 * math.cos(math.pi * step / steps), (step + 1) / 100)
        loss = next(found)
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0, error_if_nonfinite=True)
        adam.step()
        average.update_parameters(network)
        step, total = step + 1, total + float(loss.detach())
        if step % config.save == 0 or step == steps:
            print(f"{name}: step {step} of {steps}, mean loss {total / config.save:.4f}", flush=True)
            total = 0.0
            facts = {
                "step": step,
                "best": 0.0,
                "minutes": 0.0,
                "done": step == steps,
                "recipe": _recipe(config),
            }
            write_checkpoint(folder, collect(network, adam, average, facts))
    return average.module


def _restored(
    config: DenoiserTraining, folder: Path, network: nn.Module, adam: torch.optim.Adam, average: AveragedModel
) -> int:
    """Put back the last checkpoint of the same run, if there is one; returns its step."""
    former = newest_checkpoint(folder)
    if former is None:
        return 0
    if former.facts["recipe"] != _recipe(config):
        raise ValueError(
            f"{folder} holds a run of another recipe ({former.facts['recipe']}): give another --out"
        )
    restore(former, network, adam, average)
    return int(former.facts["step"])


def _recipe(config: DenoiserTraining) -> str:
    shown = {name: value for name, value in asdict(config).items() if name not in ("out", "cache", "save")}
    return json.dumps(shown, default=str)


def _save(network: LowLightNetwork, config: DenoiserTraining, path: Path) -> None:
    """Write weights in half precision."""
    copy = LowLightNetwork(network.config)
    copy.load_state_dict(network.state_dict())
    save_weights(copy.half(), path, facts={"recipe": _recipe(config)})


if __name__ == "__main__":
    print(train_denoiser(tyro.cli(DenoiserTraining, prog="python -m experiments.low_light.training")))
