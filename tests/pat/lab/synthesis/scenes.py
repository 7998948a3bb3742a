"""Small scenes and rigs that several test files use."""

import pytest
import torch

from arraygeom.camera import Camera, intrinsics
from arraygeom.distortion import BROWN_CONRADY, Distortion
from arraygeom.pose import Pose, rotation_from_vector
from arraygeom.rig import Rig
from pat.lab.synthesis.blender.environment import blender_python
from pat.lab.synthesis.scene import Key, Light, Material, Motion, Object, Paint, Relief, Scene, Texture, Vec3

LENS = Distortion(BROWN_CONRADY, torch.tensor([-0.3, 0.08, 0.001, -0.002], dtype=torch.float64))


def needs_blender() -> None:
    """Skip a test where Blender is not installed."""
    try:
        blender_python()
    except ValueError as error:
        pytest.skip(str(error))


def posed(rotation: Vec3 = (0, 0, 0), centre: Vec3 = (0, 0, 0)) -> Pose:
    """A camera turned by a rotation vector in degrees, at a place."""
    R = rotation_from_vector(torch.deg2rad(torch.tensor(rotation, dtype=torch.float64)))
    return Pose.from_centre(R, torch.tensor(centre, dtype=torch.float64))


def unlike_cameras(width: int = 64) -> Rig:
    """Landscape with oblong pixels, portrait and shifted, turned by a quarter, strongly distorted."""
    w, h = width, width * 3 // 4
    middle = ((w - 1) / 2, (h - 1) / 2)
    turned = torch.tensor([[0, 0.9 * w, middle[1]], [-0.9 * w, 0, middle[0]], [0, 0, 1]], dtype=torch.float64)
    plain = intrinsics((0.9 * w, 1.15 * w), (h, w), middle)
    shifted = intrinsics(0.8 * w, (w, h), (0.3 * h, 0.62 * w))
    cameras = {
        "oblong": Camera(K=plain, cam_from_world=posed(), hw=(h, w)),
        "shifted": Camera(K=shifted, cam_from_world=posed((1, -4, 5), (0.3, 0.05, 0.1)), hw=(w, h)),
        "turned": Camera(K=turned, cam_from_world=posed((-2, 1, 0), (0, -0.2, 0)), hw=(w, h)),
        "distorted": Camera(
            K=intrinsics(0.6 * w, (h, w)),
            cam_from_world=posed((0, 2, -1), (-0.25, 0, 0)),
            hw=(h, w),
            distortion=LENS,
        ),
    }
    return Rig(cameras, depth=(2.0, 12.0))


def thing(shape: str, position: Vec3, **changes: object) -> Object:
    """A shape of one metre with a checked surface."""
    fields = {
        "rotation": changes.pop("rotation", (0.3, 0.5, 0.2)),
        "extent": changes.pop("extent", (1.0, 1.0, 1.0)),
    }
    paints = (Paint((0.7, 0.3, 0.1), 0.2), Paint((0.1, 0.4, 0.5), 0.8))
    surface = Material(texture=Texture(kind="checker", scale=5.0, paints=paints, grain=0.2))
    motion = Motion((Key(position=position, **fields),))
    return Object(**{"name": shape, "shape": shape, "motion": motion, "material": surface, **changes})


def room_scene() -> Scene:
    """A sphere, a dented cube and a torus in a room of 8 x 6 x 12 metres around the origin."""
    walls = Material(
        texture=Texture(
            kind="noise",
            scale=3.0,
            grain=0.3,
            paints=(Paint((0.6, 0.5, 0.4), 0.5), Paint((0.2, 0.2, 0.3), 0.3)),
        )
    )
    objects = (
        thing("sphere", (-0.7, -0.3, 4.0)),
        thing("cube", (0.6, 0.2, 4.5), relief=Relief(height=0.04, size=0.5)),
        thing("torus", (0.1, 0.8, 3.6), extent=(1.2, 0.3, 1.2)),
        thing("room", (0.0, 0.0, 4.0), rotation=(0.0, 0.0, 0.0), extent=(8.0, 6.0, 12.0), material=walls),
    )
    lights = (
        Light(kind="area", power=250.0, position=(1.5, -2.0, 1.0), direction=(-1.0, 2.0, 2.0), size=1.0),
        Light(kind="point", power=300.0, position=(-2.0, -1.5, 0.5)),
    )
    return Scene(objects=objects, lights=lights, depth=(2.0, 12.0))
