"""Tasks: once each, resumed, the same in other processes; killed workers and commands lose nothing."""

import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import as_completed, wait
from io import StringIO
from pathlib import Path

import pytest
import torch
from rich.console import Console

from arraygeom.runtime.threads import limited_to
from pat.support.jobs import JobError, Task, Workers, followed, run_tasks
from tests.pat.app.test_batch import contents, material  # noqa: F401  (a fixture)
from tests.pat.support.work import befallen, note


def tasks(folder: Path, *names: str, wait: float = 0.0) -> list[Task]:
    return [Task(folder / f"{name}.txt", note, (folder / f"{name}.txt", wait)) for name in names]


def test_what_is_there_is_not_repeated(tmp_path):
    assert str(run_tasks(tasks(tmp_path, "a", "b"))) == "2 made"
    again = run_tasks(tasks(tmp_path, "a", "b", "c"), resume=True)
    assert str(again) == "1 made, 2 there already"
    assert len((tmp_path / "a.calls").read_text().split()) == 1
    run_tasks(tasks(tmp_path, "a"))
    assert len((tmp_path / "a.calls").read_text().split()) == 2


def test_errors_stop_or_are_skipped(tmp_path):
    with pytest.raises(JobError, match=r"bad.txt.*--resume"):
        run_tasks(tasks(tmp_path, "a", "bad", "b"))
    assert (tmp_path / "a.txt").exists()
    assert not (tmp_path / "b.txt").exists()
    report = run_tasks(tasks(tmp_path, "a", "bad", "b"), resume=True, on_error="skip")
    assert str(report) == "1 made, 1 there already, 1 failed"


def test_a_job_that_failed_leaves_torch_its_threads(tmp_path):
    with limited_to(2):
        with pytest.raises(JobError) as kept:
            run_tasks(tasks(tmp_path, "bad", "b"), workers=Workers(threads=1))
        assert torch.get_num_threads() == 2
    assert "not good" in str(kept.value)  # until here its traceback is kept


def test_a_message_names_what_a_task_is_about(tmp_path):
    """In a sequence the frame, not the file of its colour."""
    bad = tasks(tmp_path, "bad")[0]._replace(about="mono/0001.png")
    with pytest.raises(JobError, match=r"^mono/0001.png: "):
        run_tasks([bad])


