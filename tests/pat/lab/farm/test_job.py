"""Whole jobs with the layered backend: `pat lab render`."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml

from arraygeom import Camera, Pose, Rig, intrinsics
from arraygeom.distortion import Distortion
from pat.app.cli.main import main
from pat.lab.farm.backends import LayeredSettings, rig_from_alpha
from pat.lab.farm.job import (
    RenderConfig,
    Shard,
    check_space,
    publish,
    render,
    scene_seed,
    summarise,
    write_manifest,
)
from pat.lab.synthesis.rendered import Rendered
from pat.support.jobs import JobError
from tests.pat.lab.synthesis.scenes import needs_blender

ROOT = Path(__file__).parents[4]
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


def done(out: Path) -> list[int]:
    """The scenes that are there."""
    return sorted(int(path.name) for path in (out / "scenes").glob("*"))


def times(out: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in (out / "scenes").glob("*")}


def children(pid: int) -> list[int]:
    """The processes that render for a command."""
    try:
        texts = [(task / "children").read_text() for task in Path(f"/proc/{pid}/task").iterdir()]
        found = [int(child) for text in texts for child in text.split()]
        return [c for c in found if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]
    except OSError:
        return []


def wait_until(condition) -> None:
    end = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_a_job_is_rendered_killed_and_resumed(config, tmp_path, capfd):
    """The first run loses a worker, then is killed with its other worker; the second makes the rest."""
    out = tmp_path / "data"
    command = [sys.executable, "-m", "pat", "lab", "render", str(config), "--out", str(out), "--scenes", "40"]
    parent = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    wait_until(lambda: len(done(out)) >= 2)
    os.kill(children(parent.pid)[0], signal.SIGKILL)
    known = len(done(out))
    wait_until(lambda: len(done(out)) > known)
    (worker,) = children(parent.pid)
    parent.kill()
    parent.wait()
    wait_until(lambda: not Path(f"/proc/{worker}").exists())
    had = times(out)
    main(["lab", "render", str(config), "--scenes", str(len(had) + 2), "--out", str(out), "--workers", "2"])
    assert f"2 made, {len(had)} there already" in " ".join(capfd.readouterr().err.split())
    assert done(out) == list(range(len(had) + 2))
    assert {name: times(out)[name] for name in had} == had
    assert not list(tmp_path.rglob("[.]work/*/*"))
    facts = [json.loads(path.read_text()) for path in sorted(out.glob("scenes/*/farm.json"))]
    assert [row["scene"] for row in facts] == done(out)
    assert all(row["check"]["accepted"] and row["memory_mb"] > 50 for row in facts)
    scene = Rendered(out / "scenes/000001")
    assert scene.about["check"]["accepted"]
    assert scene.rig.names == ("mono", "colour")
    frame = scene.frame("colour")
    assert frame.rgb.shape == (3, 60, 80)
    assert frame.depth.isfinite().all()
    assert (frame.index > 0).all()
    main(["lab", "data", "info", str(out)])
    assert f"{len(facts)} scenes of mono 96x64, colour 80x60" in capfd.readouterr().out
    for text in ('{"seconds": 3}', "damaged", "[]"):
        (out / "scenes/000001/farm.json").write_text(text)
        with pytest.raises(ValueError, match=r"000001/farm\.json"):
            summarise(out)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["layered", "blender"])
def test_shards_and_dask_make_the_same(config, tmp_path, backend):
    if backend == "blender":
        needs_blender()
    from distributed import LocalCluster

    write(config, backend=backend, blender={"settings": {"width": 96, "samples": 2}})
    chosen = RenderConfig.load(config)
    whole, parts, dask = (tmp_path / name for name in ("whole", "parts", "dask"))
    assert len(render(chosen, scenes=4, out=whole, workers=2).made) == 4
    assert [len(render(chosen, scenes=4, out=parts, shard=Shard(i, 2)).made) for i in (1, 2)] == [2, 2]
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        assert len(render(chosen, scenes=4, out=dask, scheduler=cluster.scheduler_address).made) == 4
    for i in range(4):
        for other in (parts, dask):
            a, b = (Rendered(out / "scenes" / f"{i:06d}") for out in (whole, other))
            for name in a.rig.names:
                torch.testing.assert_close(a.frame(name).depth, b.frame(name).depth)
                assert (a.frame(name).rgb - b.frame(name).rgb).abs().max() < 1e-3


def test_refused_scenes_are_named_and_the_others_made(config, tmp_path, capfd):
    write(config, check={"texture": 1.1}, limits={"refusals": 2})
    with pytest.raises(SystemExit) as stop:
        main(["lab", "render", str(config), "--scenes", "2", "--out", str(tmp_path / "data")])
    assert stop.value.code == 1
    said = " ".join(capfd.readouterr().err.split())
    assert "scene 1: 2 seeds" in said
    assert "110%" in said
    assert "0 made, 2 failed: the same command tries these again" in said


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"sed": 3}, "render.yaml: sed: unknown key; did you mean 'seed'?"),
        ({"backend": "blendr"}, "render.yaml: backend: is 'blendr'; did you mean 'blender'?"),
        ({"layered": {"layer": [1, 2]}}, "layered.layer: unknown key; did you mean 'layers'?"),
        ({"layered": {"edge": -5}}, "layered: edge"),
        ({"layered": {"oversampling": 0}}, "layered: oversampling"),
        ({"layered": {"layers": [7, 4]}}, "layered: layers"),
        ({"limits": {"timeout": -1}}, "limits: timeout"),
        ({"rig": "rg.yaml"}, "rg.yaml: no such file or folder"),
        ({"layered": {"photos": ["images"]}}, "images: no such file or folder"),
        ({"blender": {"generator": "photographs"}}, "the generator 'photographs' needs a folder `photos`"),
        ({"blender": {"generator": "still-life"}}, "blender: no generator is called 'still-life': use abs"),
        ({"backend": "blender", "blender": {"generator": "os:no"}}, "blender.generator: os:no is code"),
        ({"blender": {"settings": {"sample": 3}}}, "settings.sample: unknown key; did you mean 'samples'?"),
    ],
)
def test_typos_are_one_line(config, tmp_path, refusal, changes, words):
    write(config, **changes)
    said = refusal("lab", "render", config, "--scenes", 2, "--out", tmp_path / "data")
    assert words in said
    assert not (tmp_path / "data").exists()


def test_other_mistakes_are_one_line(config, tmp_path, refusal):
    out = tmp_path / "data"
    two = ["--scenes", 2, "--out", out]
    assert "no.yaml: no such file" in refusal("lab", "render", tmp_path / "no.yaml", *two)
    assert "is not i/n" in refusal("lab", "render", config, *two, "--shard", "3/2")
    assert "at least one scene" in refusal("lab", "render", config, "--scenes", 0, "--out", out)
    write(config, backend="blender", blender={"generator": "os:no"})
    assert "os:no' cannot be imported" in refusal("lab", "render", config, *two, "--generator", "os:no")
    write(config)
    (tmp_path / "rig.yaml").write_text("cameras: {mono: {size: [8, 8]}}")
    said = refusal("lab", "render", config, *two)
    assert "'mono'" in said


@pytest.mark.parametrize("text", ["", "[1]", "made from: 3", "made from: [rig]"])
def test_a_file_that_is_no_manifest_is_named(config, tmp_path, text):
    """The message names the file."""
    (tmp_path / "manifest.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"manifest\.yaml: "):
        write_manifest(RenderConfig.load(config), tmp_path)


def test_a_folder_of_another_configuration_is_refused(config, tmp_path):
    out = tmp_path / "data"
    for _ in range(2):
        write_manifest(RenderConfig.load(config), out)
    write(config, seed=2)
    with pytest.raises(ValueError, match=r"seed: .*--out"):
        write_manifest(RenderConfig.load(config), out)
    write(config)
    (tmp_path / "rig.yaml").write_text(RIG.replace("120", "130"))
    with pytest.raises(ValueError, match=r"--out.*rig\.yaml"):
        write_manifest(RenderConfig.load(config), out)


@pytest.mark.parametrize(
    ("found", "given"),
    [("opencv_stereo", "rig/intrinsics.yml"), ("aniposelib.toml", "rig.toml"), ("colmap", "rig")],
)
def test_rigs_of_all_formats_are_in_the_manifest(found, given, config, tmp_path):
    """Not all are YAML, and a folder's name says nothing of what is in it."""
    path = ROOT / "tests" / "arraygeom" / "fixtures" / found
    (shutil.copytree if path.is_dir() else shutil.copy)(path, tmp_path / Path(given).parts[0])
    write(config, rig=given)
    for _ in range(2):
        write_manifest(RenderConfig.load(config), tmp_path / "data")
    said = yaml.safe_load((tmp_path / "data" / "manifest.yaml").read_text())
    assert list(said["made from"]["rig"]["cameras"]) == list(Rig.load(tmp_path / given).names)


