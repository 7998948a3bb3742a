"""Locks on folders of results, and early errors for folders that cannot be written."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import ENOENT
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from .schema import entries_of

LOCK = ".lock"
OWNER = ".lock.json"
"""File that says who holds the lock: on some systems a locked file cannot be read."""


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Context manager that makes a folder and keeps other commands out of it.

    The lock is a file locked by the system; a file beside it names the process and the host. The lock of a
    dead process on this host, or in a container on it, is ignored; a lock of another host holds until its
    `OWNER` file is removed. Folders that the block leaves empty are removed again if this made them.

    Raises:
        ValueError: if a command (or this process already) holds the folder, or it cannot be written.
    """
    made = _make(folder)
    try:
        lock = _locked(folder)
        try:
            yield
        finally:
            (folder / OWNER).unlink(missing_ok=True)
            with suppress(OSError):  # Windows removes it when it is released
                (folder / LOCK).unlink()
            lock.release()
    finally:
        for empty in made:
            try:
                empty.rmdir()
            except OSError:
                break


def _make(folder: Path) -> list[Path]:
    """Make a folder and its parents. Returns those that are new, innermost first."""
    missing = [path for path in (folder, *folder.parents) if not os.path.exists(path)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unusable(folder, error) from None
    return missing


def _locked(folder: Path) -> BaseFileLock:
    """Acquire the folder's lock and write this process into the owner's file."""
    lock, owner_file = FileLock(folder / LOCK, timeout=0), folder / OWNER
    try:
        lock.acquire()
    except Timeout:
        if not (folder / LOCK).exists():
            raise _unusable(folder, FileNotFoundError(ENOENT, os.strerror(ENOENT), str(folder))) from None
        raise _in_use(folder, entries_of(owner_file), "wait for it") from None
    except OSError as error:
        raise _unusable(folder, error) from None
    owner, ours = entries_of(owner_file), {"pid": os.getpid(), "host": socket.gethostname(), "boot": _boot()}
    if owner.get("host", ours["host"]) != ours["host"] and owner.get("boot") != (ours["boot"] or "unknown"):
        lock.release()
        raise _in_use(folder, owner, f"wait for it, or remove {owner_file} if it has ended")
    try:
        owner_file.write_text(json.dumps(ours), encoding="utf-8")
    except OSError as error:
        lock.release()
        raise _unusable(folder, error) from None
    return lock


def _boot() -> str:
    """This start of the system, the same in all its containers, whose locks it knows; empty if unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def _in_use(folder: Path, owner: dict[str, object], advice: str) -> ValueError:
    who = f"process {owner.get('pid', 'unknown')} on {owner.get('host', 'this machine')}"
    return ValueError(f"{folder}: another command is writing there ({who}): {advice}, or give another folder")


def _unusable(folder: Path, error: OSError) -> ValueError:
    place = Path(error.filename) if error.filename else folder
    paths = (path for path in (folder, *folder.parents) if os.path.exists(path) and not os.path.isdir(path))
    blocked = next(paths, None)  # `Path.exists` raises PermissionError
    place = place.parent if place.name in (LOCK, OWNER) else place
    reason = f"{blocked} is a file" if blocked else f"{place}: {error.strerror}"
    return ValueError(f"{folder}: cannot write there ({reason}): give another folder")
