"""Files written atomically."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4


@contextmanager
def write_atomically(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to; it replaces `path` when the block ends without error.

    After an error (a full disk, say) the temporary file is gone and a former `path` is as it was. The temporary name
    ends as `path` does, so that writers that choose the format by suffix choose the same. Missing folders are made.
    The content is on the disk before the name is, so that a file that is there after a crash is whole.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}-{uuid4().hex}{path.suffix}")
    try:
        yield temporary
        _flush(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def sweep(folder: Path) -> None:
    """Remove the temporary files of killed processes from a folder."""
    for path in folder.glob(".*"):
        if re.fullmatch(r"\..*-[0-9a-f]{32}(\.\w+)?", path.name):
            path.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Wait until the file's content is on the disk."""
    handle = os.open(path, os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file atomically. Missing folders are made."""
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
