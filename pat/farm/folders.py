"""The folder of a job: scenes that are done, unfinished, or abandoned. Only the standard library."""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

RESERVE = 64 << 20
"""Bytes of disk that stay free."""


@dataclass(frozen=True)
class Shard:
    """Part `number` (from 1) of `count`: scenes number - 1, number - 1 + count, and so on."""

    number: int = 1
    count: int = 1

    @classmethod
    def parse(cls, text: str) -> Shard:
        """From "2/4". Raises ValueError.

        >>> Shard.parse("2/4").of(10)
        [1, 5, 9]
        """
        number, _, count = text.partition("/")
        if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
            raise ValueError(f"--shard: '{text}' is not i/n with i from 1 to n, such as 2/4")
        return cls(int(number), int(count))

    def of(self, scenes: int) -> list[int]:
        """The scenes of this part."""
        return list(range(self.number - 1, scenes, self.count))

    @property
    def tag(self) -> str:
        """For names of files."""
        return f"{self.number}of{self.count}"


@dataclass(frozen=True)
class JobFolder:
    """Names in a job's folder, and the scenes in it."""

    root: Path

    @property
    def scenes(self) -> Path:
        """The folder of complete scenes."""
        return self.root / "scenes"

    @property
    def work(self) -> Path:
        """The folder of unfinished scenes."""
        return self.root / ".work"

    def scene(self, index: int) -> Path:
        """The folder of a scene, whether it is there or not."""
        return self.scenes / f"{index:06d}"

    def quarantined(self, index: int) -> Path:
        """The folder of an abandoned scene, whether it is there or not."""
        return self.root / "quarantine" / f"{index:06d}"

    def is_done(self, index: int) -> bool:
        """Whether a scene is there."""
        return self.scene(index).is_dir()

    def done(self) -> list[int]:
        """The scenes that are there, in order."""
        return _numbers(self.scenes)

    def given_up(self) -> list[int]:
        """The scenes in quarantine, in order."""
        return _numbers(self.root / "quarantine")

    def partial(self, index: int, tag: str) -> Path:
        """A new name for an unfinished scene."""
        self.work.mkdir(parents=True, exist_ok=True)
        return self.work / f"{tag}-{index:06d}-{uuid4().hex[:12]}"

    def clean(self, tag: str) -> None:
        """Remove unfinished scenes and files of a former run of the same shard."""
        names = (f"{tag}-*", f".{tag}-*", f"log-{tag}-*", f".job-{tag}-*")
        for left in (path for name in names for path in self.work.glob(name)):
            shutil.rmtree(left) if left.is_dir() else left.unlink()

    @contextmanager
    def locked(self, tag: str) -> Iterator[None]:
        """Only one run of a shard at a time on this machine. Raises ValueError if there is one."""
        from filelock import FileLock, Timeout

        self.work.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.work / f"lock-{tag}", timeout=0)
        try:
            lock.acquire()
        except Timeout:
            message = f"{self.root}: another run is rendering into it: wait for it, or use --shard"
            raise ValueError(message) from None
        try:
            yield
        finally:
            lock.release()

    def journal(self, event: str, index: int, **facts: Any) -> None:
        """Note that something happened to a scene, in a file of this process alone."""
        folder = self.work / "journal"
        folder.mkdir(parents=True, exist_ok=True)
        line = json.dumps({"time": time.time_ns(), "scene": index, "event": event, **facts})
        with (folder / f"{socket.gethostname()}-{os.getpid()}.jsonl").open("a", encoding="utf-8") as file:
            file.write(line + "\n")

    def give_up(self, index: int, reason: str, log: str, **facts: Any) -> None:
        """Put a scene into quarantine."""
        partial = self.partial(index, "quarantine")
        partial.mkdir()
        (partial / "log.txt").write_text(log, encoding="utf-8")
        (partial / "reason.json").write_text(json.dumps({"reason": reason, **facts}, indent=1), encoding="utf-8")
        publish(partial, self.quarantined(index))

    def free(self) -> int:
        """Bytes of disk left."""
        self.root.mkdir(parents=True, exist_ok=True)
        return shutil.disk_usage(self.root).free

    def bytes_per_scene(self) -> float | None:
        """The mean size of up to 20 scenes that are there; None if there are none."""
        some = [self.scene(i) for i in self.done()[:20]]
        sizes = [sum(f.stat().st_size for f in scene.iterdir()) for scene in some]
        return sum(sizes) / len(sizes) if sizes else None


def publish(partial: Path, final: Path) -> bool:
    """Publish a complete folder under its name, after all of it is on disk; False if that is taken: it is removed."""
    for path in [*partial.iterdir(), partial]:
        _sync(path)
    final.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.rename(partial, final)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        shutil.rmtree(partial, ignore_errors=True)
        return False
    _sync(final.parent)
    return True


def _sync(path: Path) -> None:
    if os.name == "nt" and path.is_dir():  # Windows opens no folders
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _numbers(folder: Path) -> list[int]:
    return sorted(int(p.name) for p in folder.iterdir() if p.name.isdecimal()) if folder.is_dir() else []
