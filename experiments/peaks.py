"""The most memory that some work takes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pat.support.memory import give_back, peak_memory, resident

Result = TypeVar("Result")


def with_peak(work: Callable[[], Result]) -> tuple[Result, float | None]:
    """Call `work`, and measure the memory by which this process grows.

    Returns:
        The result, and bytes at the peak; None where the system cannot report them (Linux can).
    """
    give_back()
    before = resident()
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak is that from here on
    except OSError:
        return work(), None
    result, peak = work(), peak_memory()
    return result, None if peak is None else max(peak - before, 0.0)
