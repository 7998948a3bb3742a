"""Measures fusing a whole frame: `python -m tests.benchmarks.bench_fuse [--scale 0.5] [--threads 2]`.

The array "wide field - narrow field" at a part of its size, with smooth random images: seconds of the
matching and of the network, what part of the latter convolutions take, and at what rate, beside the rate of
this machine's matrix products with as many threads in the same run. `--full-runs` instead fuses the rendered
frame of 4024x3036 under caps (`--caps 4GiB 8GiB 2GiB`; `python -m experiments systems run wide-narrow --full
--max-memory ...`), in 4 to 6 minutes of a core each on a machine that does nothing else, and compares what
comes out. Prints figures and puts them into
tests/benchmarks/RESULTS_fuse.md, each in its section, beside those that were there.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from pathlib import Path
from statistics import median
from typing import Literal

import torch
import tyro
from torch.nn.functional import interpolate
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from arraygeom import Rig
from arraygeom.atomic import write_text
from arraygeom.chunks import Tile
from experiments import load_system, run_system
from pat.evaluation.tables import markdown_table
from pat.fusion.fuse import fuse
from pat.fusion.inputs import frame_inputs
from pat.fusion.steps import steps_for
from pat.fusion.tiles import fuse_tile
from pat.fusion.views import Views
from pat.media.images import read_image
from pat.networks.protocol import matched_for
from pat.networks.weights import load_weights
from tests.benchmarks.printed import timed

SIDE = 2048
CAPS = ("4GiB", "8GiB", "2GiB")
RESULTS = Path(__file__).with_name("RESULTS_fuse.md")


def rig(scale: float) -> Rig:
    """The system's rig, both cameras `scale` times the size."""
    found = load_system("wide-narrow").rig
    for name in found.names:
        found = found.resize(name, tuple(max(round(n * scale / 32) * 32, 64) for n in found[name].hw))
    return found


def image(channels: int, hw: tuple[int, int], seed: int) -> torch.Tensor:
    """Blobs of some pixels."""
    rough = torch.rand(1, channels, hw[0] // 6, hw[1] // 6, generator=torch.Generator().manual_seed(seed))
    return interpolate(rough, hw, mode="bicubic", align_corners=False)[0].clamp(0, 1)


def matmul_rate() -> float:
    """GFLOP/s of the product of two square matrices, the median of seven."""
    a, b = torch.rand(2, SIDE, SIDE)
    (seconds,) = timed(lambda: a @ b, repeats=7, clock=time.perf_counter)
    return 2 * SIDE**3 / median(seconds) / 1e9


def measure(scale: float) -> dict[str, str]:
    """Matching and network by themselves, then convolutions within the latter."""
    array, network = rig(scale), load_weights("mono-colour")
    hw = array["narrow"].hw
    images = {"narrow": image(1, hw, 0), "wide": image(3, array["wide"].hw, 1)}
    views = Views.of(array, images, alpha="narrow")
    for step in steps_for(network, normalise=False):
        views = step(views).views
    frame = frame_inputs(network, views)
    small = rig(0.1)
    fuse(network, small, {n: image(i.shape[0], small[n].hw, 2) for n, i in images.items()}, alpha="narrow")
    begin = time.perf_counter()
    matches = matched_for(network, frame.inputs)
    matching = time.perf_counter() - begin
    whole = Tile((0, hw[0], 0, hw[1]), (0, hw[0], 0, hw[1]))
    begin = time.perf_counter()
    fuse_tile(network, frame, matches, whole)
    fusing = time.perf_counter() - begin
    with profile(activities=[ProfilerActivity.CPU]) as profiled:
        fuse_tile(network, frame, matches, whole)
    own_times = {event.key: event.self_cpu_time_total / 1e6 for event in profiled.key_averages()}
    convolving = sum(t for name, t in own_times.items() if "conv" in name)
    with FlopCounterMode(display=False) as counter:
        fuse_tile(network, frame, matches, whole)
    flops = sum(n for operation, n in counter.get_flop_counts()["Global"].items() if "conv" in str(operation))
    rate = matmul_rate()
    return {
        "alpha, pixels": f"{hw[1]}x{hw[0]}",
        "semi-global matching": f"{matching:.2f} s",
        "network": f"{fusing:.2f} s",
        "both, of 4024x3036 in one piece": f"{(matching + fusing) * 4024 * 3036 / (hw[0] * hw[1]):.0f} s",
        "convolutions in the network": f"{convolving:.2f} s, {convolving / sum(own_times.values()):.0%} of "
        "its time",
        "rate of the convolutions": f"{flops / convolving / 1e9:.0f} GFLOP/s",
        "rate of matrix products": f"{rate:.0f} GFLOP/s ({SIDE} squared)",
        "the one to the other": f"{flops / convolving / 1e9 / rate:.0%}",
    }


def full_run(cap: str, out: Path) -> str:
    """The frame at full size under a cap: scores, plan, memory, time, and difference from other caps."""
    before, threads = os.getloadavg()[0], os.environ.get("OMP_NUM_THREADS", "all")
    table = run_system("wide-narrow", out, full=True, max_memory=cap).table
    lines = [table, f"Threads: {threads}. Load {before:.1f} before, {os.getloadavg()[0]:.1f} after.", ""]
    kept = {other: out / f"fused_{other}.png" for other in CAPS}
    shutil.copyfile(out / "fused.png", kept[cap])
    own = read_image(kept.pop(cap))
    for other, file in kept.items():
        if file.is_file():
            off = (own - read_image(file)).abs()
            lines.append(
                f"Differs from that under {other} by at most {float(off.max()):.1e}, "
                f"mean {float(off.mean()):.1e}."
            )
    return "\n".join(lines)


def put(heading: str, text: str) -> None:
    """The section of that heading in the file of results, in place of the one that was there."""
    found = (
        RESULTS.read_text(encoding="utf-8")
        if RESULTS.is_file()
        else "# Fusing whole frames\n\nBy `python -m tests.benchmarks.bench_fuse`.\n"
    )
    sections = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", found, re.M | re.S))
    sections[heading] = f"\n{text.strip()}\n\n"
    start = found.partition("\n## ")[0].strip()
    body = "".join(f"## {name}\n{part}" for name, part in sections.items())
    write_text(RESULTS, f"{start}\n\n{body.strip()}\n")


def main(
    scale: float = 0.5,
    threads: int = len(os.sched_getaffinity(0)),
    full_runs: bool = False,
    caps: tuple[Literal["4GiB", "8GiB", "2GiB"], ...] = CAPS,
    out: Path = Path("out/systems/wide-narrow-full"),
) -> None:
    """Print the figures; with `full_runs` of 4024x3036 under caps of memory instead."""
    torch.set_num_threads(threads)
    for cap in caps if full_runs else ():
        text = full_run(cap, out)
        print(f"\n{cap}\n{text}", flush=True)
        put(f"wide-narrow, 4024x3036, under {cap}", text)
    if not full_runs:
        load = f"{threads} threads, load before: {os.getloadavg()[0]:.1f}\n"
        text = f"{load}\n{markdown_table(['', ''], measure(scale).items(), align='l')}"
        print(text)
        put(f"A part of the frame, {threads} threads", text)


if __name__ == "__main__":
    tyro.cli(main)
