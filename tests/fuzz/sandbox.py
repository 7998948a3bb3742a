"""One case in a process of its own, forked: limits of memory and time, and what came of it."""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from pat.support.memory import give_back
from tests.processes import forked

MEMORY = 4 << 30
SECONDS = 10
"""Limit of a core's time. A case that sleeps is ended after `WAITING` times as long by the clock."""
WAITING = 12


class Outcome(NamedTuple):
    """End of a case: "read", "refused" or the fault; last line, core seconds, peak resident bytes.

    What the child holds from its parent is not counted in the peak.
    """

    verdict: str
    message: str
    seconds: float
    peak: int


def ended(case: Callable[[], str], log: Path) -> Outcome:
    """Run a case that returns "read" or "refused" (else: a fault) in a child with 4 GiB and 10 s of a core.

    A traceback, a signal and a time-out are faults. What the case prints goes to `log`.
    """
    give_back()  # or the child takes what its parent freed and holds, which is not counted
    begin, (reader, writer) = time.monotonic(), os.pipe()
    child = forked(lambda: _limited(case, writer), log)
    held = int(os.read(reader, 32))
    os.close(reader)
    os.close(writer)
    status, usage = _wait(child, begin)
    seconds, peak = usage.ru_utime + usage.ru_stime, max(usage.ru_maxrss * 1024 - held, 0)
    lines = log.read_text(errors="replace").splitlines() if log.exists() else []
    last = lines[-1] if lines else ""
    if os.WIFSIGNALED(status):
        if os.WTERMSIG(status) in (signal.SIGKILL, signal.SIGXCPU):
            return Outcome("hang", last, seconds, peak)
        return Outcome(f"signal {os.WTERMSIG(status)}", last, seconds, peak)
    verdict = {0: "read", 1: "refused"}.get(os.WEXITSTATUS(status), "fault")
    traced = any(line.startswith("Traceback") for line in lines)
    return Outcome("traceback" if traced else verdict, last, seconds, peak)


def _resident() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def _wait(child: int, begin: float) -> tuple[int, resource.struct_rusage]:
    pause = 0.001
    while True:
        found, status, usage = os.wait4(child, os.WNOHANG)
        if found:
            return status, usage
        if time.monotonic() - begin > SECONDS * WAITING:
            os.kill(child, signal.SIGKILL)
            _, status, usage = os.wait4(child, 0)
            return status, usage
        time.sleep(pause)
        pause = min(pause * 1.5, 0.05)


def _limited(case: Callable[[], str], writer: int) -> int:
    """The exit status of a case within the limits; what the child holds before is written to a pipe."""
    os.write(writer, str(_resident()).encode())
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    spent = resource.getrusage(resource.RUSAGE_SELF)
    limit = int(spent.ru_utime + spent.ru_stime) + SECONDS
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 1))
    verdict = case()
    code = {"read": 0, "refused": 1}.get(verdict, 2)
    if code == 2:
        print(verdict)
    return code
