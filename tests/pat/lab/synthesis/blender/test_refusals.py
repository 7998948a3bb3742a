"""Every way in which rendering can be refused is one line, and no crash of Blender reaches the caller."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from arraygeom.camera import Camera, intrinsics
from arraygeom.rig import Rig
from pat.lab.synthesis.blender import RenderSettings, environment, render, studio, task
from pat.lab.synthesis.blender.child import compat, serve
from pat.lab.synthesis.blender.settings import PRESETS
from tests.pat.lab.synthesis.scenes import posed, room_scene, unlike_cameras

RIG = unlike_cameras()
SETTINGS = RenderSettings(samples=1)


def without(monkeypatch, error: Exception) -> None:
    def fail(name):
        raise error

    monkeypatch.setattr(importlib, "import_module", fail)


def test_skew_is_refused_before_blender_starts(tmp_path):
    skewed = RIG["oblong"].replace(K=RIG["oblong"].K + torch.tensor([[0, 0.5, 0], [0, 0, 0], [0, 0, 0]]))
    with pytest.raises(ValueError, match=r"'oblong' .*skew"):
        render(room_scene(), RIG.with_camera("oblong", skewed), tmp_path / "x", settings=SETTINGS)
    assert "bpy" not in sys.modules


def test_a_scene_without_a_mesh_is_refused_before_blender_starts(monkeypatch, tmp_path):
    def unknown(thing):
        raise KeyError("torus")

    monkeypatch.setattr(studio, "mesh", unknown)
    monkeypatch.setattr(studio, "blender_python", lambda: "python")
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("started"))
    with pytest.raises(KeyError, match="torus"):
        studio.Studio(room_scene(), SETTINGS, tmp_path)


def test_a_folder_that_exists_is_refused(tmp_path):
    (tmp_path / "x").mkdir()
    with pytest.raises(ValueError, match=r"exists[^/]*$"):
        render(room_scene(), RIG, tmp_path / "x", settings=SETTINGS)


def test_a_camera_inside_an_object_is_refused():
    moved = RIG["shifted"].replace(cam_from_world=posed((0, 0, 0), (-0.7, -0.3, 4.1)))
    rig = RIG.with_camera("shifted", moved)
    with pytest.raises(ValueError, match=r"'shifted' .*'sphere' .*0 s"):
        task.refuse_inside(room_scene(), rig, task.shots(rig, SETTINGS))


@pytest.mark.parametrize("missing", ["OpenEXR", "bpy"])
def test_what_is_missing_is_named_with_what_installs_it(missing, monkeypatch, tmp_path):
    monkeypatch.setattr(environment, "FOLDER", tmp_path)
    monkeypatch.setattr(environment, "find_spec", lambda name: name if name not in (missing, "bpy") else None)
    with pytest.raises(ValueError, match=rf"pip install .*{missing}"):
        environment.blender_python()
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").touch()
    with pytest.raises(ValueError, match=rf"pip install .*{missing}"):  # an interpreter without bpy
        environment.blender_python()
    (tmp_path / "lib" / "python3.11" / "site-packages" / "bpy").mkdir(parents=True)
    if missing == "bpy":
        assert environment.blender_python() == str(tmp_path / "bin" / "python")


def test_the_childs_code_needs_nothing_of_the_rest():
    code = "import sys; sys.path.append(sys.argv[1]); import child.serve; print(*sys.modules)"
    command = [sys.executable, "-I", "-c", code, str(Path(environment.__file__).parent)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert not {"pat", "arraygeom", "torch", "scipy"} & set(done.stdout.split())


@pytest.mark.parametrize("error", [ValueError, KeyError, TypeError, RuntimeError])
def test_an_error_in_the_child_is_an_answer(error, monkeypatch):
    def fail(request):
        raise error("no\nmesh")

    monkeypatch.setattr(serve, "Stage", fail)
    (answer,) = serve._answers(iter([None]))
    assert "mesh" in answer["error"]
    assert "\n" not in answer["error"]


def test_missing_libraries_are_named_with_the_packages_that_bring_them(monkeypatch):
    without(
        monkeypatch, ImportError("libX11.so.6: cannot open shared object file: No such file or directory")
    )
    with pytest.raises(ValueError, match=r"libX11.so.6.* libx11-6 .* libgl1$"):
        compat.load()


def test_presets_fit_the_rig_to_their_width():
    camera = Camera(K=intrinsics(600.0, (768, 1024)), cam_from_world=posed(), hw=(768, 1024))
    rig = Rig({"a": camera, "b": camera.resize((300, 400))})
    for name, hw in (("fast", (384, 512)), ("paper", (1536, 2048))):
        fitted = task.fitted(rig, RenderSettings(**PRESETS[name]))
        assert fitted["a"].hw == hw
        torch.testing.assert_close(fitted["a"].K, camera.resize(hw).K)
    assert task.fitted(rig, RenderSettings()) is rig
