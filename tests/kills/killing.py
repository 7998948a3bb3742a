"""Jobs in processes of their own, killed at random moments or inside a write, begun again, and compared."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from arraygeom.runtime.together import LISTS
from pat.app.cli.main import main
from tests.kills.long_writes import sitecustomize
from tests.processes import ROOT, dask_cluster, forked

CHAIN = 3
"""Kills of one folder before it is finished and compared."""
WAITING = 300.0
"""Seconds after which a command hangs."""
WAYS = ("moment", "write", "cut", "worker")


class Job(NamedTuple):
    """A command that writes to a folder.

    `arguments` of `pat`, for a folder; `again`, those that a killed command is continued with. `compared`:
    what has to be the same in the end, as bytes by name. `faults`: what is wrong with a folder whose command
    was killed, given the contents that are right. `kept`: files that must not be made again, by the time they
    were written. `former`: the arguments of a command that has already written to the folder.
    """

    name: str
    arguments: Callable[[Path], list[str]]
    compared: Callable[[Path], dict[str, bytes]]
    faults: Callable[[Path, list[dict[str, bytes]]], list[str]]
    again: tuple[str, ...] = ()
    kept: Callable[[Path], dict[str, int]] = lambda _: {}
    former: Callable[[Path], list[str]] | None = None


class Reference(NamedTuple):
    """A job nobody killed: its contents, those of the former command, its seconds, writes, largest file."""

    contents: dict[str, bytes]
    former: Path | None
    versions: list[dict[str, bytes]]
    seconds: float
    writes: int
    largest: int


class Killed(NamedTuple):
    """Result of the kills of one way on a job."""

    kills: int
    finished: int
    faults: list[str]


def started(
    arguments: list[str],
    log: Path,
    announced: Path | None = None,
    before: Callable[[], object] = lambda: None,
) -> int:
    """`pat` with arguments in a forked process of its own group; writes are long where they are announced.

    `before` is called in the process first.
    """

    def act() -> int:
        os.setsid()
        before()
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
        if announced is not None:
            folders = [str(Path(sitecustomize.__file__).parent), str(ROOT)]
            os.environ |= {"LONG_WRITES": str(announced), "PYTHONPATH": os.pathsep.join(folders)}
            sitecustomize.lengthen(announced)
        try:
            main(arguments)
        except SystemExit as ended:
            return ended.code if isinstance(ended.code, int) else 0
        return 0

    child = forked(act, log)
    while os.getpgid(child) != child:  # a kill at once would find no group
        time.sleep(0.001)
    return child


def status_of(child: int, seconds: float | None = None) -> int | None:
    """A process's exit status (negative: the signal that ended it), None if it runs on for some seconds."""
    end = time.monotonic() + (WAITING if seconds is None else seconds)
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() >= end:
            if seconds is not None:
                return None
            kill_group(child)
            raise TimeoutError(f"the command still ran after {WAITING:g} s")
        time.sleep(0.002)


def kill_group(child: int) -> None:
    """SIGKILL to a command and all its processes, and wait for them."""
    family = psutil.Process(child).children(recursive=True)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    for process in family:
        if process.is_running():
            process.kill()
    psutil.wait_procs(family, timeout=30)


def reference(job: Job, folder: Path) -> Reference:
    """Run the former command and the job to their ends, and once more with long writes, to count them."""
    former = None
    versions = []
    if job.former is not None:
        former = folder / f"{job.name}-former"
        _succeed(job.former(former), folder)
        versions.append(job.compared(former))
    whole, slow, announced = (folder / f"{job.name}-{what}" for what in ("whole", "slow", "announced"))
    begin = time.monotonic()
    _succeed(job.arguments(whole), folder)
    seconds = time.monotonic() - begin
    begin_slow = time.monotonic()
    _succeed(job.arguments(slow), folder, announced)
    seconds = min(seconds, time.monotonic() - begin_slow)  # the first may have compiled kernels
    contents = job.compared(whole)
    if job.compared(slow) != contents:
        raise AssertionError(
            f"{job.name}: two runs that nobody killed differ: {_different(job, slow, contents)}"
        )
    largest = max(file.stat().st_size for file in whole.rglob("*") if file.is_file())
    writes = len(announced.read_text().splitlines())
    return Reference(contents, former, [contents, *versions], seconds, writes, largest)


def killed(job: Job, right: Reference, folder: Path, *, way: str, kills: int, seed: int = 0) -> Killed:
    """Kill a job in one way so many times; after every few kills let it finish, and compare."""
    rng = np.random.default_rng([seed, WAYS.index(way)])
    done = finished = 0
    faults: list[str] = []
    while done < kills:
        out = folder / f"{job.name}-{way}"
        shutil.rmtree(out, ignore_errors=True)
        if right.former is not None:
            shutil.copytree(right.former, out)
        more: tuple[str, ...] = ()
        kept: dict[str, int] = {}
        for _ in range(min(CHAIN, kills - done)):
            hit = _one_kill([*job.arguments(out), *more], right, folder, way, rng)
            more = job.again
            done += hit
            if hit and out.exists():
                faults += job.faults(out, right.versions)
            faults += _made_again(job, out, kept)
            kept = job.kept(out) if out.exists() else {}
        _succeed([*job.arguments(out), *more], folder)
        finished += 1
        faults += _made_again(job, out, kept)
        faults += _different(job, out, right.contents) + left_over(out)
    return Killed(done, finished, [f"{job.name}, {way}: {fault}" for fault in faults])


