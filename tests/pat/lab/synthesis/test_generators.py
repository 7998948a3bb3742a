import numpy as np
import pytest
import torch

from arraygeom.camera import Camera, View, intrinsics
from arraygeom.rig import Rig
from pat.lab.synthesis.furnish import Setting
from pat.lab.synthesis.generators import abstract, generator_named, photographs
from pat.lab.synthesis.scene import Key, Motion, Object, Scene
from pat.lab.synthesis.shapes import inside, mesh
from pat.media.images import write_image
from tests.pat.lab.synthesis.scenes import posed, unlike_cameras


def depths(scene: Scene, camera: Camera) -> torch.Tensor:
    """Depths of all vertices that the camera's image holds."""
    found = []
    for thing in scene.objects:
        place = thing.motion.at(0)
        scale = place.extent / np.asarray(thing.motion.keys[0].extent)
        X = torch.from_numpy((mesh(thing).vertices * scale) @ place.R.T + place.position)
        x, depth, valid = camera.project(X)
        found.append(depth[valid & camera.contains(x)])
    return torch.cat(found)


@pytest.mark.parametrize("seed", range(6))
def test_abstract_scenes_are_within_the_depths_and_around_the_cameras(seed):
    rig = unlike_cameras()
    scene = abstract(seed, rig)
    assert 10 <= len(scene.objects) - 1 <= 20
    assert len({o.shape for o in scene.objects}) > 3
    assert scene == abstract(seed, rig) != abstract(seed + 1, rig)
    for camera in rig.cameras.values():
        seen = depths(scene, camera)
        assert seen.min() > 0.7 * 2
        centre = camera.centre.numpy()
        assert not any(inside(o, centre, 0.0) for o in scene.objects)


def test_moving_scenes_move():
    scene = abstract(3, unlike_cameras(), moving=2.0)
    moving = [o for o in scene.objects if len(o.motion.keys) > 1]
    assert len(moving) == len(scene.objects) - 1
    assert {o.motion.keys[-1].time for o in moving} == {2.0}


def test_time_does_not_run_back():
    with pytest.raises(ValueError, match="moving"):
        abstract(3, unlike_cameras(), moving=-1.0)


def test_walls_out_of_range_are_said():
    """Each of two cameras that look at each other sees a wall behind the other."""
    one = Camera(K=intrinsics(60.0, (48, 64)), cam_from_world=posed(), hw=(48, 64))
    other = one.replace(cam_from_world=posed((0, np.pi, 0), (0.0, 0.0, 19.0)))
    with pytest.warns(UserWarning, match="walls"):
        abstract(0, Rig({"a": one, "b": other}, depth=(2.0, 20.0)))


def test_a_rig_without_depths_gets_those_of_the_paper():
    camera = Camera(K=intrinsics(60.0, (48, 64)), cam_from_world=posed(), hw=(48, 64))
    assert abstract(0, Rig({"a": camera})).depth == (2.0, 20.0)
    assert abstract(0, Rig({"a": camera}, depth=(1.0, torch.inf))).depth == (1.0, 10.0)


def test_a_lathe_is_what_its_profile_sweeps():
    """A profile that is a half circle makes a sphere, with the outside outside."""
    angles = np.linspace(0, np.pi, 33)
    profile = tuple((float(0.5 * np.sin(a)), float(-0.5 * np.cos(a))) for a in angles)
    key = Key(position=(0, 0, 0), extent=(2.0, 2.0, 2.0))
    surface = mesh(Object(name="o", shape="lathe", motion=Motion((key,)), profile=profile))
    np.testing.assert_allclose(np.linalg.norm(surface.vertices, axis=1), 1, atol=1e-6)
    a, b, c, d = (surface.vertices[surface.faces[:, i]] for i in range(4))
    assert ((np.cross(c - a, d - b) * (a + b + c + d)).sum(-1) > 0).all()
    with pytest.raises(ValueError, match="profile"):
        Object(name="o", shape="cube", motion=Motion((key,)), profile=profile)


def test_photographs_come_from_the_folder(tmp_path):
    for name in ("a", "b"):
        write_image(tmp_path / f"{name}.png", torch.rand(3, 40, 60))
    scene = photographs(1, unlike_cameras(), tmp_path)
    used = {o.material.texture.image for o in scene.objects}
    assert used == {str(tmp_path / "a.png"), str(tmp_path / "b.png")}


def test_what_cannot_be_generated_is_said(tmp_path):
    with pytest.raises(ValueError, match="images"):
        photographs(0, unlike_cameras(), tmp_path)
    with pytest.raises(ValueError, match="calibrated"):
        abstract(0, Rig({"a": View(hw=(4, 4))}))
    with pytest.raises(ValueError, match=r"'still-life': .*abstract, photographs"):
        generator_named("still-life")
    with pytest.raises(ValueError, match="'nowhere:scene'"):
        generator_named("nowhere:scene")


def test_a_generator_of_ones_own_is_found_from_here(tmp_path, monkeypatch):
    (tmp_path / "own_scenes.py").write_text("def one(seed, rig, *, moving=0.0):\n    return seed + 1\n")
    monkeypatch.chdir(tmp_path)
    assert generator_named("own_scenes:one")(4, None) == 5


def test_a_setting_measures_pixels_in_the_finest_camera():
    setting = Setting(unlike_cameras(), np.random.default_rng(0))
    assert setting.metres(2.0, 10) == pytest.approx(20 / (1.15 * 64))
