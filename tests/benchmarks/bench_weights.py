"""Costs of each shipped network: parameters, operations of its convolutions, seconds of a processor.

python -m tests.benchmarks.bench_weights
"""

from __future__ import annotations

import torch
from torch.utils.flop_counter import FlopCounterMode

from pat.app.cli.parser import script
from pat.lab.evaluation.protocols import rectified_fusion
from pat.lab.evaluation.tables import markdown_row
from pat.networks.weights import SHIPPED, load_weights
from tests.benchmarks.printed import head, spread, timed

HW = (384, 448)
REPEATS = 5


def main() -> None:
    torch.set_num_threads(1)
    g = torch.Generator().manual_seed(0)
    alpha, beta = torch.rand(1, *HW, generator=g), torch.rand(3, HW[0] // 2, HW[1] // 2, generator=g)
    print(
        f"{HW[1]} x {HW[0]} pixels, one thread; seconds of the processor: median (least to most) of "
        f"{REPEATS}\n"
    )
    print(head("weights | parameters | GFLOP | seconds"))
    for path in sorted(SHIPPED.glob("*.safetensors")):
        network = load_weights(path)
        fuse = rectified_fusion(network)
        with FlopCounterMode(display=False) as counter:
            fuse(alpha, beta, 100.0)
        (seconds,) = timed(lambda: fuse(alpha, beta, 100.0), repeats=REPEATS)  # noqa: B023
        parameters = sum(p.numel() for p in network.parameters())
        flops = f"{counter.get_total_flops() / 1e9:.1f}"
        print(markdown_row([path.stem, f"{parameters:,}", flops, spread(seconds)]), flush=True)


if __name__ == "__main__":
    script(main)
