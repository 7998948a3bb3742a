"""The main job, a command: `python -m tests.benchmarks.bench_job [--quick] [--runs 3] [--against CHECKOUT]`.

`pat fuse` as a process, from nothing to written files: the sample, 1280x800 with one and three betas,
4024x3036 under caps of memory; with kernels compiled before (warm), and with an empty cache (cold). Beside
it, in turn in the same run, processes that read the same files and write an image by the classical baseline,
and by OpenCV's SGBM, WLS and warp; and `pat fuse` of another checkout, such as that of an older commit. Then
the first second (`pat --help`, `pat warm-up` with an empty cache, `pat demo` after it), and forty frames from
folders, by local workers and by a Dask cluster. The images are the sample array's, enlarged.
Prints figures, and puts them into tests/benchmarks/RESULTS_job.md; some 15 minutes on two cores, twice that
with another checkout. `--quick`: 1280x800 with one beta only, cold once and warm once, nothing written.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from pat.app.cli.parser import script
from tests.processes import ROOT, dask_cluster

from .job_parts import STAGES

RESULTS = Path(__file__).with_name("RESULTS_job.md")
PARTS = (sys.executable, "-m", "tests.benchmarks.job_parts")
PAT = (sys.executable, "-m", "pat")
FRAMES = 40


@dataclass(frozen=True)
class Case:
    """A fusion to measure."""

    name: str
    wh: tuple[int, int]
    betas: int = 1
    cap: str | None = None


@dataclass
class Run:
    """One process: seconds of the wall and of cores, peak resident bytes, JSON it printed, what it said."""

    wall: float
    cores: float
    peak: float
    printed: dict[str, Any] = field(default_factory=dict)
    said: str = ""


CASES = (
    Case("640x400", (640, 400)),
    Case("1280x800", (1280, 800)),
    Case("1280x800, 3 betas", (1280, 800), betas=3),
    *(Case(f"4024x3036, {cap}", (4024, 3036), cap=cap) for cap in ("3GiB", "4GiB", "8GiB")),
    Case("4024x3036, 3 betas, 4GiB", (4024, 3036), 3, "4GiB"),
)
QUICK = CASES[1:2]
MANY = QUICK[0].name
"""The case of which many frames are fused."""


def run(command: Sequence[str], cache: Path | None = None, root: Path = ROOT) -> Run:
    """Run a command in a checkout, numba's cache in a folder if one is given. Raises RuntimeError if it
    fails; low confidence (3), as the blur of enlarged images gives, is no failure."""
    environment = os.environ if cache is None else {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    begin = time.perf_counter()
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(command, cwd=root, env=environment, stdout=out, stderr=errors, text=True)
        _, status, used = os.wait4(process.pid, 0)
        wall = time.perf_counter() - begin
        process.returncode = os.waitstatus_to_exitcode(status)
        for stream in (out, errors):
            stream.seek(0)
        lines, said = out.read().splitlines(), errors.read()
        if process.returncode not in (0, 3):
            raise RuntimeError(f"{' '.join(command)} ended with {process.returncode}:\n{said[-2000:]}")
    printed = [json.loads(line) for line in lines if line.startswith("{")]
    cores, peak = used.ru_utime + used.ru_stime, used.ru_maxrss * 1024.0
    return Run(wall, cores, peak, printed[-1] if printed else {}, said)


def fuse_arguments(case: Case, folder: Path, out: Path) -> list[str]:
    """`pat fuse`'s own."""
    names = ["mono", *(f"colour{i + 1}" for i in range(case.betas))]
    images = [word for name in names for word in ("--image", f"{name}={folder / name}.png")]
    cap = [] if case.cap is None else ["--max-memory", case.cap]
    return [str(folder / "rig.yaml"), "--alpha", "mono", *images, "--out", str(out), *cap]


def scenes(cases: Sequence[Case], work: Path) -> Iterator[tuple[Case, Path]]:
    """Each case with the folder of its images."""
    for case in cases:
        folder = work / f"scene{case.wh[0]}"
        if not folder.exists():
            run([*PARTS, "scene", str(folder), *map(str, case.wh), "4"], work / "warm")
        yield case, folder


