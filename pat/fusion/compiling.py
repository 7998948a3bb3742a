"""A second process that compiles the kernels of the fusion while this one begins with its work.

numba compiles one function at a time in a process. The two meet in its cache: the second begins with the
kernels that are needed last, neither compiles what the other does (`arraygeom.compiled`), and the first loads
what it finds there.
"""

from __future__ import annotations

import atexit
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Lock, Thread
from types import ModuleType
from typing import Any

ROOT = Path(__file__).parents[2]
WITHOUT_TORCH = "arraygeom", "pat.attention"
"""Packages whose modules of kernels are imported without their `__init__`, which imports torch: two
seconds."""

_FIRST = Lock()


def seems_compiled() -> bool:
    """Whether numba's cache has code of attention for this version of Python, of whatever age; numba is not
    imported for it."""
    cache_home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folders = [
        ROOT / "pat" / "attention" / "kernels" / "__pycache__",
        *Path(cache_home, "numba").glob("kernels_*"),
    ]
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        folders = [*Path(chosen).glob("kernels_*")]
    index = f"forward.forward-*py{sys.version_info.major}{sys.version_info.minor}*.nbi"
    return any(any(folder.glob(index)) for folder in folders)


def compile_beside() -> None:
    """Start the second process, once, where there is a core for it. It ends with this one."""
    from ..support.jobs import cores

    if cores() < 2 or not _FIRST.acquire(blocking=False):
        return
    code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main()"
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=quiet, stderr=quiet
    )
    atexit.register(_end, process)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.communicate()


def main() -> None:
    """Compile `kernels` from the last, attention's, the longest, before all others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    for name in WITHOUT_TORCH:
        package = sys.modules[name] = ModuleType(name)
        package.__path__ = [str(ROOT.joinpath(*name.split(".")))]
    from arraygeom.compiled import cache_file, is_kept

    for entry, signature in _as_needed_last():
        if cache_file(entry) is None:
            return
        if not is_kept(entry, signature):
            entry.compile(signature)


def _as_needed_last() -> list[tuple[Any, tuple[Any, ...]]]:
    """The kernels in this process's order."""
    latest_first = [*kernels()][::-1]
    return sorted(latest_first, key=lambda kernel: kernel[0].__name__ != "forward")


def _end_with_parent() -> None:
    """The parent holds the other end of standard input, until it ends in whatever way."""
    sys.stdin.buffer.read()
    os._exit(0)


def kernels() -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """The kernels that a frame of two cameras is fused by, in the order of their use, and the types of what
    they are given."""
    from numba import float32, float64, int16, int32, int64, types, uint8, uint64

    from ..attention.kernels import attend_rows
    from ..matching import cost, semi_global_numba
    from ..networks.unshuffle_numba import unshuffle

    plane, bits, labels = float32[:, ::1], uint64[:, ::1], int32[:, :, ::1]
    planes, costs, sums = float32[:, :, ::1], uint8[:, :, :, ::1], int16[:, :, :, ::1]
    strided, image = float32[:, :, :], types.Tuple((float32[::1], uint64[::1]))
    windows, segments, hw = (labels, int64), (planes, planes, plane, plane), (int64, int64)
    yield cost.census, (plane, bits)
    yield semi_global_numba.costs, (image, image, *windows, *segments, *hw, costs)
    yield semi_global_numba.aggregate, (costs, plane, *windows, float32, float32, sums)
    found = int32[::1], plane, planes, int32[:, ::1]
    yield semi_global_numba.winners, (sums, *windows, *segments, *hw, int64, int64, float32, *found)
    yield semi_global_numba.regression, (*(plane,) * 6, float64, plane, plane)
    yield _attention()
    yield unshuffle, (strided, strided, strided)
    yield attend_rows, (planes, planes, planes, planes, int64, int64, int64)


def _attention() -> tuple[Any, tuple[Any, ...]]:
    import numpy as np
    from numba import typeof

    from ..attention.kernels import Call, Geometry, Outputs, Share, block_scratch, forward

    numbers, one = np.empty(1, np.float32), np.float32(1)
    where = Geometry(numbers, np.empty(1, np.uint8), numbers, 1, True, True, 1, True, 1, 1, one, one, one)
    call = Call(numbers, numbers, numbers, where, numbers, False, 1, 1)
    share = Share(0, 1, 1, np.empty(1, np.int64), block_scratch(1, 1, np.dtype(np.float32)))
    return forward, tuple(map(typeof, (call, share, Outputs(numbers, numbers, numbers, True))))
