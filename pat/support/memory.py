"""Memory of this process: amounts as people write them, peaks, and the return of freed memory."""

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
NEAR = 0.94
"""The part of a limit from which freed memory is returned to the system."""
EVERY = 0.005
"""Seconds between looks at how much the process has, under a limit."""


def parse_bytes(amount: float | str) -> float:
    """Bytes of a number, or of text such as "4GiB" or "500 MB". Raises ValueError for other text."""
    units = {"B": 1, "KB": 1e3, "MB": 1e6, "GB": 1e9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
    text = str(amount)
    number = text.rstrip("BbKkMmGgIi ")
    unit = text[len(number) :].strip().upper() or "B"
    try:
        size = float(number) * units[unit]
    except (KeyError, ValueError):
        size = math.nan
    if not 0 < size < math.inf:
        raise ValueError(f"max_memory is '{amount}'; wanted bytes, or like 4GiB or 500MB")
    return size


_keeps = False


def keep_freed() -> None:
    """Keep freed memory for later use: glibc returns large blocks at once, and an eighth of the time of
    fusing a frame goes into getting them again. Of the whole process: for commands and workers, which are
    ours."""
    options = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if options is not None:
        for option, value in ((M_TRIM_THRESHOLD, 2**31 - 1), (M_MMAP_MAX, 0), (M_ARENA_MAX, 1)):
            options(option, value)
        global _keeps
        _keeps = True


def planned(limit: float | None, memory: float, *, large: bool) -> float | None:
    """The limit; for a large task what it is planned to take, if that is less: freed memory that is kept
    (`keep_freed`) comes on top, half as much again for a frame of 12 megapixels."""
    return min(memory, limit or memory) if large and _keeps else limit


def give_back() -> None:
    """Return freed memory to the system: glibc keeps some 300 MiB after a tile; the next may not fit."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim:
            trim(0)


LIBRARIES = 0.46 * 2**30
"""What Python, torch and the compiled loops take, bytes (430 MiB were measured)."""
SLACK = 1.05
"""What a process may take over what is counted: freed blocks smaller than a page cannot be returned."""
LEAST_BYTES, LEAST_MATCHED = 81.0, 110.0
"""For each pixel of alpha, whatever the network and tiles: its image, its frame, and writing that; or its
image, field, matches and filling, where networks use matches (plans were from 151)."""


def check_limit(pixels: int, limit: float | None = None, each: float = LEAST_BYTES) -> None:
    """Raise ValueError if no frame of so many pixels is fused within a limit (bytes; by default that of
    `limited`), as is known before anything is read."""
    limit = limit or _LIMIT.get() or math.inf
    if (needed := SLACK * (LIBRARIES + each * pixels)) > limit:
        raise ValueError(
            f"max_memory is {limit / 2**20:.0f} MiB; a frame of {pixels / 1e6:.1f} megapixels needs at least "
            f"{needed / 2**20:.0f} MiB: allow more, or reduce the images"
        )


ROOM = 0.96
"""The part of a limit up to which tasks at once may fill it."""
_LIMIT: ContextVar[float | None] = ContextVar("limit", default=None)


@contextmanager
def limited(limit: float | None) -> Iterator[None]:
    """Within this, `how_many_fit` knows how many bytes the process may take in all, and freed memory is
    returned to the system when the process comes near that; None: no limit."""
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
    """Return freed memory when a process has more than `most` bytes; less often while it does not help."""
    near = False
    while not done.wait(5 * EVERY if near else EVERY):
        near = resident() > most
        if near:
            give_back()
            near = resident() > most


def resident() -> float:
    """Resident bytes of this process; 0 where the system does not say (Linux does)."""
    pages = _text(Path("/proc/self/statm")).split()[1:2]
    return float(pages[0]) * os.sysconf("SC_PAGE_SIZE") if pages else 0.0


def how_many_fit(nbytes: float) -> int | None:
    """How many tasks of so many bytes may run at once, at least one; None where there is no limit."""
    limit = _LIMIT.get()
    if limit is None:
        return None
    room = ROOM * limit - nbytes * (os.cpu_count() or 1)
    if resident() > room:
        give_back()
    return max(int((ROOM * limit - resident()) // nbytes), 1)


def peak_memory(pid: int | str = "self") -> float | None:
    """Peak resident bytes of a process, by default this; None if the system does not say (Linux does)."""
    line = re.search(r"VmHWM:\s+(\d+) kB", _text(Path(f"/proc/{pid}/status")))
    return None if line is None else float(line[1]) * 2**10


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
