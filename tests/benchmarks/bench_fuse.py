"""Measures fusing a whole frame: `python -m tests.benchmarks.bench_fuse [--scale 0.5] [--threads 2]`.

The array "wide field - narrow field" at a part of its size, with smooth random pictures: seconds of the survey and of
the network, what part of the latter convolutions take, and at what rate, beside the rate of this machine's matrix
products with as many threads in the same run. `--full-runs` also fuses the rendered frame of 4024x3036 under caps of
2, 4 and 8 GiB (`pat systems run wide-narrow --full --max-memory ...`), and prints what that took.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from statistics import median

import torch
from torch.nn.functional import interpolate
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

import pat.fuse
from arraygeom import Rig
from pat.fuse import fuse
from pat.systems import load_system, run_system
from pat.tiles import survey_tiles, surveyed
from pat.weights import load_weights

SIDE = 2048
CAPS = ("4GiB", "2GiB", "8GiB")


def rig(scale: float) -> Rig:
    """The system's rig, both cameras `scale` times the size."""
    found = load_system("wide-narrow").rig
    for name in found.names:
        found = found.resize(name, tuple(max(round(n * scale / 32) * 32, 64) for n in found[name].hw))
    return found


def picture(channels: int, hw: tuple[int, int], seed: int) -> torch.Tensor:
    """Blobs of some pixels."""
    rough = torch.rand(1, channels, hw[0] // 6, hw[1] // 6, generator=torch.Generator().manual_seed(seed))
    return interpolate(rough, hw, mode="bicubic", align_corners=False)[0].clamp(0, 1)


def matmul_rate() -> float:
    """GFLOP/s of the product of two square matrices, the median of seven."""
    a, b = torch.rand(2, SIDE, SIDE)
    times = []
    for _ in range(7):
        begin = time.perf_counter()
        a @ b
        times.append(time.perf_counter() - begin)
    return 2 * SIDE**3 / median(times) / 1e9


def measure(scale: float) -> dict[str, str]:
    """Survey and network by themselves, then convolutions within the latter."""
    array, network = rig(scale), load_weights("mono-colour")
    hw = array["narrow"].hw
    images = {"narrow": picture(1, hw, 0), "wide": picture(3, array["wide"].hw, 1)}
    own = images["narrow"][None]
    beta = pat.fuse._prepare(network, array.pair("narrow", "wide"), images["wide"][None], None, None, "wide")
    small = rig(0.1)
    fuse(network, small, {n: picture(i.shape[0], small[n].hw, 2) for n, i in images.items()}, alpha="narrow")
    begin = time.perf_counter()
    beta = surveyed(network, own, beta, survey_tiles(network, hw))
    surveying = time.perf_counter() - begin
    whole = pat.fuse.Tile((0, hw[0], 0, hw[1]), (0, hw[0], 0, hw[1]))
    begin = time.perf_counter()
    pat.fuse._fuse_tile(network, own, [beta], whole)
    fusing = time.perf_counter() - begin
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        pat.fuse._fuse_tile(network, own, [beta], whole)
    own_times = {event.key: event.self_cpu_time_total / 1e6 for event in profiled.key_averages()}
    convolving = sum(t for name, t in own_times.items() if "conv" in name)
    with FlopCounterMode(display=False) as counter:
        pat.fuse._fuse_tile(network, own, [beta], whole)
    flops = sum(n for operation, n in counter.get_flop_counts()["Global"].items() if "conv" in str(operation))
    rate = matmul_rate()
    return {
        "alpha, pixels": f"{hw[1]}x{hw[0]}",
        "survey (consensus)": f"{surveying:.2f} s",
        "network": f"{fusing:.2f} s",
        "both, of 4024x3036 in one piece": f"{(surveying + fusing) * 4024 * 3036 / (hw[0] * hw[1]):.0f} s",
        "convolutions in the network": f"{convolving:.2f} s, {convolving / sum(own_times.values()):.0%} of its time",
        "rate of the convolutions": f"{flops / convolving / 1e9:.0f} GFLOP/s",
        "rate of matrix products": f"{rate:.0f} GFLOP/s ({SIDE} squared)",
        "the one to the other": f"{flops / convolving / 1e9 / rate:.0%}",
    }


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=0.5)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--full-runs", action="store_true", help="also 4024x3036 under 2, 4 and 8 GiB")
    parser.add_argument("--out", type=Path, default=Path("out/systems/wide-narrow-full"))
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    print(f"{given.threads} threads, load before: {os.getloadavg()[0]:.1f}")
    print("\n".join(f"{name:32} {value}" for name, value in measure(given.scale).items()), flush=True)
    for cap in CAPS if given.full_runs else ():
        result = run_system("wide-narrow", given.out, full=True, max_memory=cap)
        print(f"\n{cap}\n{result.table}", flush=True)


if __name__ == "__main__":
    main()
