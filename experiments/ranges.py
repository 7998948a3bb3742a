"""Ranges of what the convolutions of the shipped weights are given, so that they compute in 8 bits.

`python -m experiments.ranges --middlebury FOLDER` measures them, after a training, on every third pair of the
tune half under some conditions, and writes them into the weights files. Of the other pairs it prints what the
rounding changes. Not those of the
denoiser, which loses by it where there is the least light.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import fmean

import torch
import tyro
from safetensors import safe_open
from safetensors.torch import load_file
from torch import nn

from experiments.evaluation.conditions import CONDITIONS
from experiments.evaluation.halves import of_half
from pat.data.pairs import StereoPair, middlebury_pairs
from pat.evaluation.metrics import score
from pat.evaluation.protocols import StereoResult, rectified_fusion
from pat.evaluation.stereo import disparity_errors
from pat.matching.choice import FITTED, fitted_choice
from pat.networks.weights import SHIPPED, Network, load_weights
from pat.support.eight_bits import RANGE, measured
from pat.support.tensor_files import write_tensors

UNDER = ("ideal", "x1", "x4", "x8", "alpha random", "beta x .6", "200 electrons", "50 electrons")


def main(middlebury: Path) -> None:
    """Measure, compare and write.

    Args:
        middlebury: Folder of Middlebury's pairs.
    """
    network, choice = load_weights("mono-colour"), fitted_choice()
    parts = {SHIPPED / "mono-colour.safetensors": network, FITTED: choice}
    pairs = list(of_half(middlebury_pairs(middlebury), "tune"))
    with all_measured(list(parts.values())):
        for pair in pairs[::3]:
            for name in UNDER:
                figures(network, pair, name)
    found = {path: ranges(part) for path, part in parts.items()}
    for name in UNDER:
        others = [pair for i, pair in enumerate(pairs) if i % 3]
        rounded = [figures(network, pair, name) for pair in others]
        with all_measured(list(parts.values())):
            exact = [figures(network, pair, name) for pair in others]
        for path, part in parts.items():
            part.load_state_dict(part.state_dict() | found[path])
        for what, now, before in zip(("PSNR, dB", "depth, points"), zip(*rounded), zip(*exact)):
            by = [a - b for a, b in zip(now, before)]
            print(f"{name}: {what}: {fmean(by):+.3f}, {min(by):+.3f} to {max(by):+.3f}", flush=True)
    for path, some in found.items():
        write(path, some)


def figures(network: Network, pair: StereoPair, name: str) -> tuple[float, float]:
    """PSNR of a pair fused under a condition, and the percentage of disparities within a pixel."""
    condition = CONDITIONS[name]
    task = condition.recorded(pair)
    noise = None if condition.noise is None else dict.fromkeys(("alpha", "beta"), condition.noise)
    assert pair.max_disparity is not None
    assert pair.disparity is not None
    fused = rectified_fusion(network, noise=noise)(task.alpha, task.beta, pair.max_disparity)
    assert isinstance(fused, StereoResult)
    assert fused.disparity is not None
    _, within = disparity_errors(fused.disparity, pair.disparity)
    return score(fused.image, task.ground_truth).psnr, 100 * (within or 0.0)


@contextmanager
def all_measured(networks: Sequence[nn.Module]) -> Iterator[None]:
    """`measured` of several networks."""
    with ExitStack() as stack:
        for network in networks:
            stack.enter_context(measured(network))
        yield


def ranges(network: nn.Module) -> dict[str, torch.Tensor]:
    """By name in the network's state."""
    return {name: value for name, value in network.state_dict().items() if name.endswith(RANGE)}


def write(path: Path, some: dict[str, torch.Tensor]) -> None:
    """A weights file with these ranges."""
    with safe_open(path, framework="pt") as file:
        facts = file.metadata()
    write_tensors(path, load_file(path) | some, facts)


if __name__ == "__main__":
    tyro.cli(main)
