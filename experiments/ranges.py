"""What the convolutions of the shipped weights are given, measured, so that they compute in 8 bits.

`python -m experiments.ranges --data FOLDER` fuses pairs of Middlebury's tune half under some conditions, and
writes the ranges into the weights files: after each training.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import torch
import tyro
from safetensors import safe_open
from torch import nn

from experiments.evaluation.conditions import CONDITIONS
from experiments.evaluation.halves import of_half
from pat.data.pairs import middlebury_pairs
from pat.evaluation.protocols import rectified_fusion
from pat.fusion.low_light import shipped_denoiser
from pat.matching.choice import FITTED, fitted_choice
from pat.networks.weights import DENOISER, SHIPPED, load_weights
from pat.support.eight_bits import measured
from pat.support.tensor_files import write_tensors

UNDER = ("ideal", "x1", "x4", "x8", "alpha random", "beta x .6", "200 electrons", "50 electrons")
EVERY = 3
"""Of the pairs so many-th is fused."""


def measure(data: Path) -> None:
    """Measure and write."""
    network, choice, denoiser = load_weights("mono-colour"), fitted_choice(), shipped_denoiser()
    of = {SHIPPED / "mono-colour.safetensors": network, FITTED: choice, DENOISER: denoiser}
    with ExitStack() as stack:
        for part in of.values():
            stack.enter_context(measured(part))
        for pair in list(of_half(middlebury_pairs(data), "tune"))[::EVERY]:
            for name in UNDER:
                condition = CONDITIONS[name]
                task = condition.recorded(pair)
                noise = {} if condition.noise is None else {"noise": dict.fromkeys(("alpha", "beta"), condition.noise)}
                rectified_fusion(network, **noise)(task.alpha, task.beta, pair.max_disparity)
                print(f"{pair.name}, {name}")
    for path, part in of.items():
        with_ranges(path, part)


def with_ranges(path: Path, network: nn.Module) -> None:
    """Write a weights file again, with these ranges."""
    with safe_open(path, framework="pt") as file:
        facts = file.metadata() or {}
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    state = network.state_dict()
    ranges = {name: state[name] for name in state if name.endswith("input_range")}
    write_tensors(path, tensors | ranges, facts)


if __name__ == "__main__":
    tyro.cli(measure)
