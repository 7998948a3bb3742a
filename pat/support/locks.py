"""One command at a time in a folder of results; folders that cannot be written to, found before the work."""

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
"""Who holds it: a locked file cannot be read on every system."""


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Make the folder, and keep other commands out until the block ends; if left empty it is removed again.

    The lock is a file locked by the system, and process and host are in another beside it: that of a process
    of this host, or of a container on it, which is gone counts for nothing. Raises ValueError for a folder
    that another command holds, or that cannot be written to.
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
    """Make the folder and those above; returns the new ones, the innermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unusable(folder, error) from None
    return missing


def _locked(folder: Path) -> BaseFileLock:
    """The folder's lock, held, with this process in the file of its owner."""
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
    blocked = next((path for path in (folder, *folder.parents) if path.exists() and not path.is_dir()), None)
    place = place.parent if place.name in (LOCK, OWNER) else place
    reason = f"{blocked} is a file" if blocked else f"{place}: {error.strerror}"
    return ValueError(f"{folder}: cannot write there ({reason}): give another folder")
