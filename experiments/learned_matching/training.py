"""Training of features for matching: `python -m experiments.learned_matching.training RECIPE --photos DIR
--stereo DIR`."""

from __future__ import annotations

import csv
import json
import math
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import cast

import torch
import tyro
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from pat.sensors import generator_for
from pat.support.locks import folder_lock
from pat.support.schema import from_document, read_yaml
from pat.synthesis.photos import PhotoBank
from pat.training.checkpoints import collect, newest_checkpoint, restore, write_checkpoint

from .features import FeatureConfig, MatchingEncoder, load_features, save_features
from .loss import Precision, matching_loss
from .samples import MatchingRecording, MatchingSample, MatchingScenes, recorded_sample, tune_stereo

RECIPES = Path(__file__).parent
WEIGHTS, LOG = "features.safetensors", "log.csv"
KEPT = 24
"""Samples for validation."""
UNSEEN = ("out", "cache", "save", "validate", "photos", "stereo")
"""Entries that may differ between a run and its continuation."""


@dataclass(frozen=True)
class FeatureTraining:
    """A recipe. The same command continues a run that stopped; its result is an uninterrupted run's."""

    photos: tuple[Path, ...] = ()
    """Folders of photographs: the textures of layered scenes."""
    stereo: Path | None = None
    """Folder of Middlebury's pairs; those of the tune half are learned from."""
    aside: tuple[str, ...] = ()
    """Pairs of the tune half that are for validation only, by the ends of their names."""
    out: Path = Path("runs/matching")
    """Folder for weights, checkpoints and the log."""
    start: Path | None = None
    """File of features to go on from."""
    network: FeatureConfig = field(default_factory=FeatureConfig)
    recording: MatchingRecording = field(default_factory=MatchingRecording)
    pairs: float = 0.3
    """Share of the batches that are windows of stereo pairs."""
    steps: int = 20000
    """Steps of the whole run."""
    batch: int = 2
    """Scenes in a step."""
    hw: tuple[int, int] = (128, 256)
    """Height and width of alpha in the scenes."""
    rate: float = 2e-3
    """Learning rate of Adam, which falls along half a cosine."""
    average: int = 300
    """Time constant, in steps, of the weight average that is validated and saved."""
    held_out: int = 12
    """One photograph in so many is for validation only."""
    validate: int = 500
    """Steps between validations."""
    save: int = 250
    """Steps between checkpoints."""
    precision: Precision = "bfloat16"
    """Precision of convolutions while training."""
    seed: int = 0
    """Random seed."""
    cache: Path | None = None
    """File (.npz) that caches the photographs."""


def train_features(config: FeatureTraining) -> Path:
    """Train; returns the file of the averaged weights of the last step.

    Raises ValueError where there are no photographs, or the folder holds a run of another recipe.
    """
    with folder_lock(config.out):
        torch.manual_seed(config.seed)
        encoder = _new_encoder(config)
        average = AveragedModel(encoder, multi_avg_fn=get_ema_multi_avg_fn(1 - 1 / config.average))
        adam = torch.optim.Adam(encoder.parameters(), lr=config.rate, betas=(0.9, 0.99))
        step = _restored(config, encoder, adam, average)
        scenes, kept = _scenes(config, 1), validation_samples(config)
        if step == 0:
            _log(config, 0, [math.nan] * 2, validated(encoder, kept))
        while step < config.steps:
            losses = _advance(config, step, encoder, adam, average, sample_of(config, scenes, step))
            step += 1
            if step % config.validate == 0 or step == config.steps:
                _log(config, step, losses, validated(cast(MatchingEncoder, average.module), kept))
            if step % config.save == 0 or step == config.steps:
                said = {"recipe": _recipe(config), "step": str(step)}
                save_features(cast(MatchingEncoder, average.module), config.out / WEIGHTS, said)
                facts = {"step": step, "best": 0.0, "minutes": 0.0, "done": step == config.steps}
                state = collect(encoder, adam, average, facts | {"recipe": _recipe(config)})
                write_checkpoint(config.out / "checkpoints", state)
    return config.out / WEIGHTS


def _new_encoder(config: FeatureTraining) -> MatchingEncoder:
    """Untrained, or as it is in `start`. Raises ValueError if that is of another network."""
    if config.start is None:
        return MatchingEncoder(config.network)
    encoder = load_features(config.start)
    if encoder.config != config.network:
        raise ValueError(f"start: {config.start} is of {encoder.config}, the recipe of {config.network}")
    return encoder.train().requires_grad_(True)


