"""Every way in which rendering can be refused is one line, and no crash of Blender reaches the caller."""

import importlib
import sys
import time

import pytest
import torch

from arraygeom.camera import Camera, intrinsics
from arraygeom.rig import Rig
from pat.synthesis.blender import Optics, RenderError, RenderSettings, Worker, client, compat, probe, render, task
from tests.pat.synthesis.scenes import posed, room_scene, unlike_cameras

RIG = unlike_cameras()
SETTINGS = RenderSettings(samples=1)


def served_by(monkeypatch, program: str) -> None:
    monkeypatch.setattr(client, "_COMMAND", (sys.executable, "-c", program))


def without(monkeypatch, error: Exception) -> None:
    def fail(name):
        raise error

    monkeypatch.setattr(importlib, "import_module", fail)


def test_skew_is_refused_before_anything_starts(tmp_path):
    skewed = RIG["oblong"].replace(K=RIG["oblong"].K + torch.tensor([[0, 0.5, 0], [0, 0, 0], [0, 0, 0]]))
    with pytest.raises(ValueError, match=r"camera 'oblong' has skew .*, which Blender's cameras cannot have"):
        render(room_scene(), RIG.with_camera("oblong", skewed), tmp_path / "x", settings=SETTINGS)


def test_a_camera_inside_an_object_is_refused():
    moved = RIG["shifted"].replace(cam_from_world=posed((0, 0, 0), (-0.7, -0.3, 4.1)))
    rig = RIG.with_camera("shifted", moved)
    with pytest.raises(ValueError, match="camera 'shifted' is inside the object 'sphere' at 0 s"):
        task.refuse_inside(room_scene(), rig, task.shots(rig, SETTINGS))


def test_another_version_of_python_is_refused(monkeypatch):
    without(monkeypatch, ModuleNotFoundError("No module named 'bpy'", name="bpy"))
    monkeypatch.setattr(sys, "version_info", (3, 12, 1))
    with pytest.raises(ValueError, match=r"exists for Python 3.11 .* or 3.13 .*; this is 3.12$"):
        compat.load()
    monkeypatch.setattr(sys, "version_info", (3, 11, 2))
    with pytest.raises(ValueError, match=r"pip install 'arraygeom-pat\[synthesis\]'$"):
        compat.load()


def test_missing_libraries_are_named_with_the_packages_that_bring_them(monkeypatch):
    without(monkeypatch, ImportError("libX11.so.6: cannot open shared object file: No such file or directory"))
    with pytest.raises(ValueError, match=r"\(libX11.so.6 is missing\): apt-get install -y libx11-6 .* libgl1$"):
        compat.load()


def test_eevee_is_refused_where_it_would_abort(monkeypatch, tmp_path):
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho libEGL.so.1 is missing >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with pytest.raises(ValueError, match=r"engine 'eevee' cannot run here \(libEGL.so.1 is missing\): .*libegl1"):
        probe.refuse_eevee()


def test_a_crash_is_an_error_and_the_next_scene_has_a_new_process(monkeypatch, tmp_path):
    served_by(
        monkeypatch,
        "import os, sys; sys.stdin.readline(); print('oh', file=sys.stderr, flush=True); os.kill(os.getpid(), 11)",
    )
    with Worker() as worker:
        for _ in range(2):
            with pytest.raises(RenderError, match=r"the rendering process died \(SIGSEGV\): oh") as caught:
                worker.render(room_scene(), RIG, tmp_path / "x", settings=SETTINGS)
            assert caught.value.crashed
    assert list(tmp_path.iterdir()) == []


def test_a_hanging_process_is_ended(monkeypatch, tmp_path):
    served_by(monkeypatch, "import time; time.sleep(600)")
    started = time.monotonic()
    with Worker() as worker, pytest.raises(RenderError, match=r"longer than 0.2 s"):
        worker.render(room_scene(), RIG, tmp_path / "x", settings=SETTINGS, timeout=0.2)
    assert time.monotonic() - started < 300


def test_errors_of_the_process_come_back_as_they_are(monkeypatch, tmp_path):
    served_by(monkeypatch, """import sys; sys.stdin.readline(); print('{"error": "no light", "kind": "ValueError"}')""")
    with pytest.raises(ValueError, match=r"^no light$"):
        render(room_scene(), RIG, tmp_path / "x", settings=SETTINGS)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: RenderSettings.preset("quick"), r"unknown preset 'quick' \(known: fast, paper"),
        (lambda: Optics(f_number=2.0), "needs both f_number and focus"),
        (lambda: Optics(shutter=-1.0), "shutter must be above 0, got -1"),
        (lambda: task.fitted(RIG, RenderSettings(optics={"shiftd": Optics()})), "did you mean 'shifted'"),
    ],
)
def test_settings_are_checked(make, said):
    with pytest.raises(ValueError, match=said):
        make()


def test_presets_fit_the_rig_to_their_width():
    camera = Camera(K=intrinsics(600.0, (768, 1024)), cam_from_world=posed(), hw=(768, 1024))
    rig = Rig({"a": camera, "b": camera.resize((300, 400))})
    for name, hw in (("fast", (384, 512)), ("paper", (1536, 2048))):
        fitted = task.fitted(rig, RenderSettings.preset(name))
        assert fitted["a"].hw == hw
        torch.testing.assert_close(fitted["a"].K, camera.resize(hw).K)
    assert task.fitted(rig, RenderSettings()) is rig
