"""Measures attention: `python -m tests.benchmarks.bench_attention` prints a table and writes RESULTS.md
beside this file, atomically.

The compiled backend of each device runs against two usual ways to do the same: (a) index keys and values at
every position, matmul, softmax, matmul; (b) the same with `grid_sample`. Each measurement is a process of its
own, so that its peak memory is its own; the machine's float32 matmul rate and copy bandwidth are measured in
the same run. All repeat while it takes little time; the table has medians with the spread (fastest to
slowest). `--device cuda` measures a GPU only, `--quick` leaves the large sizes out; neither writes
RESULTS.md.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from arraygeom.runtime.atomic import write_text
from arraygeom.segments import Segments
from pat.app.cli.parser import script
from pat.attention import attend
from pat.lab.evaluation.tables import markdown_header, markdown_row
from pat.support.memory import peak_memory

RESULTS = Path(__file__).with_name("RESULTS.md")
REPEATS, ENOUGH = 9, 6.0
"""A measurement ends after so many repetitions or seconds, whichever comes first."""
GIB = 2**30
ONE_THREAD = "cpu, one thread"
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def field(ha: int, wa: int, samples: int, device: str) -> Segments:
    """Slanted segments of samples - 1 pixels, or as long as the image is wide: an epipolar field."""
    y, x = torch.meshgrid(torch.arange(ha).float(), torch.arange(wa).float(), indexing="ij")
    length = min(samples - 1, wa - 1)
    slope = min(0.06, (ha - 5) / length)
    start = torch.stack(
        [(x - length).clamp(0, wa - 1 - length), (y + 0.3).clamp(0, ha - 2 - slope * length)], -1
    )
    end = start + torch.tensor([length, slope * length])
    return Segments(start.to(device), end.to(device), torch.ones(ha, wa, dtype=torch.bool, device=device))


def index_everything(
    q: Tensor, k: Tensor, v: Tensor, segments: Segments, samples: int, interpolation: str
) -> Tensor:
    """(a): (b, d, h, w, l) keys and values, nearest, from images with channels first, as they usually are."""
    x, y = _pixels(k, segments, samples)
    keys, values = (t.contiguous()[:, :, y, x] for t in (k, v))
    weight = torch.einsum("bdhw,bdhwl->bhwl", q, keys).softmax(-1)
    return torch.einsum("bhwl,bdhwl->bdhw", weight, values)


def index_channels_last(
    q: Tensor, k: Tensor, v: Tensor, segments: Segments, samples: int, interpolation: str
) -> Tensor:
    """(a) at its best: whole rows of channels are copied, (b, h, w, l, d)."""
    x, y = _pixels(k, segments, samples)
    keys, values = (t.permute(0, 2, 3, 1)[:, y, x] for t in (k, v))
    weight = torch.matmul(keys, q.permute(0, 2, 3, 1)[..., None]).squeeze(-1).softmax(-1)
    return torch.matmul(weight[..., None, :], values).squeeze(-2).permute(0, 3, 1, 2)


def _pixels(k: Tensor, segments: Segments, samples: int) -> tuple[Tensor, Tensor]:
    xy = (segments.positions(samples).xy + 0.5).floor().long()
    return xy[..., 0].clamp(0, k.shape[3] - 1), xy[..., 1].clamp(0, k.shape[2] - 1)


def grid_sampled(
    q: Tensor, k: Tensor, v: Tensor, segments: Segments, samples: int, interpolation: str
) -> Tensor:
    """(b): the same with `grid_sample`, nearest or bilinear."""
    b, _, ha, wa = q.shape
    xy = segments.positions(samples).xy.reshape(1, ha * wa, samples, 2)
    wh = xy.new_tensor([k.shape[3] - 1, k.shape[2] - 1])
    grid = (2 * xy / wh - 1).expand(b, -1, -1, -1).to(q.dtype)
    keys, values = (grid_sample(t, grid, mode=interpolation, align_corners=True) for t in (k, v))
    weight = torch.einsum("bdn,bdnl->bnl", q.flatten(2), keys).softmax(-1)
    return torch.einsum("bnl,bdnl->bdn", weight, values).unflatten(2, (ha, wa))


def fused(backend: str):
    def run(q: Tensor, k: Tensor, v: Tensor, segments: Segments, samples: int, interpolation: str) -> Tensor:
        return attend(q, k, v, segments, samples=samples, interpolation=interpolation, backend=backend)

    return run


METHODS = {
    "index": index_everything,
    "index, channels last": index_channels_last,
    "grid_sample": grid_sampled,
} | {name: fused(name.split(",")[0]) for name in ("reference", "cpu", ONE_THREAD, "triton")}


def measure(job: Job) -> dict[str, float]:
    """Times one job in this process, and its peak memory: beyond inputs, and of all the process."""
    device, dtype = job.device, DTYPES[job.dtype]
    torch.manual_seed(0)
    if job.method == ONE_THREAD:
        torch.set_num_threads(1)
    shape = job.ha, job.wa, job.d
    q, k, v = (features(*shape, dtype, device).requires_grad_(job.backward) for _ in range(3))
    segments, run = field(job.ha, job.wa, job.samples, device), METHODS[job.method]
    cotangent = torch.ones_like(q) if job.backward else None

    def once() -> float:
        _wait(device)
        begin = time.perf_counter()
        out = run(q, k, v, segments, job.samples, job.interpolation)
        if job.backward:
            torch.autograd.grad(out, (q, k, v), cotangent)
        _wait(device)
        return time.perf_counter() - begin

    if job.compiled:
        _warm(run, device, dtype, job)
    before = _peak(device, reset=True)
    times = [once()]
    peak = _peak(device)
    while len(times) < job.repeats and sum(times) < ENOUGH:
        times.append(once())
    found = {"time": statistics.median(times), "low": min(times), "high": max(times)}
    return found | {"extra": peak - before, "peak": peak, "unit": 4 * q.numel() * q.element_size()}


def features(ha: int, wa: int, d: int, dtype: torch.dtype, device: str) -> Tensor:
    """Random, channels last; rows repeat every 256: making them would take longer than what is measured."""
    some = torch.randn(min(ha, 256), wa, d, dtype=dtype, device=device)
    out = torch.empty(1, ha, wa, d, dtype=dtype, device=device)
    for top in range(0, ha, len(some)):
        out[0, top : top + len(some)] = some[: ha - top]
    return out.permute(0, 3, 1, 2)


def _warm(run: Callable, device: str, dtype: torch.dtype, job: Job) -> None:
    """Compiles what has to be, on a small image."""
    shape = 1, job.d, 8, 8
    q, k, v = (torch.randn(shape, dtype=dtype, device=device, requires_grad=True) for _ in range(3))
    out = run(q, k, v, field(8, 8, 4, device), 4, job.interpolation)
    if job.backward:
        out.sum().backward()


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def _peak(device: str, *, reset: bool = False) -> int:
    """Peak bytes since the last reset (on the CPU as Linux tells it, of the process)."""
    if device == "cuda":
        if reset:
            torch.cuda.reset_peak_memory_stats()
        return torch.cuda.max_memory_allocated()
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    return int(peak_memory() or 0)


def in_own_process(job: Job) -> dict:
    """`measure` in a fresh process, or the reason why it gave nothing."""
    command = [sys.executable, "-m", "tests.benchmarks.bench_attention", "--job", json.dumps(job)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        return {"failed": lines[-1] if lines else f"ended with status {done.returncode}"}
    return json.loads(done.stdout.splitlines()[-1])


def matmul_rate(device: str) -> float:
    """float32 matmul, floating-point operations a second."""
    n = 2048 if device == "cpu" else 8192
    a = torch.randn(n, n, device=device)
    return 2 * n**3 / _best(lambda: a @ a, device)


def _rates(device: str) -> dict[bool, float]:
    """Return rates of all threads, and of one."""
    threads = torch.get_num_threads()
    every = matmul_rate(device)
    torch.set_num_threads(1)
    try:
        return {False: every, True: matmul_rate(device)}
    finally:
        torch.set_num_threads(threads)


def copy_bandwidth(device: str) -> float:
    """Bytes read and written a second."""
    a = torch.zeros(2**26 if device == "cpu" else 2**29, device=device)
    b = torch.empty_like(a)
    return 2 * a.numel() * a.element_size() / _best(lambda: b.copy_(a), device)


def _best(act, device: str) -> float:
    times = []
    for _ in range(6):
        _wait(device)
        begin = time.perf_counter()
        act()
        _wait(device)
        times.append(time.perf_counter() - begin)
    return min(times)


BASELINES = (
    ("index", "nearest"),
    ("index, channels last", "nearest"),
    ("grid_sample", "nearest"),
    ("grid_sample", "bilinear"),
)
SMALL, LARGE, WHOLE = (128, 256), (256, 512), (3036, 4024)


class Job(NamedTuple):
    """Measured work: a method on images of height and width `ha`, `wa` with `d` channels."""

    device: str
    method: str
    interpolation: str
    ha: int
    wa: int
    samples: int
    backward: bool
    dtype: str = "float32"
    d: int = 64
    repeats: int = REPEATS

    @property
    def compiled(self) -> bool:
        """True if something has to be compiled before."""
        return self.method in ("cpu", ONE_THREAD, "triton")

    @property
    def name(self) -> tuple[str, str, str, str]:
        """Texts that name the job in the table."""
        shape = f"{self.wa}x{self.ha}, {self.samples}, {self.dtype}"
        return shape, "forward + backward" if self.backward else "forward", self.method, self.interpolation


def jobs(device: str, quick: bool) -> list[Job]:
    """List the measured work; (a) and (b) where they fit."""
    fast = "cpu" if device == "cpu" else "triton"
    own, plain = ([(method, how) for how in ("nearest", "bilinear")] for method in (fast, "reference"))
    both = (False, True)
    if device == "cuda":
        methods = [*BASELINES, *own] if torch.cuda.is_available() else own[:1]
        plan = [((800, 1280), 80, dtype, methods, both) for dtype in DTYPES]
        plan += [] if quick else [(WHOLE, 80, dtype, methods, both) for dtype in DTYPES]
    else:
        plan = [
            (SMALL, 80, "float32", plain, both[:1]),
            (SMALL, 80, "float32", [*BASELINES, *own], both),
            (LARGE, 80, "float32", [*BASELINES, *own], both),
            (LARGE, 80, "float32", [(ONE_THREAD, "nearest"), (ONE_THREAD, "bilinear")], both[:1]),
        ]
        more = [(LARGE, 40), (LARGE, 640), ((800, 1280), 80)]
        plan += [] if quick else [(hw, samples, "float32", own, both) for hw, samples in more]
        plan += [] if quick else [(WHOLE, 80, "bfloat16", own, both[:1])]
    return [
        Job(device, method, interpolation, *hw, samples, backward, dtype)
        for hw, samples, dtype, methods, directions in plan
        for backward in directions
        for method, interpolation in methods
    ]


def obstacle(job: Job) -> str | None:
    """Why an entry cannot be measured here, if so."""
    if job.device == "cuda" and not torch.cuda.is_available():
        return "no GPU on this machine: not measured"
    if job.compiled or job.method == "reference":
        return None
    gathered = job.ha * job.wa * job.samples * job.d * DTYPES[job.dtype].itemsize
    needed, free = gathered * (2 + 3 * job.backward), _free(job.device)
    enough = needed <= 0.9 * free
    return None if enough else f"needs {needed / GIB:.0f} GiB, {free / GIB:.0f} are free: not measured"


def _free(device: str) -> int:
    """Bytes."""
    if device == "cuda":
        return torch.cuda.mem_get_info()[0]
    lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
    return int(lines["MemAvailable"].split()[0]) * 1024


def row(job: Job, done: dict, rates: dict, bandwidth: float) -> str:
    """One line of the table."""
    result, (shape, work, *_) = done[job.name], job.name
    if "failed" in result:
        return markdown_row([*job.name, result["failed"][:80], *[""] * (len(COLUMNS) - 5)])
    flops = (3 if job.backward else 1) * 4 * job.ha * job.wa * job.samples * job.d
    least = (2 if job.backward else 1) * result["unit"]
    bases = ("index", "nearest"), ("grid_sample", job.interpolation)
    against = [
        f"{base['time'] / result['time']:.1f}x, {base['extra'] / max(result['extra'], 1):.1f}x"
        if "time" in base
        else "-"
        for base in (done.get((shape, work, *names), {}) for names in bases)
    ]
    seconds = result["time"]
    cells = [
        f"{seconds:.3f} ({result['low']:.3f} to {result['high']:.3f})",
        *against,
        f"{result['extra'] / result['unit']:.2f}",
        f"{flops / seconds / 1e12:.2g} ({flops / seconds / rates[job.method == ONE_THREAD]:.0%})",
        f"{least / seconds / 1e9:.2g} ({least / seconds / bandwidth:.0%})",
    ]
    return markdown_row([*job.name, *cells])


COLUMNS = (
    *("alpha (= beta), samples, dtype", "what", "method", "look-up", "seconds (fastest to slowest)"),
    *("faster, leaner than (a)", "faster, leaner than (b)", "extra memory / (Q + K + V + out)"),
    *("TFLOP/s (of the matmul rate)", "GB/s (of the copy bandwidth)"),
)


def table(device: str, *, quick: bool) -> list[str]:
    """Measures everything on a device, printing as it goes."""
    here = device == "cpu" or torch.cuda.is_available()
    rates, bandwidth = (_rates(device), copy_bandwidth(device)) if here else ({False: 1.0, True: 1.0}, 1.0)
    machine = f"{torch.get_num_threads()} threads"
    if device == "cuda":
        machine = torch.cuda.get_device_name() if here else ""
    limits = (
        f"{machine}: float32 matmul {rates[False] / 1e12:.3f} TFLOP/s (one thread {rates[True] / 1e12:.3f}), "
        f"copy {bandwidth / 1e9:.1f} GB/s (read and written)."
    )
    lines = [
        *("", f"## {device}", "", limits if here else "No GPU on this machine.", ""),
        markdown_header(COLUMNS, align="l"),
    ]
    print("\n".join(lines), flush=True)
    done: dict = {}
    for job in jobs(device, quick):
        reason = obstacle(job)
        done[job.name] = {"failed": reason} if reason else in_own_process(job)
        lines.append(row(job, done, rates, bandwidth))
        print(lines[-1], flush=True)
    return lines


def main(device: Literal["cpu", "cuda"] | None = None, quick: bool = False, job: str | None = None) -> None:
    """Print the table, of one device or of both, without the large sizes if it is to be quick.

    Args:
        job: One measurement, in this process.
    """
    if job:
        print(json.dumps(measure(Job(*json.loads(job)))))
        return
    if device == "cuda" and not torch.cuda.is_available():
        sys.exit("no GPU on this machine: nothing to measure with --device cuda")
    begin, load = time.perf_counter(), os.getloadavg()[0]
    lines = [line for kind in ("cpu", "cuda") if device in (None, kind) for line in table(kind, quick=quick)]
    minutes, after = (time.perf_counter() - begin) / 60, os.getloadavg()[0]
    end = f"{minutes:.1f} minutes in all; load of the machine {load:.1f} before, {after:.1f} after."
    print(end)
    if device is None and not quick:
        write(RESULTS, lines, end)


def write(path: Path, lines: list[str], end: str) -> None:
    """Puts the last run beside this file."""
    text = [
        "# Attention, measured",
        "",
        f"{date.today()}, torch {torch.__version__}, {platform.machine()}. {end} D = 64, "
        "channels last. (a) is `index`, (b) is `grid_sample`; 'faster' and 'leaner' are ratios of time and "
        "of extra peak memory; 4 floating-point operations a sample and channel in forward, "
        "12 with backward; least traffic is Q, K, V and out once, twice with backward. Written by `make "
        "bench`.",
        *lines,
    ]
    write_text(path, "\n".join(text) + "\n")


if __name__ == "__main__":
    script(main)