def _one_kill(
    arguments: list[str], right: Reference, folder: Path, way: str, rng: np.random.Generator
) -> bool:
    """Run a command and kill it; False if it ended before."""
    announced = folder / "announced"
    announced.unlink(missing_ok=True)
    child = started(arguments, folder / "log.txt", announced if way == "write" else None)
    if way == "write":
        victim = _inside_a_write(child, announced, int(rng.integers(1, right.writes + 1)), rng)
    else:
        status = status_of(child, float(rng.uniform(0, right.seconds)))
        victim = None if status is not None else _worker_of(child, rng) if way == "worker" else child
    if victim is None:
        return False
    if way == "cut":
        limit = int(rng.integers(1, right.largest + 1))
        resource.prlimit(child, resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        return _ended_well(child, folder, (0, -signal.SIGXFSZ)) != 0
    if victim != child:  # another does its work
        with suppress(ProcessLookupError):
            os.kill(victim, signal.SIGKILL)
        _ended_well(child, folder, (0,))
        return True
    kill_group(child)
    return True


def _inside_a_write(child: int, announced: Path, wanted: int, rng: np.random.Generator) -> int | None:
    """Wait for the wanted write and a part of it; its process, None if the command ended before."""
    while True:
        lines = announced.read_text().splitlines(keepends=True) if announced.exists() else []
        if len(lines) >= wanted and lines[wanted - 1].endswith("\n"):
            time.sleep(float(rng.uniform(0, sitecustomize.PIECES * sitecustomize.PAUSE)))
            return int(lines[wanted - 1].split()[0])
        if status_of(child, 0.001) is not None:
            return None


def _worker_of(child: int, rng: np.random.Generator) -> int | None:
    """A worker process of a command, at random; waits for one."""
    while True:
        found = [p.pid for p in psutil.Process(child).children(recursive=True) if _is_worker(p)]
        if found:
            return int(rng.choice(found))
        if status_of(child, 0.02) is not None:
            return None


def _is_worker(process: psutil.Process) -> bool:
    try:
        words = " ".join(process.cmdline())
    except psutil.Error:
        return False
    return "spawn_main" in words


def _ended_well(child: int, folder: Path, wanted: tuple[int, ...]) -> int:
    status = status_of(child)
    if status not in wanted:
        raise AssertionError(f"status {status}: {(folder / 'log.txt').read_text()[-2000:]}")
    return int(status or 0)


def _succeed(arguments: list[str], folder: Path, announced: Path | None = None) -> None:
    _ended_well(started(arguments, folder / "log.txt", announced), folder, (0,))


def _different(job: Job, out: Path, contents: dict[str, bytes]) -> list[str]:
    found = job.compared(out)
    names = sorted(name for name in found.keys() | contents.keys() if found.get(name) != contents.get(name))
    return [f"not the same in the end: {name}" for name in names]


def _made_again(job: Job, out: Path, kept: dict[str, int]) -> list[str]:
    now = job.kept(out) if kept else {}
    return [f"{name} was made again" for name in kept if kept[name] != now.get(name)]


def left_over(out: Path) -> list[str]:
    """Temporary files in a folder whose command came to its end."""
    hidden = [path.relative_to(out) for path in out.rglob(".*") if path.name not in (".work", LISTS)]
    hidden += [path.relative_to(out) for path in out.glob(f"{LISTS}/*/")]
    return [f"left over: {path}" for path in hidden]


def files_of(out: Path) -> dict[str, bytes]:
    """All files of a folder that are meant to be seen, by their path in it."""
    found = (path for path in sorted(out.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(out)): path.read_bytes()
        for path in found
        if not any(part.startswith(".") for part in path.relative_to(out).parts)
    }


def mixed(found: dict[str, bytes], versions: list[dict[str, bytes]], last: str) -> list[str]:
    """Return the faults of files that belong together: torn, or of another run than the one written last.

    Where there is no last one yet, the others only have to be whole.
    """
    torn = [n for n, content in found.items() if all(content != right.get(n) for right in versions)]
    if torn or last not in found:
        return [f"torn: {name}" for name in torn]
    made = [right for right in versions if right.get(last) == found[last]]
    whole = any(found == right for right in made)
    return [] if whole else [f"beside {last} are files of another making, or missing"]


# Dask's scheduler -------------------------------------------------------------------------------------------


def scheduler_killed(job: Job, right: Reference, folder: Path, *, kills: int, seed: int = 0) -> Killed:
    """Kill the scheduler under a command, which must end with one line, and continue with another."""
    rng = np.random.default_rng([seed, len(WAYS)])
    out, faults = folder / f"{job.name}-scheduler", []
    for _ in range(kills):
        shutil.rmtree(out, ignore_errors=True)
        with dask_cluster(folder) as (address, scheduler):
            child = started([*job.arguments(out), "--scheduler", address], folder / "log.txt")
            wanted = int(rng.integers(1, len(job.kept(out)) + FRAMES_SEEN))
            while len(job.kept(out)) < wanted and status_of(child, 0.01) is None:
                pass
            time.sleep(float(rng.uniform(0, 0.3)))
            scheduler.kill()
            status = status_of(child)
        lines = [line for line in (folder / "log.txt").read_text().splitlines() if line.startswith("pat:")]
        faults += [] if status == 2 and len(lines) == 1 else [f"status {status}: {lines}"]
        faults += job.faults(out, right.versions)
        kept = job.kept(out)
        with dask_cluster(folder) as (address, _):
            _succeed([*job.arguments(out), *job.again, "--scheduler", address], folder)
        faults += _made_again(job, out, kept)
        faults += _different(job, out, right.contents) + left_over(out)
    return Killed(kills, kills, [f"{job.name}, scheduler: {fault}" for fault in faults])


FRAMES_SEEN = 3
"""So many frames at most are there when the scheduler is killed."""
