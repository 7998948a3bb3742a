"""The second process that compiles kernels: what it compiles, that it leaves torch alone, and that it ends."""

import json
import os
import subprocess
import sys
import time
from threading import Barrier, Thread

import pytest

from pat.cli import options
from pat.fusion import compiling


def run(code: str, **environment: str) -> str:
    """What a process of its own prints on standard output; its standard input stays open."""
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    ) as process:
        assert process.stdout is not None
        return process.stdout.read()


@pytest.mark.slow
def test_it_compiles_what_a_fusion_needs_and_nothing_else():
    code = """
import json
from pat.data.sample_array import ALPHA, load_sample
from pat.fusion.compiling import kernels
from pat.fusion.fuse import fuse
from pat.networks.weights import load_weights
sample = load_sample()
fuse(load_weights("mono-colour"), sample.rig, sample.images, alpha=ALPHA)
print(json.dumps({k.__name__: [str(s) for s in k.signatures] == [str(types)] for k, types in kernels()}))
"""
    found = json.loads(run(code))
    assert len(found) == 8
    assert all(found.values()), found


def test_it_keeps_what_it_compiles_and_does_not_import_torch(tmp_path):
    code = """
import sys
from pat.fusion import compiling
kernels = compiling.kernels
compiling.kernels = lambda: [next(kernels())]
compiling.main()
print("torch" in sys.modules, flush=True)
"""
    assert run(code, NUMBA_CACHE_DIR=str(tmp_path)).strip() == "False"
    assert [*tmp_path.glob("*/cost.census*.nbc")]


def test_attention_is_compiled_first():
    names = [kernel.__name__ for kernel, _ in compiling._as_needed_last()]
    assert names[0] == "forward"
    assert names[-1] == "census"


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs /proc")
def test_it_ends_with_its_parent_however_that_ends(tmp_path):
    code = """
import os, signal
from pat.fusion import compiling
from pat.support import jobs
jobs.cores = lambda: 2
started = compiling.subprocess.Popen
def start(*given, **options):
    process = started(*given, **options)
    print(process.pid, flush=True)
    return process
compiling.subprocess.Popen = start
compiling.compile_beside()
compiling.compile_beside()
os.kill(os.getpid(), signal.SIGKILL)
"""
    (child,) = map(int, run(code, NUMBA_CACHE_DIR=str(tmp_path)).split())
    end = time.monotonic() + 10
    while _runs(child) and time.monotonic() < end:
        time.sleep(0.05)
    assert not _runs(child)


def _runs(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat", encoding="utf-8") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_one_core_has_no_second_process(monkeypatch):
    monkeypatch.setattr("pat.support.jobs.cores", lambda: 1)
    monkeypatch.setattr(subprocess, "Popen", pytest.fail)
    compiling.compile_beside()


def test_what_is_compiled_is_seen_without_numba(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert not compiling.seems_compiled()
    folder = tmp_path / "kernels_0123"
    folder.mkdir()
    (folder / "forward.forward-1.py20.nbi").touch()
    assert not compiling.seems_compiled()
    (folder / f"forward.forward-1.py{sys.version_info.major}{sys.version_info.minor}.nbi").touch()
    assert compiling.seems_compiled()


def test_that_kernels_are_compiled_is_said_once(monkeypatch):
    event = pytest.importorskip("numba.core.event")
    said, listeners, barrier = [], [], Barrier(4)
    monkeypatch.setattr(event, "register", lambda kind, listener: listeners.append(listener))
    monkeypatch.setattr(options, "say", said.append)
    monkeypatch.setattr(compiling, "compile_beside", lambda: None)
    options.say_when_compiling.__wrapped__()

    def compile_one() -> None:
        barrier.wait()
        listeners[0].on_start(None)

    threads = [Thread(target=compile_one) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(said) == 1
