"""Blender's images against arraygeom and against theory."""

import os
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from arraygeom.camera import Camera, intrinsics
from arraygeom.pixels import pixel_grid
from arraygeom.pose import Pose
from arraygeom.rig import Rig
from arraygeom.sensor import Sensor
from pat.lab.synthesis.blender import RenderSettings, render, studio
from pat.lab.synthesis.generators import abstract, photographs
from pat.lab.synthesis.rendered import is_rendered
from pat.lab.synthesis.scene import Key, Light, Material, Motion, Object, Paint, Scene, Texture
from pat.lab.synthesis.shapes import inside
from pat.media.colour import luminance, srgb_image, to_bytes
from tests.pat.lab.synthesis.boards import Sheet, board_scene
from tests.pat.lab.synthesis.scenes import posed, room_scene, unlike_cameras

QUICK = RenderSettings(samples=1, threads=1)
CLEAN = RenderSettings(samples=64, threads=1, denoise="none", fast_light=False, bounces=0)


def glowing(name: str, motion: Motion, shape: str = "plane", brightness: float = 1.0) -> Object:
    """A surface that shines evenly and reflects nothing."""
    black = Texture(paints=(Paint((1.0, 1.0, 1.0), 1.0),))
    return Object(
        name=name,
        shape=shape,
        motion=motion,
        material=Material(texture=black, emission=brightness, specular=0.0),
    )


