"""Writes that take long: Python imports this file when it starts, where its folder is on PYTHONPATH.

Before a file counts as being on the disk (`os.fsync`), it is emptied and written once more in pieces with
pauses, and a line in the file that LONG_WRITES names says that this begins. Who reads that line can kill the
process inside a write.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

PIECES, PAUSE = 20, 0.01
"""Number of pieces of a write; seconds after each."""


def lengthen(announced: Path) -> None:
    """Make the writes of this process long."""
    flush = os.fsync

    def slow(handle: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{handle}"))
        if path.is_file() and path.stat().st_size:
            with announced.open("a") as file:
                file.write(f"{os.getpid()} {path.name}\n")
            _write_slowly(path, path.read_bytes())
        flush(handle)

    os.fsync = slow  # type: ignore[assignment]


def _write_slowly(path: Path, content: bytes) -> None:
    with path.open("r+b", buffering=0) as file:
        file.truncate(0)
        for i in range(PIECES):
            file.write(content[len(content) * i // PIECES : len(content) * (i + 1) // PIECES])
            time.sleep(PAUSE)


if "LONG_WRITES" in os.environ:
    lengthen(Path(os.environ["LONG_WRITES"]))
