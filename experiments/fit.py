"""Training of any network by any loss: one loop, whose runs continue where they stopped."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
import yaml
from torch import Tensor, nn
from torch.optim import Adam
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from arraygeom.runtime.atomic import write_text
from pat.app.cli.parser import parse
from pat.lab.training.checkpoints import collect, newest_checkpoint, restore, write_checkpoint
from pat.support.locks import folder_lock
from pat.support.schema import from_document, read_yaml, to_document

Losses = Callable[[int], Iterator[Tensor]]
"""The loss of each step from a given one on, computed when it is asked for."""
AVERAGE = 300
"""Time constant of the averaged weights, steps."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Options that training runs of windows have in common. The same command continues a run that stopped."""

    out: Path
    """Folder for weights, checkpoints, and what else a run keeps."""
    steps: int
    """Steps of training."""
    batch: int
    """Windows in a batch."""
    side: int
    """Side of a window, pixels."""
    rate: float = 1e-3
    """Learning rate of Adam, which falls along half a cosine."""
    save: int = 250
    """Steps between checkpoints."""
    seed: int = 0
    """Random seed."""
    device: str = "cpu"
    """Where training runs."""

    @contextmanager
    def folder(self) -> Iterator[None]:
        """The run's folder, with its recipe, for one process. Raises ValueError if it holds another run."""
        with folder_lock(self.out):
            file, recipe = self.out / "recipe.yaml", recipe_of(self)
            if not file.exists():
                write_text(file, yaml.safe_dump(recipe, sort_keys=False))
            elif (other := read_yaml(file)) != recipe:
                raise ValueError(f"{self.out} holds a run of another recipe ({other}): give another --out")
            torch.manual_seed(self.seed)
            yield

    def autocast(self) -> torch.autocast:
        """Half precision where training is not on a CPU."""
        return torch.autocast(self.device, torch.bfloat16, enabled=self.device != "cpu")

    def train(self, network: nn.Module, losses: Losses) -> None:
        """Train a network, or the rest of a run, and leave the averaged weights in it, on the CPU.

        The rate falls along half a cosine. The mean loss is logged with each checkpoint, every `save` steps.
        Raises RuntimeError if a gradient is not finite.
        """
        out, steps, step = self.out / "training", self.steps, 0
        averaged = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(1 - 1 / AVERAGE))
        adam = Adam(network.parameters(), lr=self.rate, betas=(0.9, 0.99))
        if former := newest_checkpoint(out / "checkpoints"):
            restore(former, network, adam, averaged)
            step = former.facts["step"]
        given = losses(step)
        since_save: list[float] = []
        while step < steps:
            for group in adam.param_groups:
                group["lr"] = self.rate * min(0.5 + 0.5 * math.cos(math.pi * step / steps), (step + 1) / 100)
            loss = next(given)
            adam.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0, error_if_nonfinite=True)
            adam.step()
            averaged.update_parameters(network)
            since_save.append(float(loss.detach()))
            step += 1
            done = step == steps
            if step % self.save == 0 or done:
                _log(out, step, steps, fmean(since_save))
                since_save = []
                state = {"step": step, "best": 0.0, "minutes": 0.0, "done": done, "recipe": ""}
                write_checkpoint(out / "checkpoints", collect(network, adam, averaged, state))
        network.load_state_dict(averaged.module.state_dict())
        network.cpu()


def command(train: Callable[[Any], Path], recipe: type[Recipe], prog: str) -> None:
    """Train by `[RECIPE.yaml] [--name value ...]`, and print the file of the weights; what is wrong with it
    ends in one line."""
    arguments = sys.argv[1:]
    try:
        base = read_recipe(recipe, arguments.pop(0)) if arguments and arguments[0][:1] != "-" else None
        print(train(parse(recipe, arguments, prog=prog + " [RECIPE.yaml]", base=base)))
    except (ValueError, OSError) as error:
        sys.exit(f"{prog}: {error}")


def read_recipe(kind: type[Recipe], path: str) -> Recipe:
    """A recipe from a YAML file. Raises ValueError naming the file and the entry, OSError for no file."""
    document = read_yaml(path)
    try:
        return from_document(kind, document)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _log(out: Path, step: int, steps: int, loss: float) -> None:
    """Print the mean loss, and append it to the run's log.jsonl."""
    print(f"{out.name}: step {step} of {steps}, mean loss {loss:.4f}", flush=True)
    out.mkdir(parents=True, exist_ok=True)
    with (out / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps({"step": step, "mean loss": round(loss, 4)}) + "\n")


def recipe_of(config: Any) -> dict[str, Any]:
    """A recipe without the entries that may differ between a run and its continuation."""
    left_out = {"out", "cache", "save", "device"}
    return {k: v for k, v in to_document(config, defaults=True).items() if k not in left_out}


def recipe_text(config: Any) -> str:
    """`recipe_of` for the facts of weights."""
    return json.dumps(recipe_of(config))