def spread(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and variance (x, y) of light over pixels."""
    grid = pixel_grid((image.shape[0], image.shape[1]), dtype=torch.float64)
    weight = image.double() / image.double().sum()
    mean = (grid * weight[..., None]).sum((0, 1))
    return mean, ((grid - mean) ** 2 * weight[..., None]).sum((0, 1))


def single(width: int = 64, focal: float = 100.0, **sensor: float) -> Rig:
    K = intrinsics(focal, (width * 3 // 4, width))
    return Rig(
        {"a": Camera(K=K, cam_from_world=posed(), hw=(width * 3 // 4, width), sensor=Sensor(**sensor))}
    )


def test_a_tiny_scene_is_true_in_unlike_cameras(installed, tmp_path):
    assert "bpy" not in sys.modules
    before = children()
    rig, scene = unlike_cameras(48), room_scene()
    settings = RenderSettings(samples=2, threads=1, infrared=True)
    done = render(scene, rig, tmp_path / "scene", settings=settings)
    assert done.about["check"]["accepted"], done.about["check"]["reasons"]
    assert is_rendered(done.folder)
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]
    for pair, figures in done.about["check"]["pairs"].items():
        assert figures["p95"] < 0.02, pair
    for name, camera in done.rig.cameras.items():
        frame = done.frame(name)
        torch.testing.assert_close(camera.K, rig[name].K)
        assert frame.rgb.shape == (3, *camera.hw)
        on_walls(scene, camera, frame)
        if camera.distortion is None:
            on_sphere(scene, camera, frame)
        grey = frame.rgb.mean(0)
        assert torch.corrcoef(torch.stack([grey.flatten(), frame.nir[0].flatten()]))[0, 1] < 0.98
    assert "bpy" not in sys.modules
    assert children() <= before
    with pytest.raises(ValueError, match="exists"):
        render(scene, rig, tmp_path / "scene", settings=settings)
    away = Scene(objects=(glowing("behind", Motion((Key(position=(0, 0, -5)),))),))
    with pytest.raises(ValueError, match=r"'oblong' .*0 s"):
        render(away, rig, tmp_path / "nothing", settings=settings)
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


def test_blender_prints_nothing(installed, tmp_path):
    """Neither its log nor complaints of a missing GPU reach the output of whoever renders."""
    program = (
        "from pathlib import Path; from pat.lab.synthesis.blender import RenderSettings; "
        "from pat.lab.synthesis.blender.studio import Studio; from pat.lab.synthesis.scene import Scene; "
        "Studio(Scene(objects=()), RenderSettings(), Path()).close()"
    )
    path = os.pathsep.join([os.getcwd(), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == ""


def children() -> set[str]:
    """Numbers of the processes that this one has started and that live; other tests may have left some."""
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())


def test_the_death_of_blender_is_told(installed, tmp_path, monkeypatch):
    before = children()
    monkeypatch.setattr(studio, "_SERVE", "import os; os.abort()")
    with pytest.raises(BrokenProcessPool, match="-6"):
        render(room_scene(), unlike_cameras(48), tmp_path / "scene", settings=QUICK)
    assert [*tmp_path.iterdir()] == []
    assert children() <= before


def points(camera: Camera, frame, index: int) -> torch.Tensor:
    """The points of the world that pixels of an object see."""
    here = frame.index == index
    return camera.unproject(pixel_grid(camera.hw, dtype=torch.float64)[here], frame.depth[here].double())


def on_walls(scene: Scene, camera: Camera, frame) -> None:
    place = scene.objects[3].motion.at(0)
    X = (points(camera, frame, 4).numpy() - place.position) @ place.R / place.extent
    assert len(X) > 100
    most = 0.98 if camera.distortion is None else 0.85  # beside edges, depth behind a lens is an estimate
    assert np.quantile(np.abs(np.abs(X).max(1) - 0.5), most) < 1e-4


def on_sphere(scene: Scene, camera: Camera, frame) -> None:
    """The sphere has 64 x 32 flat faces: up to 0.24 % of its radius inside."""
    X = points(camera, frame, 1).numpy() - scene.objects[0].motion.at(0).position
    radius = np.linalg.norm(X, axis=1)
    assert len(X) > 15
    assert (np.abs(np.quantile(radius, [0.02, 0.98]) - 0.4985) < 0.0025).all()


def fiducials(camera: Camera, count: int = 12) -> list[Object]:
    """Squares about 9 pixels wide, parallel to the image's plane, all over the image at several depths."""
    rng = np.random.default_rng(0)
    h, w = camera.hw
    found = []
    for k in range(count):
        depth = float(rng.uniform(2, 9))
        column, row = (k % 4 + rng.uniform(0.3, 0.7)) / 4 * w, (k // 4 + rng.uniform(0.3, 0.7)) / 3 * h
        X = camera.unproject(torch.tensor([column, row], dtype=torch.float64), torch.tensor(depth).double())
        turn = cv2.Rodrigues(camera.R.T.numpy())[0].ravel().tolist()
        size = 9 * depth / float(camera.K[:2, :2].abs().max())
        found.append(
            glowing(
                f"square{k}",
                Motion((Key(position=tuple(X.tolist()), rotation=tuple(turn), extent=(size, size, 1.0)),)),
            )
        )
    return found


def predicted_centre(camera: Camera, square: Object) -> torch.Tensor:
    """Where arraygeom sees the square's light: the centroid of its outline, projected point by point."""
    side = torch.linspace(-0.5, 0.5, 101, dtype=torch.float64)[:-1]
    low = torch.full_like(side, -0.5)
    outline = torch.cat(
        [torch.stack(p, -1) for p in ((side, low), (-low, side), (-side, -low), (low, -side))]
    )
    pose = square.motion.at(0)
    X = torch.nn.functional.pad(outline, (0, 1)) @ torch.from_numpy(pose.R * pose.extent).T
    a = camera.project(X + torch.from_numpy(pose.position)).x
    b = a.roll(-1, 0)
    twice_area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return ((a + b) * twice_area[:, None]).sum(0) / (3 * twice_area.sum())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["oblong", "shifted", "turned", "distorted"])
def test_fiducials_are_where_arraygeom_projects_them(installed, tmp_path, name):
    camera = unlike_cameras(128)[name]
    squares = fiducials(camera)
    rig = Rig({name: camera})
    done = render(Scene(objects=tuple(squares)), rig, tmp_path / "x", settings=replaced(CLEAN, samples=256))
    light = done.frame(name).rgb.mean(0)
    errors = []
    for square in squares:
        predicted = predicted_centre(camera, square)
        x, y = predicted.round().long()
        window = light[y - 8 : y + 9, x - 8 : x + 9]
        errors.append(spread(window)[0] + torch.tensor([x - 8, y - 8]) - predicted)
    errors = torch.stack(errors)
    print(f"{name}: mean {errors.mean(0).tolist()}, mean length {errors.norm(dim=1).mean():.4f} px")
    assert errors.mean(0).norm() < 0.02
    assert errors.norm(dim=1).mean() < 0.02


def replaced(settings: RenderSettings, **changes: object) -> RenderSettings:
    return RenderSettings(**{**vars(settings), **changes})


@pytest.mark.slow
def test_an_animation_at_each_cameras_own_times(installed, tmp_path):
    rig = unlike_cameras(64)
    rates = {"oblong": Sensor(frame_rate=10.0), "distorted": Sensor(frame_rate=5.0, time_offset=0.05)}
    rig = Rig({n: rig[n].replace(sensor=s) for n, s in rates.items()}, depth=rig.depth)
    scene = abstract(11, rig, moving=3.0)
    done = render(scene, rig, tmp_path / "x", settings=replaced(QUICK, duration=0.6))
    assert [done.frames(n) for n in rig.names] == [6, 3]
    assert done.frame("distorted", 2).time == pytest.approx(0.45)
    first, last = done.frame("oblong", 0), done.frame("oblong", 5)
    assert 0.01 < (first.index != last.index).float().mean() < 0.6


@pytest.mark.slow
def test_a_rendered_board_has_its_corners_where_it_should(installed, tmp_path):
    """OpenCV refines the corners of a board to where arraygeom projects them."""
    sheet = Sheet(squares=(7, 5), square=0.3, marker=0, margin=0.1)
    pose = Pose(posed((20, -15, 5)).R, torch.tensor([-1.0, -0.6, 3.5], dtype=torch.float64))
    rig = Rig({n: unlike_cameras(192)[n] for n in ("oblong", "distorted")})
    scene = board_scene([pose], sheet, tmp_path / "board.png")
    done = render(scene, rig, tmp_path / "x", settings=replaced(CLEAN, samples=32))
    for name, camera in rig.cameras.items():
        projected = camera.project(pose.apply(torch.from_numpy(sheet.inner_corners)))
        assert camera.contains(projected.x).all()
        x = projected.x.numpy().astype(np.float32)[:, None]
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        grey = to_bytes(srgb_image(luminance(done.frame(name).rgb)))[0]
        found = cv2.cornerSubPix(grey, x.copy(), (4, 4), (-1, -1), stop)
        error = np.linalg.norm((found - x)[:, 0], axis=1)
        print(f"board corners: mean {error.mean():.3f} px, bias {(found - x)[:, 0].mean(0)}")
        assert error.mean() < 0.1


@pytest.mark.slow
def test_twenty_scenes_of_four_unlike_cameras(installed, tmp_path):
    rig, p95 = unlike_cameras(96), []
    for seed in range(20):
        done = render(abstract(seed, rig), rig, tmp_path / str(seed), settings=QUICK)
        p95 += [figures["p95"] for figures in done.about["check"]["pairs"].values()]
        assert done.about["check"]["accepted"], (seed, done.about["check"]["reasons"])
        depths = [(figures["near"], figures["far"]) for figures in done.about["check"]["views"].values()]
        assert all(2 <= near < far <= 12 for near, far in depths), (seed, depths)
    print(f"view to view, 240 pairs: p95 at most {max(p95):.4f} px")
    assert max(p95) < 0.02


@pytest.mark.slow
def test_leaves_and_skin_are_unlike_their_luminance_in_near_infrared(installed, tmp_path):
    """Leaves are dark green and bright in the near infrared, skin is brighter than its luminance."""
    leaf, skin, soot = (
        Paint((0.05, 0.12, 0.03), 0.5),
        Paint((0.45, 0.25, 0.17), 0.6),
        Paint((0.04, 0.04, 0.04), 0.04),
    )
    strips = [
        Object(
            name=name,
            shape="plane",
            motion=Motion((Key(position=(x, 0, 3), extent=(0.9, 2, 1)),)),
            material=Material(texture=Texture(paints=(paint,)), specular=0.0, roughness=1.0),
        )
        for name, paint, x in (("leaf", leaf, -1.0), ("skin", skin, 0.0), ("soot", soot, 1.0))
    ]
    scene = Scene(objects=tuple(strips), lights=(Light(kind="sun", power=float(np.pi), direction=(0, 0, 1)),))
    done = render(scene, single(60, 50.0), tmp_path / "x", settings=replaced(CLEAN, samples=4, infrared=True))
    frame = done.frame("a")
    for index, paint in enumerate((leaf, skin, soot), 1):
        here = (frame.index == index) & (pixel_grid((45, 60))[..., 1] - 22 < 8)
        torch.testing.assert_close(
            frame.rgb[:, here].median(1).values, torch.tensor(paint.rgb), rtol=0.03, atol=2e-3
        )
        assert frame.nir[0, here].median() == pytest.approx(paint.nir, rel=0.03)


@pytest.mark.slow
def test_photographs(installed, tmp_path, shared_data):
    rig = unlike_cameras(64)
    scene = photographs(0, rig, shared_data / "photos")
    done = render(scene, rig, tmp_path / "x", settings=QUICK)
    assert done.about["check"]["accepted"], done.about["check"]["reasons"]
    assert not any(inside(o, c.centre.numpy(), 0.0) for o in scene.objects for c in rig.cameras.values())