def measured(
    case: Case, folder: Path, work: Path, runs: int, *, others: bool, old: Path | None
) -> dict[str, list[Run]]:
    """Runs by the way to fuse. Beside others the first of each fills the cache and is not counted; without,
    kernels are there by then."""
    fuse = fuse_arguments(case, folder, work / "out")
    ways = {"pat fuse": [*PAT, "fuse", *fuse]}
    if old:
        ways["old"] = ways["pat fuse"]
    if others:
        ways |= {way: [*PARTS, way, str(folder), str(work / way)] for way in ("classical", "opencv")}
    found: dict[str, list[Run]] = {way: [] for way in ways}
    for i in range(runs + others):
        for way, command in ways.items():
            try:
                one = run(
                    command, work / ("old" if way == "old" else "warm"), old if old and way == "old" else ROOT
                )
            except RuntimeError as error:
                if way != "old":
                    raise
                print(f"old: {str(error).splitlines()[-1]}", flush=True)
                continue
            if i >= others:
                found[way].append(one)
    if others:
        found["cold"] = [run(ways["pat fuse"], Path(tempfile.mkdtemp(dir=work)))]
    if case.cap is None:
        found["stages"] = [run([*PARTS, "stages", *fuse], work / "warm") for _ in range(min(runs, 2))]
    return found


def first_second(work: Path, runs: int, root: Path) -> list[list[str]]:
    """Lines of the table of what is awaited before anything is fused, of a checkout."""
    cache, demo = Path(tempfile.mkdtemp(dir=work)), [*PAT, "demo", "--out", str(work / "demo")]
    parts = {
        "pat --help": [run([*PAT, "--help"], cache, root) for _ in range(runs)],
        "pat lab train --help": [run([*PAT, "lab", "train", "--help"], cache, root) for _ in range(runs)],
        "pat demo, nothing compiled": [run(demo, Path(tempfile.mkdtemp(dir=work)), root)],
        "pat warm-up, nothing compiled": [run([*PAT, "warm-up"], cache, root)],
        "pat demo after pat warm-up": [run(demo, cache, root)],
        "pat demo again": [run(demo, cache, root) for _ in range(runs)],
    }
    return [
        [name, *(f"{median(getattr(r, kind) for r in found):.2f}" for kind in ("wall", "cores"))]
        for name, found in parts.items()
    ]


def many_frames(case: Case, folder: Path, work: Path, one: float, root: Path) -> Iterator[list[str]]:
    """Lines of the table of `FRAMES` frames from folders by as many workers as there are cores, and by a Dask
    cluster of as many; `one` is the seconds of a process that fuses one of them."""
    names = ["mono", *(f"colour{i + 1}" for i in range(case.betas))]
    for name in names:
        frames = work / f"frames{case.wh[0]}" / name
        if not frames.exists():
            frames.mkdir(parents=True)
            for i in range(FRAMES):
                (frames / f"{i:03d}.png").symlink_to(folder / f"{name}.png")
    images = [word for name in names for word in ("--image", f"{name}={work / f'frames{case.wh[0]}' / name}")]
    workers = len(os.sched_getaffinity(0))
    out = tempfile.mkdtemp(dir=work)
    command = [*PAT, "batch", str(folder / "rig.yaml"), "--alpha", "mono", *images, "--out", out]
    cache = work / ("warm" if root == ROOT else "old")
    found = run([*command, "--workers", str(workers)], cache, root)
    same = f"{60 / one:.1f}"
    busy = f"{found.cores / found.wall / workers:.0%}"
    yield [case.name, f"{60 * FRAMES / found.wall:.1f}", same, f"{found.cores / FRAMES:.2f}", busy]
    environment = {"NUMBA_CACHE_DIR": str(cache)}
    with dask_cluster(work, workers, root=root, environment=environment) as (address, _):
        there = run([*command, "--scheduler", address], cache, root)
    yield [f"{case.name}, Dask", f"{60 * FRAMES / there.wall:.1f}", same, "", ""]


