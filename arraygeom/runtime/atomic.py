"""Files written atomically."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4


@contextmanager
def write_atomically(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to; it replaces `path` when the block ends without error.

    After an error (a full disk, say) the temporary file is gone and a former `path` is as it was. The
    temporary name ends as `path` does, so that writers that choose the format by suffix choose the same.
    Missing folders are made. The content is on the disk before the name is, so that a file that is there
    after a crash is whole.

    Raises OSError that names `path`, whatever file the system's own names; IsADirectoryError for a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: name a file in it")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}-{uuid4().hex}{path.suffix}")
    try:
        yield temporary
        flush(temporary)
        os.replace(temporary, path)
    except OSError as error:
        if error.filename not in (None, str(temporary)) or speaks_for_itself(error):
            raise
        raise naming(path, error, temporary) from error
    finally:
        with suppress(OSError):  # also where nothing can be written or removed
            temporary.unlink()


def speaks_for_itself(error: OSError) -> bool:
    """Whether it is not the system's, nor a library's that could not write."""
    return error.errno is None and type(error) is not OSError


def naming(path: Path, error: OSError, temporary: Path) -> OSError:
    """The error, of `path` in place of a temporary one; NumPy's have a text alone, without a file."""
    if error.errno is not None:
        return OSError(error.errno, error.strerror, str(path))
    text = str(error).replace(str(temporary), str(path))
    return OSError(text if str(path) in text else f"{path}: not written whole ({text}): is there room?")


def flush(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, are on the disk."""
    if os.name == "nt" and path.is_dir():  # Windows opens no folders
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file atomically. Missing folders are made."""
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def alone(lock: Path, longest: float) -> Iterator[None]:
    """A block that one process is in at a time, or one that has waited so many seconds for the others, or
    that cannot lock the file. The system unlocks what a process that ended had locked.

    Where Python cannot ask the system for locks, a file of another name is there while a process is in the
    block: the system's locks leave theirs, and would be waited for.
    """
    from filelock import FileLock, SoftFileLock

    lock_file = FileLock(lock, timeout=longest)
    if isinstance(lock_file, SoftFileLock):
        lock_file = SoftFileLock(lock.with_suffix(".soft"), timeout=longest)
    with suppress(OSError):  # waited long, or no locks on this drive
        lock_file.acquire(poll_interval=0.01)
    try:
        yield
    finally:
        lock_file.release()
