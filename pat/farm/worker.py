"""The process that renders scenes: `python -m pat.farm.worker JOB`, started by a `Workshop`.

It reads lines {"scene": 12, "attempt": 0} and answers each with a line: {"answer": "done"}, or "refused" (by the
self-check, or impossible: the next seed may do), "crashed" (an error of the renderer) or "stop" (nothing will do: a
library is missing, the disk is full), with a "reason". Its first line is {"answer": "ready"}. It ends when its
standard input ends, and dies with the process that started it.
"""

from __future__ import annotations

import ctypes
import errno
import json
import math
import os
import shutil
import signal
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from ..support.memory import resident
from .folders import publish

FACTS = "farm.json"
"""In every scene's folder: its number, attempt, seed, figures of the self-check, and its cost."""


def main(job: str) -> None:
    """Serve until standard input ends."""
    _die_with_parent()
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    try:
        server = _Server(Path(job))
    except Exception as error:
        traceback.print_exc()
        print(json.dumps({"answer": "stop", "reason": _line(error)}), file=answers, flush=True)
        return
    print(json.dumps({"answer": "ready"}), file=answers, flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        print(json.dumps(server.answer(order["scene"], order["attempt"])), file=answers, flush=True)


class _Server:
    """The job, and a renderer that is ready for its scenes."""

    def __init__(self, job: Path):
        from .job import Job

        self.job = Job.load(job)
        self.renderer = self.job.config.renderer()

    def answer(self, index: int, attempt: int) -> dict[str, Any]:
        """Render, check and publish a scene; the answer about it."""
        folder = self.job.folder
        partial = folder.partial(index, self.job.tag)
        folder.journal("start", index, attempt=attempt)
        try:
            reason = self._make(index, attempt, partial)
        except ValueError as error:
            reason = _line(error)
        except OSError as error:
            traceback.print_exc()
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            return {"answer": "stop" if full else "crashed", "reason": _line(error)}
        except Exception as error:
            traceback.print_exc()
            return {"answer": "crashed", "reason": f"{type(error).__name__}: {_line(error)}"}
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        folder.journal("refused" if reason else "done", index, attempt=attempt)
        return {"answer": "refused", "reason": reason} if reason else {"answer": "done"}

    def _make(self, index: int, attempt: int, partial: Path) -> str:
        """Why the scene is refused; empty if it was published."""
        seed, started = self.job.seed(index, attempt), (time.monotonic(), time.process_time())
        report = self.renderer.render(seed, partial)
        if not report.accepted:
            return "; ".join(report.reasons)
        facts = {
            "scene": index,
            "attempt": attempt,
            "seed": seed,
            "check": report.to_document(),
            "seconds": round(time.monotonic() - started[0], 3),
            "cpu_seconds": round(time.process_time() - started[1], 3),
            "memory_mb": round((resident() or math.nan) / 1e6, 1),
            "process": os.getpid(),
        }
        (partial / FACTS).write_text(json.dumps(facts, indent=1), encoding="utf-8")
        publish(partial, self.job.folder.scene(index))
        return ""


def _die_with_parent() -> None:
    """Ask Linux to kill this process when the one that started it dies; elsewhere standard input ends."""
    if sys.platform == "linux":
        pr_set_pdeathsig = 1
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, signal.SIGKILL)
    if os.getppid() != int(os.environ.get("PAT_FARM_PARENT", os.getppid())):
        sys.exit(1)


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


if __name__ == "__main__":
    main(sys.argv[1])
