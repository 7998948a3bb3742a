"""The most memory that a process has, and that some work takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import TypeVar

from pat.support.memory import give_back, peak_memory, resident

Result = TypeVar("Result")


def watch_peak(pid: int, *, every: float = 0.2) -> Callable[[], float]:
    """Watch a process until it ends; the function returned waits for that, gives peak resident bytes or 0.

    `wait4` would count what the parent had resident when it started the process.
    """
    largest = [0.0]

    def watch() -> None:
        while (resident := peak_memory(pid)) is not None:
            largest[0] = resident
            time.sleep(every)

    watching = Thread(target=watch, daemon=True)
    watching.start()

    def peak() -> float:
        watching.join()
        return largest[0]

    return peak


def with_peak(work: Callable[[], Result]) -> tuple[Result, float | None]:
    """What `work` returns, and the bytes by which this process grew at most meanwhile; None where the system
    cannot say (Linux can)."""
    give_back()
    before = resident()
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak is that from here on
    except OSError:
        return work(), None
    result, peak = work(), peak_memory()
    return result, None if peak is None else max(peak - before, 0.0)
