"""Objects and surfaces of believable scenes, and scenes arranged in a frame of their own put before a camera.

Such a frame has x to the right, y down and z away from the camera, in metres.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from arraygeom import Camera, Pose, Rig
from pat.lab.synthesis.furnish import DEPTHS, vec
from pat.lab.synthesis.scene import Key, Light, Material, Motion, Object, Paint, Scene, Texture, Vec3, World

Profile = Sequence[tuple[float, float]]
"""Radius and height of an object of revolution, metres, from its top."""


def profile(*numbers: float) -> list[tuple[float, float]]:
    """Radius and height in turn, millimetres."""
    return [(r / 1000, h / 1000) for r, h in zip(numbers[::2], numbers[1::2])]


def first_camera(rig: Rig) -> Camera:
    """The first calibrated camera, on the CPU. Raises ValueError if there is none."""
    for camera in rig.cameras.values():
        if isinstance(camera, Camera):
            return camera.to("cpu").to(torch.float64)
    raise ValueError("the rig has no calibrated camera to make a scene for")


def arranged(
    name: str,
    seed: int,
    rig: Rig,
    objects: Sequence[Object],
    lights: Sequence[Light],
    world: World,
    *,
    aim: Vec3,
    distance: float,
    down: float,
) -> Scene:
    """Objects and lights before a rig's first camera: `aim` in the middle of its image, a distance in metres.

    The camera faces downwards by `down` degrees.
    """
    R = torch.from_numpy(Rotation.from_euler("x", down, degrees=True).as_matrix())
    cam_from_stage = Pose(R, R.new_tensor([0.0, 0.0, distance]) - R @ R.new_tensor(aim))
    world_from_stage = first_camera(rig).cam_from_world.inverse() @ cam_from_stage
    near, far = (float(d) for d in rig.depth) if rig.depth is not None else DEPTHS
    return Scene(
        objects=tuple(replace(o, motion=_placed(o.motion, world_from_stage)) for o in objects),
        lights=tuple(_lit(light, world_from_stage) for light in lights),
        world=world,
        depth=(near, far),
        generator=name,
        seed=seed,
    )


def _placed(motion: Motion, pose: Pose) -> Motion:
    rotation = Rotation.from_matrix(pose.R.numpy())
    keys = (
        replace(
            key,
            position=vec(pose.apply(torch.tensor(key.position, dtype=pose.R.dtype)).numpy()),
            rotation=vec((rotation * Rotation.from_rotvec(key.rotation)).as_rotvec()),
        )
        for key in motion.keys
    )
    return Motion(tuple(keys))


def _lit(light: Light, pose: Pose) -> Light:
    position, direction = (torch.tensor(v, dtype=pose.R.dtype) for v in (light.position, light.direction))
    position, direction = pose.apply(position), pose.R @ direction
    return replace(light, position=vec(position.numpy()), direction=vec(direction.numpy()))


def paint(*rgb: float, nir: float | None = None) -> Paint:
    """Dyes hardly absorb near infrared: it is at least a half unless stated."""
    r, g, b = rgb
    return Paint((r, g, b), max(0.5, r) if nir is None else nir)


def plain(
    *rgb: float, roughness: float = 0.5, specular: float = 0.3, grain: float = 0.0, **more: float
) -> Material:
    """A surface of one colour; with `grain`, flecks of some millimetres."""
    texture = Texture(paints=(paint(*rgb),), scale=20.0, grain=grain)
    return Material(texture=texture, roughness=roughness, specular=specular, **more)


def wood(dark: Vec3, light: Vec3, scale: float) -> Material:
    """Two tones of wood with a wavy grain, `scale` rings a metre."""
    between = paint(*(0.6 * d + 0.4 * v for d, v in zip(dark, light)))
    paints = (paint(*dark), paint(*light), between, paint(*light))
    texture = Texture(kind="wave", paints=paints, scale=scale, distortion=9.0, grain=0.12)
    return Material(texture=texture, roughness=0.35, specular=0.35)


def box(
    name: str, middle: Vec3, extent: Vec3, material: Material, *, yaw: float = 0.0, roll: float = 0.0
) -> Object:
    """A box, rotated by degrees about the vertical and about the axis of view."""
    rotation = Rotation.from_euler("yz", (yaw, roll), degrees=True).as_rotvec()
    key = Key(position=middle, rotation=vec(rotation), extent=extent)
    return Object(name=name, shape="cube", motion=Motion((key,)), material=material)


def ball(name: str, middle: Vec3, extent: Vec3, material: Material, *, euler: Vec3 = (0, 0, 0)) -> Object:
    """An ellipsoid, rotated by degrees about x, y and z."""
    rotation = Rotation.from_euler("xyz", euler, degrees=True).as_rotvec()
    key = Key(position=middle, rotation=vec(rotation), extent=extent)
    return Object(name=name, shape="sphere", motion=Motion((key,)), material=material)


def lathed(name: str, foot: Vec3, profile: Profile, material: Material, *, euler: Vec3 = (0, 0, 0)) -> Object:
    """An object of revolution that stands on a point; corners of its profile are rounded."""
    points = np.array(profile, dtype=float)
    for _ in range(3):
        inner = np.stack([0.75 * points[:-1] + 0.25 * points[1:], 0.25 * points[:-1] + 0.75 * points[1:]], 1)
        points = np.concatenate([points[:1], inner.reshape(-1, 2), points[-1:]])
    widest, low, high = points[:, 0].max(), points[:, 1].min(), points[:, 1].max()
    unit = [(float(r / widest / 2), float(0.5 - (y - low) / (high - low))) for r, y in points]
    rotation = Rotation.from_euler("xyz", euler, degrees=True)
    middle = np.array(foot) + rotation.apply([0, -(low + high) / 2, 0])
    extent = (float(2 * widest), float(high - low), float(2 * widest))
    key = Key(position=vec(middle), rotation=vec(rotation.as_rotvec()), extent=extent)
    return Object(name=name, shape="lathe", motion=Motion((key,)), material=material, profile=tuple(unit))


def moved(
    items: Iterable[Object], name: str, to: Vec3, *, yaw: float = 0.0, size: float = 1.0
) -> Iterator[Object]:
    """Objects made about the origin, enlarged, turned about the vertical by degrees, moved; a name prefix."""
    R = torch.from_numpy(Rotation.from_euler("y", yaw, degrees=True).as_matrix())
    pose = Pose(R, R.new_tensor(to))
    for item in items:
        keys = (
            replace(key, position=vec(size * np.array(key.position)), extent=vec(size * np.array(key.extent)))
            for key in item.motion.keys
        )
        yield replace(item, name=f"{name} {item.name}", motion=_placed(Motion(tuple(keys)), pose))


def on_path(item: Object, path: Sequence[tuple[float, Vec3]], spin: Vec3 = (0, 0, 0)) -> Object:
    """The object on a path of times and positions, rotated meanwhile by `spin` (rotation vector, radians)."""
    first, start = item.motion.keys[0], path[0][0]
    length = path[-1][0] - start
    keys = []
    for time, position in path:
        fraction = (time - start) / length
        rotation = Rotation.from_rotvec(np.array(spin) * fraction) * Rotation.from_rotvec(first.rotation)
        keys.append(replace(first, position=position, rotation=vec(rotation.as_rotvec()), time=time))
    return replace(item, motion=Motion(tuple(keys)))