def sample_of(config: FeatureTraining, scenes: MatchingScenes, step: int) -> MatchingSample:
    """What step `step` sees."""
    g = generator_for(config.seed, "recording", step)
    return recorded_sample(scenes.of_step(step), g, config.recording)


def _scenes(config: FeatureTraining, number: int) -> MatchingScenes:
    """Scenes to learn from (1) or to validate on (2): other photographs, seeds and pairs."""
    n = config.held_out
    choose = (lambda i: i % n != 0) if number == 1 else (lambda i: i % n == 0)
    bank = PhotoBank.load(*config.photos, cache=config.cache, seed=config.seed, choose=choose)
    stereo = tune_stereo(config.stereo, config.aside, kept_aside=number == 2) if config.stereo else []
    pairs = config.pairs if number == 1 else 0.5
    seed = config.seed + number
    return MatchingScenes(bank, stereo, hw=config.hw, batch=config.batch, pairs=pairs, seed=seed)


def validation_samples(config: FeatureTraining) -> list[MatchingSample]:
    """The same whenever a run is continued."""
    scenes = _scenes(config, 2)
    draws = (generator_for(config.seed, "kept", i) for i in range(KEPT))
    return [recorded_sample(scenes.made(i), g, config.recording) for i, g in enumerate(draws)]


def _advance(
    config: FeatureTraining,
    step: int,
    encoder: MatchingEncoder,
    adam: torch.optim.Adam,
    average: AveragedModel,
    given: MatchingSample,
) -> list[float]:
    """One step of the optimiser; the losses at full and at half size."""
    for group in adam.param_groups:
        group["lr"] = config.rate * min(0.5 + 0.5 * math.cos(math.pi * step / config.steps), (step + 1) / 100)
    adam.zero_grad()
    g = generator_for(config.seed, "queries", step)
    found = matching_loss(encoder, given, g, precision=config.precision)
    sum((s.loss for s in found), torch.zeros(())).backward()
    nn.utils.clip_grad_norm_(encoder.parameters(), 1.0, error_if_nonfinite=True)
    adam.step()
    average.update_parameters(encoder)
    return [float(s.loss.detach()) for s in found]


@torch.no_grad()
def validated(encoder: MatchingEncoder, kept: list[MatchingSample]) -> list[float]:
    """Mean loss, and mean share within a pixel, at full and at half size."""
    found = [matching_loss(encoder, given, generator_for(0, "queries", i)) for i, given in enumerate(kept)]
    values = torch.stack([torch.stack([x for s in pair for x in s]) for pair in found])
    return values.nanmean(0).tolist()


def _log(config: FeatureTraining, step: int, losses: list[float], facts: list[float]) -> None:
    """A log line: the step's loss, then loss and share within a pixel in validation, full and half size."""
    path = config.out / LOG
    names = ("step", "loss", "loss, half", "kept", "within one", "kept, half", "within one, half", "time")
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow(names)
        writer.writerow([step, *(f"{x:.4f}" for x in (*losses, *facts)), f"{time.time():.0f}"])


def _restored(
    config: FeatureTraining,
    encoder: MatchingEncoder,
    adam: torch.optim.Adam,
    average: AveragedModel,
) -> int:
    """Put back the last checkpoint of the same run, if there is one; returns its step."""
    former = newest_checkpoint(config.out / "checkpoints")
    if former is None:
        return 0
    if former.facts["recipe"] != _recipe(config):
        other = former.facts["recipe"]
        raise ValueError(f"{config.out} holds a run of another recipe ({other}): give another --out")
    restore(former, encoder, adam, average)
    return int(former.facts["step"])


def _recipe(config: FeatureTraining) -> str:
    return json.dumps({k: v for k, v in asdict(config).items() if k not in UNSEEN}, default=str)


def command_line(arguments: list[str]) -> FeatureTraining:
    """`RECIPE [--name value ...]`: a recipe by name or file, and overrides of its values."""
    base = FeatureTraining()
    if arguments and not arguments[0].startswith("-"):
        path = next((p for p in (RECIPES / f"{arguments[0]}.yaml", Path(arguments[0])) if p.is_file()), None)
        if path is None:
            known = ", ".join(sorted(p.stem for p in RECIPES.glob("*.yaml")))
            raise FileNotFoundError(f"no recipe '{arguments[0]}': give a file or one of {known}")
        base, arguments = from_document(FeatureTraining, read_yaml(path)), arguments[1:]
    return tyro.cli(FeatureTraining, default=base, args=arguments, config=(tyro.conf.AvoidSubcommands,))


if __name__ == "__main__":
    print(train_features(command_line(sys.argv[1:])))