def test_more_scenes_than_disk_are_refused_before_the_first(config, tmp_path, monkeypatch):
    usage = type("Usage", (), {"free": 100_000_000})
    monkeypatch.setattr("pat.lab.farm.job.shutil.disk_usage", lambda path: usage)
    with pytest.raises(ValueError, match=r"5000 .*1.0 MB .*5.1 GB .* 32 "):
        check_space(tmp_path, 5000, 1e6)
    check_space(tmp_path, 0, 1e6)
    with pytest.raises(ValueError, match="100000"):
        render(RenderConfig.load(config), scenes=100_000, out=tmp_path / "data")
    assert not done(tmp_path / "data")


def test_a_disk_that_fills_stops_the_job_cleanly(config, tmp_path, monkeypatch):
    def full(seed, out):
        out.mkdir()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(LayeredSettings, "renderer", lambda *_: full)
    monkeypatch.setattr("pat.support.jobs._in_processes", jobs_here)
    with pytest.raises(JobError, match="full"):
        render(RenderConfig.load(config), scenes=3, out=tmp_path / "data")
    assert not done(tmp_path / "data")
    assert not (tmp_path / "data/.work").exists()


def jobs_here(tasks, workers):
    from pat.support.jobs import attempt

    return (attempt(task, 1) for task in tasks)


