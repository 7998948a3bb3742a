"""Peaks of memory are those of the work, and of the process."""

import subprocess
import sys
import threading

import numpy as np
import pytest

from experiments.peaks import watch_peak, with_peak
from pat.support.memory import peak_memory


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_peak_of_work_is_what_it_held_at_most():
    """100 MiB held and let go, whatever was held before."""
    held = np.ones(2**25)
    del held
    value, grown = with_peak(lambda: float(np.ones(100 * 2**17).sum()))
    assert value == 100 * 2**17
    assert 95 * 2**20 < grown < 115 * 2**20


@pytest.mark.skipif(sys.platform != "linux", reason="read from /proc")
def test_the_peak_of_a_process_is_its_own_not_that_of_its_parent(monkeypatch):
    held = np.ones(2**26)  # 512 MiB resident here while the other starts
    code = "held = bytearray(100 << 20); del held; print(flush=True); input()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    looked = threading.Semaphore(0)

    def noted(pid):
        found = peak_memory(pid)
        looked.release()
        return found

    monkeypatch.setattr("experiments.peaks.peak_memory", noted)
    with subprocess.Popen([sys.executable, "-I", "-S", "-c", code], **pipes) as process:
        peak = watch_peak(process.pid, every=0.01)
        process.stdout.readline()
        while looked.acquire(blocking=False):
            pass
        assert all(looked.acquire(timeout=300) for _ in range(2))  # the second is after it had its memory
        process.communicate("\n")
        peak = peak()
    assert process.returncode == 0
    assert held.nbytes == 2**29
    assert 100 * 2**20 < peak < 200 * 2**20
    assert watch_peak(process.pid)() == 0