def row(case: Case, found: dict[str, list[Run]]) -> list[str]:
    """A line of the table: seconds (median, least to most), core seconds, peak memory, ratios."""
    ours = found["pat fuse"]
    walls, cores = [r.wall for r in ours], median(r.cores for r in ours)
    cells = [case.name, f"{median(walls):.1f} ({min(walls):.1f} to {max(walls):.1f})", f"{cores:.1f}"]
    cells += [f"{max(r.peak for r in ours) / 2**30:.2f} GiB"]
    cells += [f"{found['cold'][0].wall:.1f}" if "cold" in found else ""]
    old = found.get("old")
    cells += [f"{median(r.wall for r in old):.1f} ({median(r.cores for r in old):.1f})" if old else ""]
    for way in ("classical", "opencv"):
        other = found.get(way)
        if other is None:
            cells.append("")
            continue
        wall, core = (median(getattr(r, kind) for r in other) for kind in ("wall", "cores"))
        cells.append(f"{wall:.1f} ({core:.1f}): {median(walls) / wall:.1f}x ({cores / core:.1f}x)")
    return cells


def stages_row(case: Case, found: dict[str, list[Run]]) -> list[str]:
    """The shares of each part of the whole, and core seconds."""
    shares = {}
    for kind in ("stages", "cores"):
        parts = [r.printed[kind] for r in found["stages"]]
        shares[kind] = {name: median(p[name] for p in parts) for name in parts[0]}
    total = sum(shares["stages"].values())
    return [case.name, *(f"{shares['stages'][n] / total:.0%}, {shares['cores'][n]:.2f}" for n in STAGE_NAMES)]


STAGE_NAMES = "import", *STAGES, "rest"
COLUMNS = (
    *("", "seconds", "core seconds", "peak memory", "cold, seconds", "other checkout, seconds (of a core)"),
    *("classical baseline, seconds (of a core): ratio", "OpenCV, seconds (of a core): ratio"),
)


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """In Markdown; this file imports nothing of the project, whose memory a child would count as its own."""
    rule = ["---", *["---:"] * (len(columns) - 1)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (columns, rule, *rows)) + "\n"


FIRST_COLUMNS = ("", "seconds", "core seconds")
MANY_COLUMNS = ("", "frames a minute", "as processes of one frame", "core seconds a frame", "cores busy")


def main(quick: bool = False, runs: int = 3, against: Path | None = None) -> None:
    """Print the figures, of another checkout measured in turn, too, if it is given."""
    cases, runs = (QUICK, 1) if quick else (CASES, runs)
    old = against and against.resolve()
    load = os.getloadavg()[0]
    rows, stages, first, many = [], [], [], []
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        for case, images in scenes(cases, work):
            large = case.wh[0] > 2000
            alone = large or case.betas > 1
            found = measured(case, images, work, 1 if large else runs, others=not alone, old=old)
            rows.append(shown(COLUMNS, row(case, found)))
            if "stages" in found:
                stages.append(shown(("", *STAGE_NAMES), stages_row(case, found)))
            if case.name == MANY and not quick:
                one = median(r.wall for r in found["pat fuse"])
                many += [shown(MANY_COLUMNS, line) for line in many_frames(case, images, work, one, ROOT)]
        for root in () if quick else (ROOT, old) if old else (ROOT,):
            note = "" if root == ROOT else ", other checkout"
            lines = first_second(work, min(runs, 3), root)
            first += [shown(FIRST_COLUMNS, [f"`{cells[0]}`{note}", *cells[1:]]) for cells in lines]
    threads = os.environ.get("OMP_NUM_THREADS", "all")
    text = (
        "`pat fuse` as a process, imports and written files included. Written by `make bench-job`.\n"
        f"{platform.machine()}, {len(os.sched_getaffinity(0))} cores, {threads} threads; "
        f"load {load:.1f} before, {os.getloadavg()[0]:.1f} after;\n"
        f"medians of {runs} runs (4024x3036: one), in turn with the others.\n\n"
        f"{table(COLUMNS, rows)}\nWhere the time goes: share of the seconds, and seconds of a core. Each "
        "part without "
        f"those within it.\n\n{table(('', *STAGE_NAMES), stages)}"
    )
    if first:
        text += f"\nThe first second:\n\n{table(FIRST_COLUMNS, first)}"
    if many:
        text += f"\n{FRAMES} frames from folders, a worker a core:\n\n{table(MANY_COLUMNS, many)}"
    print(text)
    if not quick:
        RESULTS.write_text(text, encoding="utf-8")


def shown(columns: Sequence[str], cells: list[str]) -> list[str]:
    """A line of a table, once it has been printed."""
    print(table(columns, [cells]).splitlines()[-1], flush=True)
    return cells


if __name__ == "__main__":
    script(main)
