"""Training of features for matching: `python -m experiments.learned_matching.training RECIPE --photos DIR
--stereo DIR`."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import torch
import tyro
from torch import Tensor

from experiments.fit import fit, recipe_text
from pat.sensors import generator_for
from pat.support.locks import folder_lock
from pat.support.schema import from_document, read_yaml
from pat.synthesis.photos import PhotoBank

from .features import FeatureConfig, MatchingEncoder, load_features, save_features
from .loss import Precision, matching_loss
from .samples import MatchingRecording, MatchingSample, MatchingScenes, recorded_sample, tune_stereo

RECIPES = Path(__file__).parent
WEIGHTS = "features.safetensors"
KEPT = 24
"""Samples for validation."""


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
        encoder, scenes, kept = _new_encoder(config), _scenes(config, 1), validation_samples(config)
        recipe = recipe_text(config, "photos", "stereo")

        def losses(start: int) -> Iterator[Tensor]:
            for step in itertools.count(start):
                recording, queries = (generator_for(config.seed, n, step) for n in ("recording", "queries"))
                given = recorded_sample(scenes.of_step(step), recording, config.recording)
                full, half = matching_loss(encoder, given, queries, precision=config.precision)
                yield full.loss + half.loss

        def keep(averaged: MatchingEncoder, step: int) -> None:
            save_features(averaged, config.out / WEIGHTS, {"recipe": recipe, "step": str(step)})

        fit(
            encoder,
            losses,
            config.out,
            recipe,
            steps=config.steps,
            rate=config.rate,
            save=config.save,
            validate=config.validate,
            average=config.average,
            examine=partial(validated, kept=kept),
            keep=keep,
        )
    return config.out / WEIGHTS


def _new_encoder(config: FeatureTraining) -> MatchingEncoder:
    """Untrained, or as it is in `start`. Raises ValueError if that is of another network."""
    if config.start is None:
        return MatchingEncoder(config.network)
    encoder = load_features(config.start)
    if encoder.config != config.network:
        raise ValueError(f"start: {config.start} is of {encoder.config}, the recipe of {config.network}")
    return encoder.train().requires_grad_(True)


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


@torch.no_grad()
def validated(encoder: MatchingEncoder, kept: list[MatchingSample]) -> dict[str, float]:
    """Mean loss, and mean share within a pixel, at full and at half size."""
    found = [matching_loss(encoder, given, generator_for(0, "queries", i)) for i, given in enumerate(kept)]
    values = torch.stack([torch.stack([x for s in pair for x in s]) for pair in found]).nanmean(0)
    return dict(zip(("kept", "within one", "kept, half", "within one, half"), values.tolist()))


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
