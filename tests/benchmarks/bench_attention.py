"""Measures attention: `python -m tests.benchmarks.bench_attention` prints a table and writes RESULTS.md
beside this file.

Every backend that this machine has runs against two usual ways to do the same: (a) index keys and values at
every position, matmul, softmax, matmul; (b) the same with `grid_sample`. Each measurement is a process of
its own, so that its peak memory is its own; the machine's float32 matmul rate and copy bandwidth are
measured in the same run. All repeat a few times; the table has medians with the spread (fastest to slowest).
`--quick` leaves the large sizes out.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from datetime import date
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from arraygeom.segments import Segments
from pat.attention import attend

RESULTS = Path(__file__).with_name("RESULTS.md")
REPEATS = 5
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


def field(ha: int, wa: int, samples: int, device: str) -> Segments:
    """Slanted segments of samples - 1 pixels, or as long as the picture is wide: an epipolar field."""
    y, x = torch.meshgrid(torch.arange(ha).float(), torch.arange(wa).float(), indexing="ij")
    length = min(samples - 1, wa - 1)
    slope = min(0.06, (ha - 5) / length)
    start = torch.stack([(x - length).clamp(0, wa - 1 - length), (y + 0.3).clamp(0, ha - 2 - slope * length)], -1)
    end = start + torch.tensor([length, slope * length])
    return Segments(start.to(device), end.to(device), torch.ones(ha, wa, dtype=torch.bool, device=device))


def index_everything(q: Tensor, k: Tensor, v: Tensor, look: Segments, samples: int, interpolation: str) -> Tensor:
    """(a): (b, d, h, w, l) keys and values, nearest, from pictures that lie channels first, as they usually
    do."""
    x, y = _pixels(k, look, samples)
    keys, values = (t.contiguous()[:, :, y, x] for t in (k, v))
    weight = torch.einsum("bdhw,bdhwl->bhwl", q, keys).softmax(-1)
    return torch.einsum("bhwl,bdhwl->bdhw", weight, values)


def index_channels_last(q: Tensor, k: Tensor, v: Tensor, look: Segments, samples: int, interpolation: str) -> Tensor:
    """(a) at its best: whole rows of channels are copied, (b, h, w, l, d)."""
    x, y = _pixels(k, look, samples)
    keys, values = (t.permute(0, 2, 3, 1)[:, y, x] for t in (k, v))
    weight = torch.matmul(keys, q.permute(0, 2, 3, 1)[..., None]).squeeze(-1).softmax(-1)
    return torch.matmul(weight[..., None, :], values).squeeze(-2).permute(0, 3, 1, 2)


def _pixels(k: Tensor, look: Segments, samples: int) -> tuple[Tensor, Tensor]:
    xy = (look.positions(samples).xy + 0.5).floor().long()
    return xy[..., 0].clamp(0, k.shape[3] - 1), xy[..., 1].clamp(0, k.shape[2] - 1)


def grid_sampled(q: Tensor, k: Tensor, v: Tensor, look: Segments, samples: int, interpolation: str) -> Tensor:
    """(b): the same with `grid_sample`, nearest or bilinear."""
    b, _, ha, wa = q.shape
    xy = look.positions(samples).xy.reshape(1, ha * wa, samples, 2)
    wh = xy.new_tensor([k.shape[3] - 1, k.shape[2] - 1])
    grid = (2 * xy / wh - 1).expand(b, -1, -1, -1).to(q.dtype)
    keys, values = (grid_sample(t, grid, mode=interpolation, align_corners=True) for t in (k, v))
    weight = torch.einsum("bdn,bdnl->bnl", q.flatten(2), keys).softmax(-1)
    return torch.einsum("bnl,bdnl->bdn", weight, values).unflatten(2, (ha, wa))


def fused(backend: str):
    def run(q: Tensor, k: Tensor, v: Tensor, look: Segments, samples: int, interpolation: str) -> Tensor:
        return attend(q, k, v, look, samples=samples, interpolation=interpolation, backend=backend)

    return run


METHODS = {
    "index": index_everything,
    "index, channels last": index_channels_last,
    "grid_sample": grid_sampled,
} | {name: fused(name) for name in ("reference", "cpu", "triton")}


def measure(job: dict) -> dict:
    """Times one job in this process, and its peak memory beyond inputs."""
    device, dtype = job["device"], DTYPES[job["dtype"]]
    ha, wa, d, samples = job["ha"], job["wa"], job["d"], job["samples"]
    torch.manual_seed(0)
    q, k, v = (
        torch.randn(1, d, ha, wa, dtype=dtype, device=device).to(memory_format=torch.channels_last).requires_grad_()
        for _ in range(3)
    )
    look, run = field(ha, wa, samples, device), METHODS[job["method"]]
    cotangent = torch.ones_like(q) if job["backward"] else None

    def once() -> float:
        _wait(device)
        begin = time.perf_counter()
        if job["backward"]:
            torch.autograd.grad(run(q, k, v, look, samples, job["interpolation"]), (q, k, v), cotangent)
        else:
            with torch.no_grad():
                run(q, k, v, look, samples, job["interpolation"])
        _wait(device)
        return time.perf_counter() - begin

    if job["warm"]:
        _warm(run, device, dtype, job)
    before = _peak(device, reset=True)
    first = once()
    extra = _peak(device) - before
    times = [first] if first > 20 else [once() for _ in range(REPEATS)]
    unit = 4 * d * ha * wa * q.element_size()
    return {
        "time": statistics.median(times),
        "low": min(times),
        "high": max(times),
        "extra": extra,
        "unit": unit,
    }


def _warm(run, device: str, dtype: torch.dtype, job: dict) -> None:
    """Compiles what has to be, on a small picture."""
    q, k, v = (torch.randn(1, job["d"], 8, 8, dtype=dtype, device=device, requires_grad=True) for _ in range(3))
    out = run(q, k, v, field(8, 8, 4, device), 4, job["interpolation"])
    if job["backward"]:
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
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) * 1024


def in_own_process(job: dict) -> dict:
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


def jobs(device: str, quick: bool) -> list[dict]:
    """What is measured; of (a) and (b) only what fits into 16 GiB."""
    fast = "cpu" if device == "cpu" else "triton"
    sizes = [(128, 256, 80), (256, 512, 40), (256, 512, 80)]
    sizes += [] if quick else [(256, 512, 160), (256, 512, 640), (800, 1280, 80)]
    found = []
    for ha, wa, samples in sizes:
        for backward in (False, True):
            gathered = ha * wa * samples * 64 * 4 * (2 + 3 * backward)
            for method in ("index", "index, channels last", "grid_sample", "reference", fast):
                for interpolation in ("nearest", "bilinear"):
                    skip = method.startswith("index") and interpolation == "bilinear"
                    skip |= method != fast and gathered > 16 * 2**30
                    skip |= method == "reference" and ha * wa * samples * (1 + backward) > 2 * 10**7
                    if not skip:
                        found.append(job(device, method, interpolation, ha, wa, samples, backward))
    if not quick:
        found.append(job(device, fast, "nearest", 3036, 4024, 80, False, dtype="bfloat16"))
        found.append(job(device, fast, "bilinear", 3036, 4024, 80, False, dtype="bfloat16"))
    return found


def job(device, method, interpolation, ha, wa, samples, backward, *, dtype="float32") -> dict:
    return {
        "device": device,
        "method": method,
        "interpolation": interpolation,
        "ha": ha,
        "wa": wa,
        "samples": samples,
        "backward": backward,
        "dtype": dtype,
        "d": 64,
        "warm": method in ("cpu", "triton"),
    }


def row(entry: dict, result: dict, baselines: dict, rate: float, bandwidth: float) -> str:
    """One line of the table."""
    shape = f"{entry['wa']}x{entry['ha']} {entry['samples']} {entry['dtype']}"
    work = "forward + backward" if entry["backward"] else "forward"
    start = f"| {shape} | {work} | {entry['method']} | {entry['interpolation']} |"
    if "failed" in result:
        return f"{start} {result['failed'][:60]} | | | | | |"
    flops = (3 if entry["backward"] else 1) * 4 * entry["ha"] * entry["wa"] * entry["samples"] * entry["d"]
    least = (2 if entry["backward"] else 1) * result["unit"]
    key = (shape, work)
    against = [
        f"{base['time'] / result['time']:.1f}x, {base['extra'] / max(result['extra'], 1):.1f}x" if base else "-"
        for base in (
            baselines.get((*key, "index", "nearest")),
            baselines.get((*key, "grid_sample", entry["interpolation"])),
        )
    ]
    cells = [
        f"{result['time']:.3f} ({result['low']:.3f} to {result['high']:.3f})",
        *against,
        f"{result['extra'] / result['unit']:.2f}",
        f"{flops / result['time'] / rate:.0%}",
        f"{least / result['time'] / bandwidth:.0%}",
    ]
    return f"{start} {' | '.join(cells)} |"


COLUMNS = (
    "alpha (= beta), samples, dtype",
    "what",
    "method",
    "look-up",
    "seconds (fastest to slowest)",
    "faster, leaner than (a)",
    "faster, leaner than (b)",
    "extra memory / (Q + K + V + out)",
    "of the matmul rate",
    "of the copy bandwidth",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--job", help=argparse.SUPPRESS)
    parser.add_argument("--quick", action="store_true", help="small sizes only")
    options = parser.parse_args()
    if options.job:
        print(json.dumps(measure(json.loads(options.job))))
        return
    lines = [
        "# Attention, measured",
        "",
        f"{date.today()}, torch {torch.__version__}, {platform.machine()}, "
        f"{torch.get_num_threads()} threads; "
        f"load of the machine before {os.getloadavg()[0]:.1f}. D = 64, channels last. (a) is `index`, (b) is "
        "`grid_sample`; 'faster' and 'leaner' are ratios of time and of extra peak memory. "
        "Written by `python -m tests.benchmarks.bench_attention`.",
    ]
    for device in ("cpu", "cuda"):
        lines += ["", f"## {device}", ""]
        if device == "cuda" and not torch.cuda.is_available():
            lines.append("No GPU at hand: the Triton backend was not measured. Where there is one, this command does.")
            continue
        lines += table(device, quick=options.quick)
    RESULTS.write_text("\n".join(lines) + "\n")
    print("\n".join(lines[-1:]))


def table(device: str, *, quick: bool) -> list[str]:
    """Measures everything on a device, printing as it goes."""
    rate, bandwidth = matmul_rate(device), copy_bandwidth(device)
    lines = [
        f"float32 matmul {rate / 1e9:.0f} GFLOP/s, copy {bandwidth / 1e9:.1f} GB/s (read and written).",
        "",
        f"| {' | '.join(COLUMNS)} |",
        "|---" * len(COLUMNS) + "|",
    ]
    print("\n".join(lines), flush=True)
    done: dict = {}
    for entry in jobs(device, quick):
        result = in_own_process(entry)
        shape = f"{entry['wa']}x{entry['ha']} {entry['samples']} {entry['dtype']}"
        work = "forward + backward" if entry["backward"] else "forward"
        if "failed" not in result:
            done[(shape, work, entry["method"], entry["interpolation"])] = result
        lines.append(row(entry, result, done, rate, bandwidth))
        print(lines[-1], flush=True)
    return lines


if __name__ == "__main__":
    main()
