"""Processes that tests and benchmarks start: forked ones whose output is kept, and a Dask cluster."""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

ROOT = Path(__file__).parents[1]


@contextmanager
def room_for(nbytes: int) -> Iterator[None]:
    """Files become no larger than that, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (nbytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def forked(act: Callable[[], int], log: Path) -> int:
    """The number of a forked process that does something and ends with its result, 2 if it raises.

    What it prints goes to a file.
    """
    child = os.fork()
    if child:
        return child
    code = 2
    try:
        import torch  # here, as benchmarks start processes with hardly anything in memory

        torch.set_num_threads(1)  # the threads of the forking process are not there
        handle = os.open(log, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        sys.stdout, sys.stderr = (open(n, "w", closefd=False) for n in (1, 2))  # noqa: SIM115
        faulthandler.disable()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = act()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


@contextmanager
def dask_cluster(
    folder: Path, workers: int = 1, *, root: Path = ROOT, environment: Mapping[str, str] = {}
) -> Iterator[tuple[str, subprocess.Popen]]:
    """A scheduler and workers of one thread, processes of their own: the address, the scheduler's process."""
    facts, dask = folder / "scheduler.json", [sys.executable, "-m", "dask"]
    facts.unlink(missing_ok=True)
    common = ["--no-dashboard", "--scheduler-file", str(facts)]
    many = ["--nworkers", str(workers), "--nthreads", "1", "--memory-limit", "0"]
    running: list[subprocess.Popen] = []
    try:
        for command in (["scheduler", "--host", "127.0.0.1", "--port", "0"], ["worker", *many]):
            running.append(
                subprocess.Popen(
                    [*dask, *command, *common],
                    cwd=root,
                    env={**os.environ, "PYTHONPATH": str(root), **environment},
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,
                )
            )
            while running[0].poll() is None and not (facts.exists() and facts.read_text().endswith("}")):
                time.sleep(0.05)
        yield json.loads(facts.read_text())["address"], running[0]
    finally:
        for process in running:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
