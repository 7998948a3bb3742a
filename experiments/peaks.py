"""The most memory that some work takes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pat.support.memory import give_back, peak_memory, resident

Result = TypeVar("Result")


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
