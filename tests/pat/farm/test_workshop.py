import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from pat.farm.folders import JobFolder, Shard, publish
from pat.farm.pools import dask_pool, local_pool
from pat.farm.workshop import RetryLimits, SceneOutcome, Workshop
from pat.support.jobs import JobError, Workers
from tests.pat.farm.fake_job import order
from tests.pat.farm.journals import events, started_after_done

ROOT = Path(__file__).parents[3]


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def make(root: Path, index: int, behaviour: dict | None = None, **limits: float) -> SceneOutcome:
    with Workshop(order(root, behaviour, **limits)) as workshop:
        return workshop.make(index)


def reason(root: Path, index: int) -> dict:
    return json.loads((JobFolder(root).quarantined(index) / "reason.json").read_text())


def test_a_scene_is_made_once(tmp_path):
    assert make(tmp_path, 3).state == "done"
    assert (tmp_path / "scenes/000003/a").read_text() == "3 0\n" * 1000
    assert make(tmp_path, 3).state == "there"
    assert len(events(tmp_path)) == 2
    assert [p.name for p in (tmp_path / ".work").iterdir()] == ["journal"]


def test_a_refused_scene_is_made_from_the_next_seed_and_counted(tmp_path):
    outcome = make(tmp_path, 3, {"3": "refuse twice"})
    assert (outcome.state, outcome.refusals) == ("done", 2)
    assert (tmp_path / "scenes/000003/a").read_text().startswith("3 2\n")


def test_a_scene_refused_again_and_again_is_given_up(tmp_path):
    outcome = make(tmp_path, 3, {"3": "refuse"}, refusals=4)
    assert (outcome.state, outcome.refusals) == ("given up", 4)
    assert reason(tmp_path, 3) == {"reason": "black", "refusals": 4, "crashes": 0, "kills": 0}


def test_a_crash_is_tried_again_from_the_same_seed(tmp_path):
    outcome = make(tmp_path, 3, {"3": "once"})
    assert (outcome.state, outcome.crashes) == ("done", 1)
    assert (tmp_path / "scenes/000003/a").read_text().startswith("3 0\n")


def test_a_scene_that_always_crashes_is_given_up_with_its_log(tmp_path):
    outcome = make(tmp_path, 3, {"3": "segfault"}, crashes=2)
    assert (outcome.state, outcome.crashes) == ("given up", 2)
    assert reason(tmp_path, 3)["reason"] == "the worker died (SIGSEGV): about to fall"
    assert "about to fall" in (JobFolder(tmp_path).quarantined(3) / "log.txt").read_text()


def test_an_error_of_the_renderer_counts_as_a_crash(tmp_path):
    assert make(tmp_path, 3, {"3": "error"}, crashes=2).state == "given up"
    assert reason(tmp_path, 3)["reason"] == "RuntimeError: no"


def test_a_hanging_worker_is_ended(tmp_path):
    started = time.monotonic()
    outcome = make(tmp_path, 3, {"3": "hang"}, timeout=0.3, crashes=2)
    assert (outcome.state, outcome.crashes) == ("given up", 2)
    assert "took longer than 0.3 s" in reason(tmp_path, 3)["reason"]
    assert time.monotonic() - started < 300


def test_what_would_befall_every_scene_stops_the_job(tmp_path):
    with pytest.raises(JobError, match="No space left"):
        make(tmp_path, 3, {"3": "full"})
    with pytest.raises(JobError, match=r"workers die when they start: .*exit status 1.*no such library"):
        make(tmp_path, 4, {"start": "die"})
    with pytest.raises(JobError, match="No space left"):
        list(local_pool(order(tmp_path, {"5": "full", "pause": 0.01}), range(20), 2))


def test_workers_are_replaced_before_they_grow_old(tmp_path):
    with Workshop(order(tmp_path, recycle=3)) as workshop:
        for index in range(7):
            workshop.make(index)
    assert len(list((tmp_path / ".work/journal").iterdir())) == 3


def test_a_full_disk_is_seen_before_it_is_full(tmp_path, monkeypatch):
    monkeypatch.setattr(JobFolder, "free", lambda self: 1000)
    with pytest.raises(JobError, match="is full: free space and run the same command again"):
        make(tmp_path, 3)


