"""One worker process and what to do when it fails. Nothing here imports a renderer."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from ..support.jobs import JobError
from .folders import RESERVE, JobFolder

State = Literal["done", "there", "given up", "stopped"]


@dataclass(frozen=True, kw_only=True)
class RetryLimits:
    """When to give up.

    A worker ends after `recycle` scenes, so that nothing it leaks adds up. It has `timeout` seconds for a scene, and
    `start` for its own start. A scene whose self-check refuses it is made from the next seed, `refusals` times; one
    that crashes or hangs is tried again from the same seed, `crashes` times in all; being killed from outside (by
    an operator, or for memory) counts apart, `kills` times. Then the scene is given up.
    """

    recycle: int = 25
    timeout: float = 900.0
    start: float = 300.0
    refusals: int = 20
    crashes: int = 3
    kills: int = 20

    def __post_init__(self) -> None:
        for name in ("recycle", "timeout", "start", "refusals", "crashes", "kills"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be above 0, got {getattr(self, name):g}")


@dataclass(frozen=True, kw_only=True)
class Order:
    """What workers of a job need: where to render, how they are started, when to give up.

    `command` starts a worker that reads scenes as lines of JSON and answers each with a line (see `worker`).
    """

    root: Path
    tag: str
    command: tuple[str, ...]
    limits: RetryLimits = field(default_factory=RetryLimits)
    scene_bytes: float = 0.0

    @property
    def folder(self) -> JobFolder:
        """The job's folder."""
        return JobFolder(self.root)


@dataclass(frozen=True, kw_only=True)
class SceneOutcome:
    """The result of a scene. "there": it was done before; "stopped": not tried to the end."""

    index: int
    state: State
    refusals: int = 0
    crashes: int = 0
    reason: str = ""


class Workshop(AbstractContextManager["Workshop"]):
    """Makes scenes one after another with a process that it starts, watches and replaces."""

    def __init__(self, order: Order, stopping: Callable[[], bool] = lambda: False):
        self.order, self.stopping = order, stopping
        self._process: subprocess.Popen[bytes] | None = None
        self._log: Path | None = None
        self._made = self._lost_at_start = 0
        self._unread = b""

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process."""
        self._end()
        if self._log is not None:
            self._log.unlink(missing_ok=True)

    def make(self, index: int) -> SceneOutcome:
        """Make a scene unless it is there. Raises JobError for what would happen to every scene."""
        folder, limits = self.order.folder, self.order.limits
        crashes, kills, refusals, reason = 0, 0, 0, ""
        state: State = "there"
        while not folder.is_done(index):
            if self.stopping():
                state = "stopped"
                break
            answer = self._ask(index, refusals)
            reason = answer.get("reason", "")
            refusals += answer["answer"] == "refused"
            crashes += answer["answer"] == "crashed" or (answer["answer"] == "done" and not folder.is_done(index))
            kills += answer["answer"] == "killed"
            state = "done"
            if refusals >= limits.refusals or crashes >= limits.crashes or kills >= limits.kills:
                folder.give_up(index, reason, self._log_end(), refusals=refusals, crashes=crashes, kills=kills)
                state = "given up"
                break
        return SceneOutcome(index=index, state=state, refusals=refusals, crashes=crashes + kills, reason=reason)

    def _ask(self, index: int, attempt: int) -> dict[str, Any]:
        """One attempt. Raises JobError."""
        if self.order.folder.free() < RESERVE + 4 * self.order.scene_bytes:
            raise JobError(f"the disk of {self.order.root} is full: free space and run the same command again")
        process = self._started()
        order = {"scene": index, "attempt": attempt}
        try:
            assert process.stdin
            process.stdin.write(json.dumps(order).encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:
            return self._dead()
        answer = self._answer(self.order.limits.timeout)
        if answer["answer"] == "stop":
            raise JobError(answer["reason"])
        self._made += 1
        if self._made >= self.order.limits.recycle and self._process is not None:
            self._retire()
        return answer

    def _started(self) -> subprocess.Popen[bytes]:
        while self._process is None:
            self._start()
            answer = self._answer(self.order.limits.start)
            if answer["answer"] == "stop":
                raise JobError(answer["reason"])
            if answer["answer"] in ("crashed", "killed") and not self._may_start_again(answer):
                raise JobError(f"workers die when they start: {answer['reason']}")
        return self._process

    def _may_start_again(self, answer: dict[str, Any]) -> bool:
        """A process killed from outside while it starts is started again, as often as a scene would be."""
        self._lost_at_start += 1
        return answer["answer"] == "killed" and self._lost_at_start < self.order.limits.kills

    def _start(self) -> None:
        if self._log is None:
            self._log = self.order.folder.partial(0, f"log-{self.order.tag}").with_suffix(".txt")
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PAT_FARM_PARENT": str(os.getpid())}
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                self.order.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, env=environment
            )
        self._made, self._unread = 0, b""

    def _answer(self, timeout: float) -> dict[str, Any]:
        """The next line of the process; "crashed" or "killed" if there is none in time."""
        process, end = self._process, time.monotonic() + timeout
        assert process is not None
        assert process.stdout is not None
        while b"\n" not in self._unread:
            ready, _, _ = select.select([process.stdout], [], [], min(max(end - time.monotonic(), 0), 0.5))
            if not ready:
                if time.monotonic() >= end:
                    self._end()
                    return {"answer": "crashed", "reason": f"took longer than {timeout:g} s and was ended"}
                if self.stopping():
                    self._end()
                    return {"answer": "ended", "reason": "stopped"}
                continue
            read = os.read(process.stdout.fileno(), 1 << 16)
            if not read:
                return self._dead()
            self._unread += read
        line, _, self._unread = self._unread.partition(b"\n")
        return dict(json.loads(line))

    def _dead(self) -> dict[str, Any]:
        """The answer for a process that has ended by itself, or was ended from outside."""
        assert self._process is not None
        code = self._process.wait()
        self._end()
        if code == -9:
            return {"answer": "killed", "reason": "the worker was killed (SIGKILL; out of memory?)"}
        cause = signal.Signals(-code).name if code < 0 else f"exit status {code}"
        last = [line for line in self._log_end().splitlines() if line.strip()][-1:]
        return {"answer": "crashed", "reason": ": ".join([f"the worker died ({cause})", *last])}

    def _retire(self) -> None:
        """Let the process end by itself."""
        assert self._process is not None
        with suppress(subprocess.TimeoutExpired):
            self._process.communicate(timeout=30)
        self._end()

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def _log_end(self) -> str:
        """The end of the last process's log."""
        if self._log is None or not self._log.is_file():
            return ""
        return self._log.read_text(encoding="utf-8", errors="replace")[-20_000:]


def worker_command(job: Path) -> tuple[str, ...]:
    """How a worker for the job described in a file is started."""
    return sys.executable, "-X", "faulthandler", "-m", "pat.farm.worker", str(job)
