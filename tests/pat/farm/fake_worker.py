"""A worker without a renderer: `python fake_worker.py ROOT TAG BEHAVIOUR`, for the tests of what watches workers.

BEHAVIOUR is JSON: {"13": "segfault"} says what befalls a scene: "segfault", "once" (segfault at the first try),
"hang", "hang once", "refuse", "refuse twice", "error", "full"; {"start": "die"} what befalls the process. "pause" is a
time in seconds that each half of a scene takes.
"""

import ctypes
import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path

from pat.farm.folders import JobFolder, publish


def main(root: str, tag: str, behaviour: str) -> None:
    folder, behaves = JobFolder(Path(root)), json.loads(behaviour)
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)
    if behaves.get("start") == "die":
        sys.exit("no such library")
    say({"answer": "ready"})
    for line in sys.stdin:
        order = json.loads(line)
        say(answer(folder, tag, behaves, order["scene"], order["attempt"]))


def answer(folder: JobFolder, tag: str, behaves: dict, index: int, attempt: int) -> dict:
    kind = behaves.get(str(index))
    folder.journal("start", index, attempt=attempt)
    mark = folder.work / f"tried-{index}"
    if kind == "segfault" or (kind == "once" and not mark.exists()):
        mark.touch()
        sys.stderr.write("about to fall\n")
        sys.stderr.flush()
        os.kill(os.getpid(), signal.SIGSEGV)
    if kind == "hang" or (kind == "hang once" and not mark.exists()):
        mark.touch()
        time.sleep(1000)
    if kind == "refuse" or (kind == "refuse twice" and attempt < 2):
        return {"answer": "refused", "reason": "black"}
    if kind == "error":
        return {"answer": "crashed", "reason": "RuntimeError: no"}
    if kind == "full":
        return {"answer": "stop", "reason": "No space left on device"}
    partial = folder.partial(index, tag)
    partial.mkdir()
    for name in ("a", "b"):
        (partial / name).write_text(f"{index} {attempt}\n" * 1000)
        time.sleep(behaves.get("pause", 0))
    if not publish(partial, folder.scene(index)):
        shutil.rmtree(partial, ignore_errors=True)
    folder.journal("done", index, attempt=attempt)
    return {"answer": "done"}


def say(answer: dict) -> None:
    print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
