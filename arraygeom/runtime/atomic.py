"""Atomic writing of files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4


@contextmanager
def write_atomically(path: str | Path) -> Iterator[Path]:
    """Context manager that yields a temporary path beside `path`; what the block writes there replaces `path`
    if it succeeds.

    After an error (such as a full disk) the temporary file is gone and a former `path` is as it was. The
    temporary name ends as `path` does, for writers that choose the format by suffix. Missing folders are
    made. Content reaches the disk before the name does, so that a file that exists after a crash is complete.

    Yields:
        The temporary path, at which there is no file yet.

    Raises:
        IsADirectoryError: if `path` is a folder.
        OSError: naming `path` or its folder, if writing fails or the block writes no file. Other errors of
            the block, such as an OSError about another file, pass.
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
    """Return True for an error that neither the system nor a library's failed write raised."""
    return error.errno is None and type(error) is not OSError


def naming(path: Path, error: OSError, temporary: Path) -> OSError:
    """Make the error of a failed write that names `path` in place of the temporary file.

    Returns:
        The new error, for the caller to raise, with the system's number and text. An error without a number
        (NumPy's) has only a text, in which the path is replaced, or put before.
    """
    if error.errno is not None:
        return OSError(error.errno, error.strerror, str(path))
    text = str(error).replace(str(temporary), str(path))
    return OSError(text if str(path) in text else f"{path}: not written whole ({text}): is there room?")


def flush(path: Path) -> None:
    """Wait until a file's content, or the names in a folder, are on the disk (fsync).

    Does nothing for a folder on Windows, which opens none.

    Raises:
        OSError: for a path that is missing, a file that may not be written, and errors of the disk.
    """
    if os.name == "nt" and path.is_dir():  # Windows opens no folders
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file (UTF-8) atomically. Missing folders are made.

    Raises:
        OSError: naming the file, if writing fails.
    """
    with write_atomically(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def alone(lock: Path, longest: float) -> Iterator[None]:
    """Context manager that admits one process (and thread) at a time, by a lock file, which may stay.

    After waiting for `longest` seconds, or where the file cannot be locked, the block runs all the same. The
    system releases locks of ended processes. Where it has none, a file (with suffix .soft, or on a drive
    without locks the lock file itself) exists while a process is in the block.
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
