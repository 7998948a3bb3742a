"""Scenes as one would photograph them: whole in the first image, lit from above, a room around wide ones."""

import pytest
import torch

from arraygeom import Camera, Rig, intrinsics
from experiments.scenes import SCENES
from tests.pat.lab.synthesis.scenes import posed
from tests.pat.lab.synthesis.test_generators import depths

ENDS = ("armchair seat", "rug", "window panes", "chair seat")


@pytest.mark.parametrize(
    ("generator", "focal", "bounds"), [("still-life", 820.0, (1.4, 20)), ("landscape", 1990, (9, 250))]
)
def test_arranged_scenes_fill_the_first_image_wherever_the_rig_stands(generator, focal, bounds):
    camera = Camera(K=intrinsics(focal, (400, 640)), cam_from_world=posed(), hw=(400, 640))
    rig = Rig({"a": camera}, depth=bounds)
    scene = SCENES[generator](1, rig)
    assert scene != SCENES[generator](2, rig)
    assert all(len(o.motion.keys) == 1 for o in scene.objects)
    seen = depths(scene, camera)
    assert len(seen) > 5000
    assert float(seen.quantile(0.02)) > bounds[0]
    assert float(seen.max()) < bounds[1]
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    sun = torch.tensor(scene.lights[0].direction, dtype=torch.float64)
    assert float((camera.R @ sun) @ up) < 0, "the light comes from above"


def test_a_wide_camera_sees_a_room_around_the_still_life():
    narrow = Camera(K=intrinsics(820.0, (400, 640)), cam_from_world=posed(), hw=(400, 640))
    wide = Camera(K=intrinsics(240.0, (400, 640)), cam_from_world=posed(), hw=(400, 640))
    table, room = (SCENES["still-life"](1, Rig(c)) for c in ({"a": narrow}, {"a": narrow, "b": wide}))
    assert room.objects[: len(table.objects)] == table.objects
    around = {o.name: o for o in room.objects[len(table.objects) :]}
    assert len(around) > 80
    middles = {name: torch.tensor(around[name].motion.keys[0].position, dtype=torch.float64) for name in ENDS}
    x = {name: wide.project(X).x for name, X in middles.items()}
    assert all(bool(wide.contains(at)) for at in x.values())
    assert x["armchair seat"][0] < x["rug"][0] < x["window panes"][0]
    assert x["window panes"][1] < x["chair seat"][1]
    assert not bool(narrow.contains(narrow.project(middles["armchair seat"]).x))


def test_the_ball_is_thrown_in_the_time_that_is_given():
    camera = Camera(K=intrinsics(820.0, (400, 640)), cam_from_world=posed(), hw=(400, 640))
    scene = SCENES["still-life"](1, Rig({"a": camera}), moving=0.5)
    (ball,) = (o for o in scene.objects if len(o.motion.keys) > 1)
    assert ball.motion.keys[-1].time == 0.5
    x = camera.project(torch.tensor([k.position for k in ball.motion.keys], dtype=torch.float64)).x
    assert bool(camera.contains(x).all())
    assert bool((x[1:, 0] > x[:-1, 0] + 20).all())
