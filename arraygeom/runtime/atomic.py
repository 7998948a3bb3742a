"""Files written atomically."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Iterator
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
        if error.filename not in (None, str(temporary)) or _speaks_for_itself(error):
            raise
        raise _naming(path, error, temporary) from error
    finally:
        with suppress(OSError):  # also where nothing can be written or removed
            temporary.unlink()


@contextmanager
def write_together(folder: str | Path, *, last: str, stale: Iterable[str] = ()) -> Iterator[Path]:
    """A temporary folder inside `folder` for files that belong together, the one named `last` among them.

    They replace those of the same names when the block ends without error: the former last one is removed
    first, then those named `stale`, and the new last one comes last, so where it is, the others are of the
    same making. After an error (a full disk, say) all former files are as they were. Missing folders are
    made. Raises OSError that names the file.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    temporary = folder / f".{Path(last).stem}-{uuid4().hex}"
    temporary.mkdir()
    try:
        yield temporary
        for name in (last, *stale):
            (folder / name).unlink(missing_ok=True)
        for file in sorted(temporary.iterdir(), key=lambda file: file.name == last):
            os.replace(file, folder / file.name)
    except OSError as error:
        if (error.filename and Path(error.filename).parent != temporary) or _speaks_for_itself(error):
            raise
        written = folder / Path(error.filename).name if error.filename else folder
        raise _naming(written, error, temporary) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _speaks_for_itself(error: OSError) -> bool:
    """Whether it is not the system's, nor a library's that could not write."""
    return error.errno is None and type(error) is not OSError


def _naming(path: Path, error: OSError, temporary: Path) -> OSError:
    """The error, of `path` in place of a temporary one; NumPy's have a text alone, without a file."""
    if error.errno is not None:
        return OSError(error.errno, error.strerror, str(path))
    text = str(error).replace(str(temporary), str(path))
    return OSError(text if str(path) in text else f"{path}: not written whole ({text}): is there room?")


def sweep(folder: Path, stem: str | None = None) -> None:
    """Remove temporary files and folders of killed processes from a folder; or only those of files of a stem.

    Those of safetensors, which writes to a file of its own first, are among the former.
    """
    ours = rf"\.{'.*' if stem is None else re.escape(stem)}-[0-9a-f]{{32}}(\.\w+)?"
    for path in folder.glob(".*"):
        if re.fullmatch(ours if stem else rf"{ours}|\.tmp\w{{6}}", path.name):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


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
    that cannot lock the file. The system unlocks what a process that ended had locked."""
    from filelock import FileLock

    lock_file = FileLock(lock, timeout=longest)
    with suppress(OSError):  # waited long, or no locks on this drive
        lock_file.acquire(poll_interval=0.01)
    try:
        yield
    finally:
        lock_file.release()
