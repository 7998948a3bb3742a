"""Samples a second of a training step of recipes' networks, in each precision, and of making their scenes.

    python -m tests.benchmarks.bench_training

Times are seconds of the processor of this process, on one thread, so that other work on the machine matters
little: median (least to most) of the repeats. `bench_step` compares a step with the authors'.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import count, islice
from statistics import median

import torch

from pat.app.cli.parser import script
from pat.lab.evaluation.ablation import sample_photographs
from pat.lab.training.config import TrainConfig, load_config
from pat.lab.training.losses import Objective
from pat.lab.training.samples import Sample, SampleSource, source_of
from pat.networks.paper import PAT
from pat.networks.weights import set_precision
from tests.benchmarks.printed import spread, timed


def source(config: TrainConfig) -> SampleSource:
    return source_of(config, sample_photographs(), 0)


def stepped(objective: Objective, given: Sample, repeats: int) -> list[float]:
    """Seconds of steps."""
    optimiser = torch.optim.Adam(objective.parameters(), lr=0.0)

    def step() -> None:
        optimiser.zero_grad()
        objective(given).backward()
        optimiser.step()

    return timed(step, repeats=repeats)[0]


def report(name: str, seconds: list[float], samples: int) -> None:
    print(f"{name:42s} {spread(seconds, 3)}  {samples / median(seconds):6.2f} samples/s", flush=True)


HOW = {"float32": (False, False), "bfloat16": (True, False), "compiled": (False, True)}
"""Convolutions: in bfloat16 or not, compiled or not."""


def measure(name: str, repeats: int) -> None:
    """Print the figures of a recipe's network."""
    config = replace(load_config(name), reuse=1.0)
    made = source(config)
    given, numbers = next(made(1)), count(1)
    print(f"\n{name}, {config.batch} samples of {config.hw[1]} x {config.hw[0]}, one step:\n")
    for how, (half, compiled) in HOW.items():
        objective = Objective(prepared(config, half=half, compiled=compiled), config.loss)
        report(how, stepped(objective, given, repeats), config.batch)
    (scenes,) = timed(lambda: list(islice(made.steps([0], start=next(numbers)), 1)), repeats=repeats)
    report("making new scenes, fields included", scenes, config.batch)


def prepared(config: TrainConfig, *, half: bool, compiled: bool) -> PAT:
    """A new network whose convolutions compute as `precision` and `compile` have them."""
    torch.manual_seed(0)
    network = PAT(config.network)
    set_precision(network, "bfloat16" if half else "float32", compiled=compiled)
    return network


def main(repeats: int = 3, names: tuple[str, ...] = ("pat-supervised", "paper-2")) -> None:
    """Measure and print the networks of recipes."""
    torch.set_num_threads(1)
    for name in names:
        measure(name, repeats)


if __name__ == "__main__":
    script(main)
