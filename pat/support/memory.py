"""Memory of this process: parsing of amounts, peak use, limits, and return of freed memory."""

from __future__ import annotations

import ctypes
import math
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from threading import Event, Thread

M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8
"""Options of glibc's mallopt (malloc.h)."""
LEAST = 2.0**20
"""Bytes below which a limit is a slip of the unit."""
NEAR = 0.97
"""Share of a limit above which freed memory is returned to the system: plans leave 5 % (`SLACK`), so that
what is in use stays below it, and memory is not given back only to be taken again."""
EVERY = 0.005
"""Seconds between readings of resident memory under a limit."""


def parse_bytes(amount: float | str) -> float:
    """Parse an amount of memory: a number of bytes, or text such as "4GiB" or "500 MB".

    Units, in any case: none or B, KB, MB, GB (1000s), KiB, MiB, GiB (1024s).

    Returns:
        Bytes.

    Raises:
        ValueError: for any other text, NaN, infinity, and less than `LEAST` (1 MiB).
    """
    units = {"B": 1, "KB": 1e3, "MB": 1e6, "GB": 1e9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
    text = str(amount)
    number = text.rstrip("BbKkMmGgIi ")
    unit = text[len(number) :].strip().upper() or "B"
    try:
        size = float(number) * units[unit]
    except (KeyError, ValueError):
        size = math.nan
    if not LEAST <= size < math.inf:
        meant = f": is {number}GiB meant?" if 0 < size < LEAST and unit == "B" else ""
        raise ValueError(f"max_memory: '{amount}' is no memory: give bytes, as 4GiB or 500MB{meant}")
    return size


_keeps = False


def keep_freed() -> None:
    """Make glibc keep freed memory for later allocations in this process; does nothing without glibc.

    Fusing is faster, as large blocks need not come from the system again. It applies to the whole process and
    cannot be undone: meant for commands and workers, not for a library's user.
    """
    options = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if options is not None:
        for option, value in ((M_TRIM_THRESHOLD, 2**31 - 1), (M_MMAP_MAX, 0), (M_ARENA_MAX, 1)):
            options(option, value)
        global _keeps
        _keeps = True


def planned(limit: float | None, memory: float, *, large: bool) -> float | None:
    """Choose the memory limit to plan a task with.

    Args:
        limit: limit that the user gave, bytes; None or 0 for no limit.
        memory: bytes that the task is expected to need.
        large: True for a large task, of which a process after `keep_freed` also keeps what it frees.

    Returns:
        Bytes: `memory` and 5 %, at most `limit`, for a large task after `keep_freed`; otherwise
        `limit` unchanged, which may be None.
    """
    return min(SLACK * memory, limit or math.inf) if large and _keeps else limit


def give_back() -> None:
    """Return freed memory to the system (glibc keeps some 300 MiB after a tile). Does nothing
    outside Linux."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim:
            trim(0)


LIBRARIES = 0.46 * 2**30
"""Memory of Python, torch and the compiled loops, bytes (430 MiB were measured)."""
SLACK = 1.05
"""Memory that a process may take beyond the counted: freed blocks smaller than a page cannot be returned."""
LEAST_BYTES, LEAST_MATCHED = 81.0, 110.0
"""Least bytes for each pixel of alpha, whatever the tiles: its image, its frame, and writing that; and of
networks that use matches (plans had from 151)."""


def check_limit(pixels: int, limit: float | None = None, each: float = LEAST_BYTES) -> None:
    """Refuse, before anything is read, a frame that certainly cannot be fused within a memory limit.

    Args:
        pixels: number of alpha's pixels.
        limit: bytes of the process, some 0.5 GiB of Python and torch included; None or 0 for that of
            `limited`, without which any frame fits.
        each: bytes of working memory for each pixel, at least; more may be needed than is checked.

    Raises:
        ValueError: if so many pixels, Python and torch need more than the limit.
    """
    limit = limit or _LIMIT.get() or math.inf
    if (needed := SLACK * (LIBRARIES + each * pixels)) > limit:
        raise ValueError(
            f"max_memory: {limit / 2**20:.0f} MiB are too few: a frame of {pixels / 1e6:.1f} megapixels "
            f"needs {needed / 2**20:.0f} MiB or more: allow them, or reduce the images"
        )


ROOM = 0.96
"""Share of a limit that concurrent tasks may fill."""
_LIMIT: ContextVar[float | None] = ContextVar("limit", default=None)


@contextmanager
def limited(limit: float | None) -> Iterator[None]:
    """Context manager that states how many bytes the process may take in all, for `how_many_fit` and
    `check_limit`.

    Only code of this thread sees the statement. A further thread returns freed memory to the system when the
    process comes near the limit. Nothing enforces it.

    Args:
        limit: bytes; None for no limit, also within a block that states one.
    """
    before, done = _LIMIT.get(), Event()
    token = _LIMIT.set(limit)
    if limit is not None and limit != before:
        Thread(target=_return_near, args=(NEAR * limit, done), daemon=True).start()
    try:
        yield
    finally:
        done.set()
        _LIMIT.reset(token)


def _return_near(most: float, done: Event) -> None:
    """Return freed memory while the process has more than `most` bytes; less often if that does not help."""
    near = False
    while not done.wait(5 * EVERY if near else EVERY):
        near = resident() > most
        if near:
            give_back()
            near = resident() > most


def resident() -> float:
    """Return the resident memory of this process in bytes; 0 if the system does not report it."""
    pages = _text(Path("/proc/self/statm")).split()[1:2]
    return float(pages[0]) * os.sysconf("SC_PAGE_SIZE") if pages else 0.0


def how_many_fit(nbytes: float) -> int | None:
    """Return how many tasks of `nbytes` bytes (above 0) fit beside what this process holds under `limited`.

    At least 1, even if none fits; None without a limit. Returns freed memory to the system if room is short.
    """
    limit = _LIMIT.get()
    if limit is None:
        return None
    room = ROOM * limit - nbytes * (os.cpu_count() or 1)
    if resident() > room:
        give_back()
    return max(int((ROOM * limit - resident()) // nbytes), 1)


def peak_memory(pid: int | str = "self") -> float | None:
    """Return the peak resident memory of a process in bytes; None if the system does not report it."""
    line = re.search(r"VmHWM:\s+(\d+) kB", _text(Path(f"/proc/{pid}/status")))
    return None if line is None else float(line[1]) * 2**10


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