def test_publishing_keeps_what_is_there(tmp_path):
    for name, text in (("first", "1"), ("second", "2")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text(text)
    assert publish(tmp_path / "first", tmp_path / "scenes" / "x")
    assert not publish(tmp_path / "second", tmp_path / "scenes" / "x")
    assert (tmp_path / "scenes/x/a").read_text() == "1"
    assert not (tmp_path / "second").exists()


def test_shards_share_the_scenes_out():
    parts = [Shard.parse(f"{i}/3").of(10) for i in (1, 2, 3)]
    assert sorted(i for part in parts for i in part) == list(range(10))
    for text in ("0/3", "4/3", "1", "a/b", "1/0"):
        with pytest.raises(ValueError, match="is not i/n"):
            Shard.parse(text)


def test_a_shard_cleans_only_after_itself(tmp_path):
    folder = JobFolder(tmp_path)
    left = [folder.partial(0, tag) for tag in ("1of12", "11of12", "1of2")]
    for path in left:
        path.mkdir()
    left += [folder.work / f".job-{tag}-{'0' * 32}.json" for tag in ("1of12", "11of12", "1of2")]
    for path in left[3:]:
        path.touch()
    folder.clean("1of12")
    assert [p.exists() for p in left] == [False, True, True] * 2


def test_one_run_at_a_time(tmp_path):
    folder = JobFolder(tmp_path)
    with (
        folder.locked("1of2"),
        folder.locked("2of2"),
        pytest.raises(ValueError, match="another run is rendering"),
        folder.locked("1of2"),
    ):
        pass


def test_limits_are_positive():
    with pytest.raises(ValueError, match="timeout must be above 0"):
        RetryLimits(timeout=0)


def is_whole(root: Path, index: int) -> bool:
    texts = [(root / "scenes" / f"{index:06d}" / name).read_text() for name in ("a", "b")]
    return texts == [f"{index} 0\n" * 1000] * 2


def test_killing_workers_and_parents_at_random_loses_and_doubles_nothing(tmp_path):
    """kill -9, ten times over 30 scenes: six times the parent, four times a worker."""
    choose = random.Random(0)
    script = str(Path(__file__).with_name("fake_job.py"))
    for kill_parent in [True, False, True, False, True, True, False, True, False, True]:
        parent = subprocess.Popen([sys.executable, script, str(tmp_path), "30", "2", "0.05"], stderr=subprocess.PIPE)
        time.sleep(choose.uniform(0.25, 0.5))
        workers = children(parent.pid)
        os.kill(parent.pid if kill_parent or not workers else choose.choice(workers), signal.SIGKILL)
        if not kill_parent:
            time.sleep(choose.uniform(0.05, 0.2))
            parent.kill()
        parent.communicate()
        wait_for_the_end_of(workers)
        assert not [p for p in (tmp_path / "scenes").glob("*") if not is_whole(tmp_path, int(p.name))]
    last = subprocess.run([sys.executable, script, str(tmp_path), "30", "2", "0"], check=True, capture_output=True)
    assert last.stderr == b""
    assert JobFolder(tmp_path).done() == list(range(30))
    assert all(is_whole(tmp_path, i) for i in range(30))
    assert not JobFolder(tmp_path).given_up()
    assert started_after_done(tmp_path) == []
    assert not list((tmp_path / ".work").glob("1of1-*"))


def children(pid: int) -> list[int]:
    try:
        threads = Path(f"/proc/{pid}/task").iterdir()
        return [int(c) for t in threads for c in (t / "children").read_text().split()]
    except OSError:
        return []


def wait_for_the_end_of(pids: list[int]) -> None:
    """Workers die with their parent; the kernel needs a moment."""
    end = time.monotonic() + 300
    while any(Path(f"/proc/{pid}").exists() for pid in pids):
        assert time.monotonic() < end, "a worker outlived its parent"
        time.sleep(0.01)


def test_a_worker_killed_from_outside_is_replaced(tmp_path):
    def kill_once_at_work(pid: int) -> None:
        while not (tmp_path / ".work" / "tried-1").exists():
            time.sleep(0.01)
        os.kill(pid, signal.SIGKILL)

    with Workshop(order(tmp_path, {"1": "hang once"})) as workshop:
        workshop.make(0)
        killer = threading.Thread(target=kill_once_at_work, args=(workshop._process.pid,))
        killer.start()
        outcome = workshop.make(1)
        killer.join()
    assert (outcome.state, outcome.crashes) == ("done", 1)


def test_dask_makes_the_same_scenes(tmp_path):
    pytest.importorskip("distributed")
    behaviour = {"2": "refuse twice", "3": "segfault", "4": "once"}
    outcomes = {}
    for name in ("local", "dask"):
        (tmp_path / name).mkdir()
        job = order(tmp_path / name, behaviour, crashes=2)
        pool = local_pool(job, range(6), 2) if name == "local" else dask_pool(job, range(6), Workers(2, "local"))
        outcomes[name] = sorted((o.index, o.state, o.refusals, o.crashes) for o in pool)
    assert outcomes["local"] == outcomes["dask"]
    assert [o[1] for o in outcomes["dask"]] == ["done", "done", "done", "given up", "done", "done"]
    for i in (0, 1, 2, 4, 5):
        one, other = ((tmp_path / n / "scenes" / f"{i:06d}" / "a").read_text() for n in ("local", "dask"))
        assert one == other


def test_a_scheduler_that_is_not_there_is_named(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    client = distributed.Client
    monkeypatch.setattr(distributed, "Client", lambda address, timeout: client(address, timeout=1))
    with pytest.raises(ValueError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:9"):
        list(dask_pool(order(tmp_path), range(2), Workers(scheduler="tcp://127.0.0.1:9")))