def test_one_run_at_a_time_writes_to_a_shard(config, tmp_path, monkeypatch):
    chosen, out = RenderConfig.load(config), tmp_path / "data"

    def meanwhile(*_):
        with pytest.raises(ValueError, match="command"):
            render(chosen, scenes=2, out=out, shard=Shard(1, 2))
        return iter(())

    monkeypatch.setattr("pat.support.jobs._in_processes", meanwhile)
    render(chosen, scenes=2, out=out, shard=Shard(1, 2))


def test_publishing_keeps_what_is_there(tmp_path):
    for name, text in (("first", "1"), ("second", "2")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a").write_text(text)
        publish(tmp_path / name, tmp_path / "scenes" / "x")
    assert (tmp_path / "scenes/x/a").read_text() == "1"


def test_shards_share_the_scenes_out():
    parts = [Shard.parse(f"{i}/3").select(10) for i in (1, 2, 3)]
    assert sorted(i for part in parts for i in part) == list(range(10))
    for text in ("0/3", "4/3", "1", "a/b", "1/0"):
        with pytest.raises(ValueError, match="is not i/n"):
            Shard.parse(text)


def test_seeds_are_of_the_scene_and_the_attempt_alone(config):
    chosen = RenderConfig.load(config)
    assert len({scene_seed(chosen, i, k) for i in range(20) for k in range(3)}) == 60


@pytest.mark.parametrize("backend", ["layered", "blender"])
def test_no_renderer_is_made_for_a_rig_it_cannot_render(backend, config, tmp_path, monkeypatch):
    monkeypatch.setattr("pat.lab.farm.backends.blender_python", lambda: "")
    (tmp_path / "rig.yaml").write_text("cameras: {mono: {size: [96, 64]}}")
    write(config, backend=backend)
    with pytest.raises(ValueError, match="'mono'"):
        RenderConfig.load(config).renderer()


def test_rigs_that_layers_cannot_show_are_refused():
    camera = Camera(K=intrinsics(90.0, (8, 8)), cam_from_world=Pose.identity(), hw=(8, 8))
    lens = Distortion("brown-conrady", camera.K.new_tensor([0.1, 0, 0, 0]))
    with pytest.raises(ValueError, match="'a'"):
        rig_from_alpha(Rig({"a": camera.replace(distortion=lens)}, depth=(1, 2)))
    with pytest.raises(ValueError, match="depth"):
        rig_from_alpha(Rig({"a": camera}))
    assert rig_from_alpha(Rig({"a": camera}, depth=(1, float("inf")))).far.tolist() == [50.0]
