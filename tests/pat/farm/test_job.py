"""Whole jobs with the layered backend: `pat render`."""

import errno
import importlib.util
import json
import os
import signal
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from arraygeom import Camera, Pose, Rig, intrinsics
from arraygeom.distortion import Distortion
from pat.cli.main import main
from pat.farm.backends import rig_from_alpha
from pat.farm.folders import JobFolder, Shard
from pat.farm.job import Job, RenderConfig
from pat.farm.run import RenderSummary, _prepared, check_space, render
from pat.farm.worker import _Server
from pat.farm.workshop import SceneOutcome
from pat.support.jobs import JobError
from pat.synthesis.rendered import Rendered
from tests.pat.farm import kills
from tests.pat.farm.journals import events, started_after_done
from tests.pat.farm.test_workshop import ROOT, children

RIG = """
depth: [2, 20]
cameras:
  mono: {size: [96, 64], focal: 120}
  colour: {size: [80, 60], focal: 90, rotation: [0, 1, 0.5], translation: [-0.1, 0, 0], response: rgb}
"""


@pytest.fixture
def config(tmp_path, monkeypatch) -> Path:
    """A file for tiny layered scenes, of patterns alone."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    (tmp_path / "rig.yaml").write_text(RIG)
    path = tmp_path / "render.yaml"
    write(path)
    return path


def write(path: Path, **changes) -> None:
    settings = {"rig": "rig.yaml", "seed": 1, "layered": {"layers": [4, 7], "oversampling": 1}}
    path.write_text(yaml.safe_dump(settings | changes))


def test_a_job_is_rendered_killed_and_resumed(config, tmp_path, capfd):
    """The first run loses a worker and then its parent; the second makes the rest."""
    out = tmp_path / "data"
    command = [sys.executable, "-c", "from pat.cli.main import main; main()", "render", str(config), "--out", str(out)]
    with kills.killed_in_the_end([*command, "--scenes", "40"]) as parent:
        kills.wait_until(lambda: len(JobFolder(out).done()) >= 2)
        os.kill(children(parent.pid)[0], signal.SIGKILL)
        known = len(JobFolder(out).done())
        kills.wait_until(lambda: len(JobFolder(out).done()) > known)
    had = len(JobFolder(out).done())
    main(["render", str(config), "--scenes", str(had + 2), "--out", str(out)])
    said = " ".join(capfd.readouterr().err.split())
    assert f"2 scenes made, {had} were there" in said
    assert JobFolder(out).done() == list(range(had + 2))
    assert started_after_done(out) == []
    table = [json.loads(line) for line in (out / "scenes.jsonl").read_text().splitlines()]
    assert [row["scene"] for row in table] == list(range(had + 2))
    assert all(row["check"]["accepted"] and row["memory_mb"] > 50 for row in table)
    scene = Rendered(out / "scenes/000001")
    assert scene.accepted
    assert scene.rig.names == ("mono", "colour")
    frame = scene.frame("colour")
    assert frame.rgb.shape == (3, 60, 80)
    assert frame.depth.isfinite().all()
    assert (frame.index > 0).all()


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("backend", ["layered", "blender"])
def test_thirty_scenes_survive_ten_kills_and_dask_makes_the_same(tmp_path, monkeypatch, backend):
    if backend == "blender" and importlib.util.find_spec("bpy") is None:
        pytest.skip("Blender is not installed: pip install '.[synthesis]'")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    path, out = kills.write_config(tmp_path, backend), tmp_path / "data"
    survived = kills.killed_again_and_again(path, out, scenes=30, kills=10)
    assert survived.workers_killed + survived.commands_killed == 10
    assert kills.faults(out, 30) == []
    again = tmp_path / "dask"
    summary = render(RenderConfig.load(path), scenes=30, out=again, workers=2, scheduler="local")
    assert summary.made == 30
    light = [kills.difference(JobFolder(out).scene(i), JobFolder(again).scene(i)) for i in range(30)]
    assert max(light) < 1e-3
    part = tmp_path / "part"
    render(RenderConfig.load(path), scenes=2, out=part, shard=Shard(1, 2))
    assert JobFolder(part).done() == [0]
    assert kills.difference(JobFolder(out).scene(0), JobFolder(part).scene(0)) < 1e-3


def fails(arguments, capfd) -> str:
    with pytest.raises(SystemExit) as stop:
        main([str(a) for a in arguments])
    assert stop.value.code == 2
    return " ".join(capfd.readouterr().err.split())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sed": 3}, "render.yaml: sed: unknown key; did you mean 'seed'?"),
        ({"backend": "blendr"}, "render.yaml: backend: is 'blendr'; did you mean 'blender'?"),
        ({"layered": {"layer": [1, 2]}}, "layered.layer: unknown key; did you mean 'layers'?"),
        ({"limits": {"timeout": -1}}, "limits: timeout must be above 0"),
        ({"rig": "rg.yaml"}, "rg.yaml: no such file or folder"),
        ({"layered": {"photos": ["images"]}}, "images: no such file or folder"),
        ({"blender": {"generator": "photographs"}}, "blender: the generator 'photographs' needs a folder `photos`"),
        ({"blender": {"generator": "still-life"}}, "blender: no generator is called 'still-life': use abstract,"),
        (
            {"backend": "blender", "blender": {"generator": "experiments.scenes:no"}},
            "the generator 'experiments.scenes:no' cannot be imported",
        ),
        ({"blender": {"settings": {"sample": 3}}}, "settings.sample: unknown key; did you mean 'samples'?"),
    ],
)
def test_typos_are_one_line(config, tmp_path, capfd, changes, words):
    write(config, **changes)
    said = fails(["render", config, "--scenes", 2, "--out", tmp_path / "data"], capfd)
    assert words in said
    assert not (tmp_path / "data").exists()


def test_other_mistakes_are_one_line(config, tmp_path, capfd):
    out = tmp_path / "data"
    assert "no.yaml: no such file" in fails(["render", tmp_path / "no.yaml", "--scenes", 2, "--out", out], capfd)
    assert "is not i/n" in fails(["render", config, "--scenes", 2, "--out", out, "--shard", "3/2"], capfd)
    assert "at least one scene" in fails(["render", config, "--scenes", 0, "--out", out], capfd)
    (tmp_path / "rig.yaml").write_text("cameras: {mono: {size: [8, 8]}}")
    said = fails(["render", config, "--scenes", 2, "--out", out], capfd)
    assert "camera 'mono' is not calibrated: rendering needs its K, R and t" in said


@pytest.mark.parametrize(("shard", "stays"), [(Shard(), False), (Shard(1, 2), True)])
def test_what_a_killed_run_had_begun_to_write_is_removed_where_no_other_writes(shard, stays, config, tmp_path):
    out = tmp_path / "data"
    left = [out / name for name in (f".scenes-{'0' * 32}.jsonl", f".work/.job-{shard.tag}-{'0' * 32}.json")]
    left[1].parent.mkdir(parents=True)
    for path in left:
        path.touch()
    _prepared(Job(config=RenderConfig.load(config), root=out, tag=shard.tag), [0])
    assert [path.exists() for path in left] == [stays, False]


def test_a_folder_of_another_configuration_is_refused(config, tmp_path):
    job = Job(config=RenderConfig.load(config), root=tmp_path / "data", tag="1of1")
    job.root.mkdir()
    job.write_manifest()
    job.write_manifest()
    write(config, seed=2)
    with pytest.raises(ValueError, match="holds scenes made from another seed: give another --out"):
        Job(config=RenderConfig.load(config), root=job.root, tag="1of1").write_manifest()
    write(config)
    (tmp_path / "rig.yaml").write_text(RIG.replace("120", "130"))
    with pytest.raises(ValueError, match=r"another rig: give another --out, or put rig\.yaml back"):
        Job(config=RenderConfig.load(config), root=job.root, tag="1of1").write_manifest()


def test_more_scenes_than_disk_are_refused_before_the_first(config, tmp_path, monkeypatch):
    monkeypatch.setattr(JobFolder, "free", lambda self: 100_000_000)
    with pytest.raises(ValueError, match=r"5000 more scenes of about 1.0 MB need 5.1 GB .* 32 would fit"):
        check_space(JobFolder(tmp_path), 5000, 1e6)
    check_space(JobFolder(tmp_path), 0, 1e6)
    with pytest.raises(ValueError, match="100000 more scenes"):
        render(RenderConfig.load(config), scenes=100_000, out=tmp_path / "data")
    assert not JobFolder(tmp_path / "data").done()


def test_a_disk_that_fills_stops_the_job_cleanly(config, tmp_path, monkeypatch):
    monkeypatch.setattr("pat.farm.run.check_space", lambda *_: None)
    monkeypatch.setattr(JobFolder, "free", lambda self: 1000)
    with pytest.raises(JobError, match="is full: free space"):
        render(RenderConfig.load(config), scenes=3, out=tmp_path / "data")
    assert (tmp_path / "data" / "scenes.jsonl").read_text() == ""


def test_a_worker_reads_its_job_and_reports_what_goes_wrong(config, tmp_path, monkeypatch):
    write(config, check={"texture": 1.1})
    job = Job(config=RenderConfig.load(config), root=tmp_path / "data", tag="1of1")
    job.root.mkdir()
    job.save()
    assert Job.load(job.file) == job
    server = _Server(job.file)
    answer = server.answer(0, 0)
    assert answer["answer"] == "refused"
    assert "mono: " in answer["reason"]
    assert "has texture (at least 110%)" in answer["reason"]
    for error, wanted in (
        (
            OSError(errno.ENOSPC, "No space left on device"),
            {"answer": "stop", "reason": "[Errno 28] No space left on device"},
        ),
        (OSError(errno.EIO, "broken"), {"answer": "crashed", "reason": "[Errno 5] broken"}),
        (RuntimeError("two\nlines"), {"answer": "crashed", "reason": "RuntimeError: two lines"}),
        (ValueError("inside an object"), {"answer": "refused", "reason": "inside an object"}),
    ):
        monkeypatch.setattr(server, "_make", raising(error))
        assert server.answer(0, 0) == wanted
    assert not list((tmp_path / "data/.work").glob("1of1-*"))


def raising(error: Exception):
    def fail(*_):
        raise error

    return fail


def test_seeds_are_of_the_scene_and_the_attempt_alone(config, tmp_path):
    job = Job(config=RenderConfig.load(config), root=tmp_path, tag="1of1")
    other = Job(config=RenderConfig.load(config), root=tmp_path / "x", tag="2of4")
    seeds = {job.seed(i, k) for i in range(20) for k in range(3)}
    assert len(seeds) == 60
    assert job.seed(7, 1) == other.seed(7, 1)


def test_rigs_that_layers_cannot_show_are_refused():
    camera = Camera(K=intrinsics(90.0, (8, 8)), cam_from_world=Pose.identity(), hw=(8, 8))
    lens = Distortion("brown-conrady", camera.K.new_tensor([0.1, 0, 0, 0]))
    with pytest.raises(ValueError, match="'a' has a lens model"):
        rig_from_alpha(Rig({"a": camera.replace(distortion=lens)}, depth=(1, 2)))
    with pytest.raises(ValueError, match="no depth range"):
        rig_from_alpha(Rig({"a": camera}))
    assert rig_from_alpha(Rig({"a": camera}, depth=(1, float("inf")))).far.tolist() == [50.0]


def test_the_summary_counts():
    summary = RenderSummary(there=3)
    for state, refusals in (("done", 2), ("done", 0), ("given up", 20), ("stopped", 0)):
        outcome = SceneOutcome(index=5, state=state, refusals=refusals, crashes=1)
        summary.add(replace(outcome, reason="its workers died: X") if state == "stopped" else outcome)
    assert not summary.complete
    assert str(summary).endswith("given up: 5, 1 not made (its workers died: X): run the command again")
    assert str(summary).startswith("2 scenes made, 3 were there")
    assert "22 refused by the check, 4 crashed, given up: 5" in str(summary)
    assert Shard.parse("1/1") == Shard()
    assert threading.active_count() >= 1
    assert events(Path("/nonexistent")) == []