def test_processes_do_the_same_and_say_the_same(tmp_path, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    names = [f"{i}" for i in range(10)]
    report = run_tasks(tasks(tmp_path, *names, "bad"), workers=Workers(2), on_error="skip")
    assert len(report.made) == 10
    assert list(report.failed.values()) == ["not good at all"]
    pids = {line for name in names for line in (tmp_path / f"{name}.calls").read_text().split()}
    assert len(pids) == 2
    assert str(os.getpid()) not in pids
    assert "OMP_NUM_THREADS" not in os.environ, "that is for the processes alone"


def test_what_crashes_or_hangs_is_tried_again_and_fails_alone(tmp_path, monkeypatch):
    monkeypatch.setattr("pat.support.jobs.TRIES", 2)
    fates = ("well", "crash once", "hang once", "crash", "bug")
    todo = [Task(tmp_path / f"{fate}.txt", befallen, (tmp_path / f"{fate}.txt", fate)) for fate in fates]
    report = run_tasks(todo, workers=Workers(apart=True, timeout=12.0), on_error="skip")
    assert {path.stem for path in report.made} == {"well", "crash once", "hang once"}
    assert (tmp_path / "well.txt").read_text() == "1"
    said = {path.stem: error for path, error in report.failed.items()}
    assert said == {"crash": "its process died", "bug": "LookupError: no such key"}


@pytest.mark.parametrize("count", [1, 2])
def test_what_would_befall_every_task_stops_the_job(tmp_path, monkeypatch, count):
    """However late the job's own thread hears of it on a busy machine."""
    monkeypatch.setattr("pat.support.jobs.as_completed", lambda futures: as_completed(wait(futures).done))
    todo = [Task(tmp_path / f"{i}.txt", befallen, (tmp_path / f"{i}.txt", "full")) for i in range(20)]
    with pytest.raises(JobError, match="disk"):
        run_tasks(todo, workers=Workers(count), on_error="skip")
    assert len(list(tmp_path.glob("*.tried"))) <= count


def test_a_scheduler_that_is_not_there_is_named(tmp_path):
    pytest.importorskip("distributed")
    with pytest.raises(ValueError, match="nowhere"):
        run_tasks(tasks(tmp_path, "a"), workers=Workers(scheduler="nowhere://x:1"))


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(tmp_path):
    """SIGKILL to a worker at a task: all tasks are done, and only that one again."""
    names = [f"{i:02d}" for i in range(40)]

    def kill_one() -> None:
        while len(list(tmp_path.glob("*.txt"))) < 6:
            time.sleep(0.02)
        last = max(tmp_path.glob("*.calls"), key=lambda p: p.stat().st_mtime)
        os.kill(int(last.read_text().split()[0]), signal.SIGKILL)

    killer = threading.Thread(target=kill_one)
    killer.start()
    report = run_tasks(tasks(tmp_path, *names, wait=0.1), workers=Workers(2))
    killer.join()
    assert len(report.made) == 40
    assert all((tmp_path / f"{name}.txt").read_text() == "done" for name in names)
    repeated = [n for n in names if len((tmp_path / f"{n}.calls").read_text().split()) > 1]
    assert len(repeated) <= 2


@pytest.mark.slow
def test_a_killed_command_is_resumed_to_the_same_bits(material, tmp_path):  # noqa: F811
    """Forty frames, two workers, everything killed with SIGKILL in the middle, begun again with --resume."""
    (tmp_path / "fast").mkdir()
    (tmp_path / "slow").mkdir()
    for i in range(40):
        os.link(material / "fast" / f"fast_{8 + i % 7}.png", tmp_path / "fast" / f"f{i}.png")
        os.link(material / "slow" / f"slow_{8 + i % 2}.png", tmp_path / "slow" / f"s{i}.png")
    images = [a for name in ("fast", "slow") for a in ("--image", f"{name}={tmp_path / name}")]
    given = ["--rig", material / "rig.yaml", "--network", material / "tiny.safetensors", "--alpha", "fast"]
    run = "import sys; from pat.app.cli.main import main\nif __name__ == '__main__': main(sys.argv[1:])"
    (tmp_path / "run.py").write_text(run)

    def command(out: str, *more: str) -> subprocess.Popen:
        line = [sys.executable, tmp_path / "run.py", "batch", *given, *images, "--out", tmp_path / out, *more]
        environment = {**os.environ, "PYTHONPATH": os.getcwd()}
        return subprocess.Popen([str(a) for a in line], env=environment, start_new_session=True)

    assert command("whole", "--threads", "1").wait() == 0
    stopped = command("part", "--workers", "2")
    while len(list((tmp_path / "part").glob("*_fused.png"))) < 5:
        assert stopped.poll() is None
        time.sleep(0.05)
    os.killpg(stopped.pid, signal.SIGKILL)
    stopped.wait()
    before = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "part").glob("*_fused.png")}
    assert 5 <= len(before) < 40
    assert command("part", "--workers", "2", "--resume").wait() == 0
    after = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "part").glob("*_fused.png")}
    assert len(after) == 40
    assert {n: after[n] for n in before} == before
    assert contents(tmp_path / "part") == contents(tmp_path / "whole")


@pytest.mark.slow
def test_workers_of_a_scheduler_elsewhere_do_the_work(tmp_path):
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        there = Workers(scheduler=cluster.scheduler_address)
        report = run_tasks(tasks(tmp_path, "a", "b", "bad"), workers=there, on_error="skip")
    assert len(report.made) == 2
    assert str(os.getpid()) not in (tmp_path / "a.calls").read_text().split()


@pytest.mark.parametrize("seconds", [[40, 10, 11, 9, 10, 12, 10, 9], [8, 10, 9, 11, 10, 10], [3, 3]])
def test_the_time_left_is_right_within_half_once_two_tasks_are_done(seconds, monkeypatch):
    """The first task of a process may take far longer, as it compiles."""
    now, text = [0.0], StringIO()
    monkeypatch.setattr("pat.support.jobs.LINE_EVERY", -1.0)

    def outcomes():
        for one in seconds:
            now[0] += one
            yield one

    console = Console(file=text, width=80, get_time=lambda: now[0])
    assert list(followed(outcomes(), title="jobs", total=len(seconds), done=0, console=console)) == seconds
    lines = text.getvalue().splitlines()
    assert "left" not in lines[0]
    assert lines[-1] == f"jobs: {len(seconds)} of {len(seconds)}"
    for done, line in [*enumerate(lines, 1)][1:-1]:
        left = sum(seconds[done:])
        assert left / 1.5 <= float(re.search(r"about (\d+) s left", line)[1]) <= 1.5 * left


def test_a_time_limit_leaves_some_time():
    for timeout in (0, math.inf, 1e30, math.nan):
        with pytest.raises(ValueError, match="timeout"):
            Workers(timeout=timeout)
