"""Tasks on several threads."""

import threading
import time

import pytest
import torch

from arraygeom.threads import in_parallel


class Noted(list):
    """Tasks, and whether all were taken."""

    def __init__(self, tasks):
        super().__init__(tasks)
        self.gone = threading.Event()

    def __iter__(self):
        left = super().__iter__()

        def taken():
            task = next(left, None)
            if task is None:
                self.gone.set()
            return task

        return iter(taken, None)


def test_an_error_is_raised_once_no_task_runs_any_more(monkeypatch):
    """Else what a task writes would still appear after it was cleaned up."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    begun, both, done = [], threading.Barrier(2, timeout=300), []

    def slow():
        begun.append("slow")
        both.wait()
        tasks.gone.wait(30)  # by the thread of the one that failed, as soon as it is its turn
        time.sleep(0.2)
        done.append("slow")

    def fails():
        begun.append("fails")
        both.wait()
        raise OSError("full")

    tasks = Noted([slow, fails, lambda: begun.append("third")])
    with pytest.raises(OSError, match="full"):
        in_parallel(tasks)
    assert done == ["slow"]
    assert sorted(begun) == ["fails", "slow"]
