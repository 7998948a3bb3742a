"""Ranges of what the convolutions of `mono-colour` are given, so that they can compute in 8 bits.

`python -m experiments.ranges --middlebury FOLDER` measures them, after a training, on every third pair of the
tune half under some conditions, and writes them into the weights file. What the rounding changes of the other
pairs goes to tests/benchmarks/RESULTS_int8.md.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import partial
from pathlib import Path
from statistics import fmean, median

import tyro

from experiments.evaluation.commands import finished
from experiments.evaluation.conditions import CONDITIONS
from experiments.evaluation.halves import of_half
from pat.fusion.fuse import FuseSettings
from pat.lab.data.pairs import StereoPair, middlebury_pairs
from pat.lab.evaluation.protocols import rectified_fusion
from pat.lab.evaluation.tables import markdown_table
from pat.networks.weights import SHIPPED, Network, load_weights
from pat.support.eight_bits import measured, names, round_to_eight_bits
from pat.support.metrics import score
from pat.support.tensor_files import read_tensors, write_tensors

RESULTS = Path("tests/benchmarks/RESULTS_int8.md")
UNDER = ("ideal", "x1", "x4", "x8", "alpha random", "beta x .6", "200 electrons", "50 electrons")


def main(middlebury: Path) -> None:
    """Measure, compare and write.

    Args:
        middlebury: Folder of Middlebury's pairs.
    """
    path = SHIPPED / "mono-colour.safetensors"
    network, pairs = load_weights(path), list(of_half(middlebury_pairs(middlebury), "tune"))
    with measured(network):
        for pair in pairs[::3]:
            for name in UNDER:
                psnr(network, pair, name)
    rounded = deepcopy(network)
    round_to_eight_bits(rounded)
    rows = [compared(network, rounded, [p for i, p in enumerate(pairs) if i % 3], name) for name in UNDER]
    heads = "condition", "PSNR, dB", "of single pairs", "time of a frame"
    finished(RESULTS, markdown_table(heads, rows))
    tensors, facts = read_tensors(path)
    state = network.state_dict()
    write_tensors(path, tensors | {name: state[name] for name in names(network)}, facts)


def compared(
    network: Network, rounded: Network, pairs: Sequence[StereoPair], name: str
) -> tuple[str, str, str, str]:
    """What rounding changes under a condition: PSNR in the mean, least and most; time as a share."""
    changes, times = [], []
    for pair in pairs:
        psnr(network, pair, name)
        (before, slow), (now, fast) = (timed(partial(psnr, one, pair, name)) for one in (network, rounded))
        changes.append(now - before)
        times.append(fast / slow)
    spread = f"{min(changes):+.3f} to {max(changes):+.3f}"
    return name, f"{fmean(changes):+.3f}", spread, f"{median(times):.2f}"


def timed(work: Callable[[], float]) -> tuple[float, float]:
    """What it gives, and seconds of the processor."""
    begin = time.process_time()
    return work(), time.process_time() - begin


def psnr(network: Network, pair: StereoPair, name: str) -> float:
    """Of a pair fused under a condition."""
    condition = CONDITIONS[name]
    task = condition.recorded(pair)
    noise = None if condition.noise is None else dict.fromkeys(("alpha", "beta"), condition.noise)
    assert pair.max_disparity is not None
    fused = rectified_fusion(network, settings=FuseSettings(noise=noise))(
        task.alpha, task.beta, pair.max_disparity
    )
    return score(fused.image, task.ground_truth).psnr


if __name__ == "__main__":
    tyro.cli(main)
