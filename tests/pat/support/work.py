"""Work of the tasks in the tests of jobs, in a module that processes import quickly."""

import os
import signal
import time
from pathlib import Path

from arraygeom.runtime.atomic import write_text
from pat.support.jobs import JobError


def note(path: Path, wait: float = 0.0) -> None:
    """Note the calling process beside the file, and write it; raise for a file named "bad"."""
    calls = path.with_suffix(".calls")
    with calls.open("a") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(wait)
    if path.stem == "bad":
        raise ValueError("not good\nat all")
    write_text(path, "done")


def befallen(path: Path, fate: str) -> None:
    """Crash, hang or raise as `fate` says, at the first try or each time; else write the number
    of threads."""
    first = not path.with_suffix(".tried").exists()
    path.with_suffix(".tried").touch()
    if fate == "crash" or (fate == "crash once" and first):
        os.kill(os.getpid(), signal.SIGSEGV)
    if fate == "hang once" and first:
        time.sleep(1000)
    if fate == "bug":
        raise LookupError("no such key")
    if fate == "full":
        raise JobError("the disk is full")
    write_text(path, os.environ["OMP_NUM_THREADS"])
