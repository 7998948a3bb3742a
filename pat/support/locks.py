"""One command at a time in a folder of results, and folders that cannot be written to found before the work."""

from __future__ import annotations

import fcntl
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

LOCK = ".lock"


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Make the folder, and keep other commands out of it until the block ends; one left empty is removed again.

    The lock is a file of process and host, locked by the system: that of a process of this host which is gone counts
    for nothing. Raises ValueError for a folder that another command holds, or that cannot be written to.
    """
    made = _make(folder)
    try:
        file = _locked(folder)
        try:
            yield
        finally:
            (folder / LOCK).unlink(missing_ok=True)
            file.close()
    finally:
        for empty in made:
            try:
                empty.rmdir()
            except OSError:
                break


def _make(folder: Path) -> list[Path]:
    """Make the folder and those above; returns the new ones, the innermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unusable(folder, error) from None
    return missing


def _locked(folder: Path) -> IO[str]:
    """The lock file, open and locked, with this process in it."""
    path = folder / LOCK
    while True:
        try:
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise _unusable(folder, error) from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            owner = _owner(file)
            file.close()
            raise _in_use(folder, owner, "wait for it") from None
        if not path.exists() or os.fstat(file.fileno()).st_ino != path.stat().st_ino:
            file.close()  # its owner ended, and removed it, between the two calls above
            continue
        owner = _owner(file)
        if owner.get("host", socket.gethostname()) != socket.gethostname():
            file.close()
            raise _in_use(folder, owner, f"wait for it, or remove {path} if it has ended")
        try:
            file.truncate(0)
            file.write(json.dumps({"pid": os.getpid(), "host": socket.gethostname()}))
            file.flush()
        except OSError as error:
            file.close()
            raise _unusable(folder, error) from None
        return file


def _owner(file: IO[str]) -> dict[str, object]:
    """What a lock file says; nothing for a file that is empty or damaged."""
    file.seek(0)
    try:
        owner = json.load(file)
    except ValueError:
        return {}
    return owner if isinstance(owner, dict) else {}


def _in_use(folder: Path, owner: dict[str, object], advice: str) -> ValueError:
    who = f"process {owner.get('pid', 'unknown')} on {owner.get('host', 'this machine')}"
    return ValueError(f"{folder}: another command is writing there ({who}): {advice}, or give another folder")


def _unusable(folder: Path, error: OSError) -> ValueError:
    at = Path(error.filename) if error.filename else folder
    blocked = next((path for path in (folder, *folder.parents) if path.exists() and not path.is_dir()), None)
    reason = f"{blocked} is a file" if blocked else f"{at.parent if at.name == LOCK else at}: {error.strerror}"
    return ValueError(f"{folder}: cannot write there ({reason}): give another folder")
