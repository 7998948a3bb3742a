"""Tasks on several threads."""

import threading
import time

import pytest
import torch

from arraygeom.threads import in_parallel


def test_an_error_is_raised_once_no_task_runs_any_more(monkeypatch):
    """Else what a task writes would still appear after it was cleaned up."""
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    begun, both, done = [], threading.Barrier(2, timeout=10), []

    def slow():
        begun.append("slow")
        both.wait()
        time.sleep(0.2)
        done.append("slow")

    def fails():
        begun.append("fails")
        both.wait()
        raise OSError("full")

    with pytest.raises(OSError, match="full"):
        in_parallel([slow, fails, lambda: begun.append("third")])
    assert done == ["slow"]
    assert sorted(begun) == ["fails", "slow"]
