"""Random rooms with shapes, lights and walls around the cameras of a rig."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arraygeom import Camera, Rig
from arraygeom.checks import check_above
from arraygeom.pixels import coarse_grid
from arraygeom.runtime.warned import warn

from .scene import (
    Key,
    Light,
    Material,
    Motion,
    Object,
    Relief,
    Scene,
    Shape,
    Texture,
    TextureKind,
    Vec3,
    World,
)

DEPTHS = (2.0, 20.0)
"""Near and far bounds in metres for rigs without a depth range."""

_SHAPES: tuple[Shape, ...] = ("plane", "cube", "sphere", "cylinder", "cone", "torus")
_PATTERNS: tuple[TextureKind, ...] = ("voronoi", "magic", "brick", "checker", "noise", "wave")
_WALLS: tuple[TextureKind, ...] = ("voronoi", "brick", "noise", "wave", "magic")
_IRRADIANCE = 5.0

Surface = Callable[["Setting", float, tuple[TextureKind, ...]], Texture]
"""Function of setting, depth (metres) and kinds of texture that makes the texture of a surface."""


@dataclass(frozen=True)
class _Room:
    """Box in the world that contains everything."""

    R: Float[NDArray, "3 3"]
    centre: Float[NDArray, "3"]
    extent: Float[NDArray, "3"]

    def holds(self, X: NDArray, margin: float) -> bool:
        return bool((np.abs(self.R.T @ (X - self.centre)) < self.extent / 2 - margin).all())

    def at(self, fraction: NDArray) -> NDArray:
        """Point at fractions (-1..1) of the way from the middle to the walls."""
        return np.asarray(self.centre + self.R @ (fraction * self.extent / 2))


class Setting:
    """Cameras, depth range and random generator of one scene.

    Args:
        rig: rig whose calibrated cameras see the scene; without a depth range `DEPTHS` is used, and an
            infinite far bound counts as 10 times the near one.
        rng: random generator.

    Attributes:
        cameras: the calibrated cameras, on the CPU.
        near: near bound of depths, metres.
        far: far bound of depths, metres, finite.
        centres: the cameras' centres in the world (n, 3), metres.

    Raises:
        ValueError: for a rig without a calibrated camera.
    """

    def __init__(self, rig: Rig, rng: Generator):
        self.rng = rng
        self.cameras = [c.to("cpu") for c in rig.cameras.values() if isinstance(c, Camera)]
        if not self.cameras:
            raise ValueError("the rig has no calibrated camera to make a scene for")
        near, far = (float(d) for d in rig.depth) if rig.depth is not None else DEPTHS
        self.near, self.far = near, far if math.isfinite(far) else 10 * near
        self.centres = np.stack([c.centre.double().numpy() for c in self.cameras])

    def metres(self, depth: float, pixels: float) -> float:
        """Return the width in metres of `pixels` pixels at a depth, in the camera of finest resolution."""
        return float(pixels * depth / max(float(c.K[:2, :2].abs().max()) for c in self.cameras))

    def camera(self) -> Camera:
        """Draw one of the cameras."""
        return self.cameras[int(self.rng.integers(len(self.cameras)))]

    def nearest(self, X: NDArray) -> float:
        """Return the least depth in metres of a world point over all cameras; the distance instead for
        cameras that it is not well in front of."""
        distances = np.linalg.norm(self.centres - X, axis=1)
        depths = [float(c.cam_from_world.apply(c.K.new_tensor(X)[None])[0, 2]) for c in self.cameras]
        return float(min(z if z > 0.3 * d else d for z, d in zip(depths, distances)))

    def ahead(self, camera: Camera, fraction: NDArray, depth: float) -> NDArray:
        """Return the world point (3,) at a depth in metres and at `fraction` (-1..1, across and down) of a
        camera's image."""
        h, w = camera.hw
        x = camera.K.new_tensor([(w - 1) / 2 * (1 + fraction[0]), (h - 1) / 2 * (1 + fraction[1])])
        return camera.unproject(x, x.new_tensor(depth)).double().numpy()


def furnished(name: str, seed: int, rig: Rig, surface: Surface, moving: float) -> Scene:
    """Make a scene of 10 to 20 shapes in a room, each centred in one camera's depth range (`Setting`).

    None is nearer to any camera. The walls are within the range of all cameras where such a room is found; it
    warns if not, as for views over 150 degrees, or cameras opposed or far ahead of each other for the range.

    Args:
        name: name of the generator, part of the seed.
        seed: random seed, 0 or more.
        rig: rig that sees the scene.
        surface: function that makes the textures, called with the setting, a depth in metres and the kinds of
            pattern to choose from.
        moving: seconds of motion; 0 for none.

    Returns:
        The scene, the room its last object; fewer shapes if they do not fit.

    Raises:
        ValueError: for a rig without a calibrated camera, a far bound below 5/3 of the near one, and a
            negative seed or `moving`.
    """
    check_above(0, moving=moving)
    setting = Setting(rig, seeded(name, seed))
    room = _room(setting)
    count = int(setting.rng.integers(10, 21))
    objects: list[Object] = []
    for _ in range(20 * count):
        if len(objects) < count and (item := _object(setting, room, objects, surface, moving)):
            objects.append(item)
    walls = Material(texture=surface(setting, 0.8 * setting.far, _WALLS), roughness=0.9, specular=0.1)
    rotation = Rotation.from_matrix(room.R).as_rotvec()
    key = Key(position=vec(room.centre), rotation=vec(rotation), extent=vec(room.extent))
    objects.append(Object(name="room", shape="room", motion=Motion((key,)), material=walls))
    return Scene(
        objects=tuple(objects),
        lights=_lights(setting, room),
        world=World((0.25, 0.25, 0.25), 0.25),
        depth=(setting.near, setting.far),
        generator=name,
        seed=seed,
    )


# The room and its lights ------------------------------------------------------------------------------------


def _room(setting: Setting) -> _Room:
    """Room around the cameras, its walls between near and far along every camera's axis; warns if not."""
    rng, camera = setting.rng, setting.cameras[0]
    rotation = Rotation.from_rotvec(np.radians(rng.uniform(-8, 8, 3)))
    R = (rotation * Rotation.from_matrix(camera.R.double().numpy())).as_matrix().T
    local = (setting.centres - setting.centres[0]) @ R
    back = local[:, 2].min() - 2 * setting.near
    rays = [_rays(c) for c in setting.cameras]
    widest = np.max([[math.atan(tangent) for tangent in _half_view(c)] for c in setting.cameras], axis=0)
    half = np.tan(widest) * rng.uniform(0.5, 0.9, 2) * setting.far + np.abs(local[:, :2]).max()
    front = setting.far
    for _ in range(30):
        centre = np.array([0, 0, (front + back) / 2])
        extent = np.array([2 * half[0], 2 * half[1], front - back])
        room = _Room(R, setting.centres[0] + R @ centre, extent)
        nearest, farthest = _wall_depths(room, setting.cameras, rays)
        if farthest <= 0.98 * setting.far and nearest >= setting.near:
            return room
        front = front if farthest <= 0.98 * setting.far else 0.93 * front
        half = half if nearest >= setting.near else 1.15 * half
    warn(f"walls {nearest:.3g} to {farthest:.3g} m away: no room fits the cameras' depth range: widen that")
    return room


def _rays(camera: Camera) -> NDArray:
    """World directions, for a metre of depth, of pixels all over the image."""
    grid = coarse_grid(camera.hw, max(camera.hw) // 24 or 1).reshape(-1, 2)
    directions = (camera.unproject(grid, grid.new_ones(len(grid))) - camera.centre).double().numpy()
    return np.asarray(directions[np.isfinite(directions).all(1)])


def _half_view(camera: Camera) -> list[float]:
    """Tangents of half the angle of view across and down."""
    return [n / 2 / float(f) for n, f in zip(camera.hw[::-1], camera.K[:2, :2].abs().amax(1))]


def _wall_depths(room: _Room, cameras: Sequence[Camera], rays: Sequence[NDArray]) -> tuple[float, float]:
    """Least and greatest depth at which cameras see the walls."""
    depths = []
    for camera, directions in zip(cameras, rays):
        origin = (camera.centre.double().numpy() - room.centre) @ room.R
        d = directions @ room.R
        walls = np.where(d > 0, 1, -1) * room.extent / 2
        depths.append(((walls - origin) / np.where(np.abs(d) < 1e-9, 1e-9, d)).min(1))
    every = np.concatenate(depths)
    return float(every.min()), float(every.max())


def _lights(setting: Setting, room: _Room) -> tuple[Light, ...]:
    """Two to four lamps beside and above the cameras, of similar brightness together, and perhaps a sun."""
    rng = setting.rng
    shares = rng.dirichlet(np.full(int(rng.integers(2, 5)), 3.0)) * _IRRADIANCE * rng.uniform(0.8, 1.2)
    target = room.at(np.array([0.0, 0.0, 0.2]))
    lights = [_lamp(setting, room, target, float(share)) for share in shares]
    if rng.uniform() < 0.6:
        direction = room.R @ np.array([rng.uniform(-1, 1), rng.uniform(0.2, 1), rng.uniform(0.3, 1)])
        sun = Light(kind="sun", power=float(rng.uniform(0.8, 2)), direction=vec(direction), size=0.05)
        lights.append(_tinted(rng, sun))
    return tuple(lights)


def _lamp(setting: Setting, room: _Room, target: NDArray, irradiance: float) -> Light:
    rng = setting.rng
    where = room.at(np.array([rng.uniform(-0.8, 0.8), rng.uniform(-0.9, 0.1), rng.uniform(-0.9, -0.1)]))
    squared = float(((target - where) ** 2).sum())
    if rng.uniform() < 0.5:
        size = float(rng.uniform(0.05, 0.2) * room.extent.min())
        light = Light(kind="area", power=irradiance * math.pi * squared, direction=vec(target - where))
    else:
        size = float(rng.uniform(0.01, 0.03) * room.extent.min())
        light = Light(kind="point", power=irradiance * 4 * math.pi * squared)
    return _tinted(rng, replace(light, position=vec(where), size=size))


def _tinted(rng: Generator, light: Light) -> Light:
    """Tint a light from warm to cold; warm light has more near infrared."""
    warmth = float(rng.uniform(-0.12, 0.2))
    return replace(light, rgb=(1 + warmth, 1.0, 1 - warmth), nir=1 + 2 * max(warmth, 0.0))


# Objects ----------------------------------------------------------------------------------------------------


def _object(
    setting: Setting, room: _Room, others: list[Object], surface: Surface, moving: float
) -> Object | None:
    """Shape at a random place in view; None if the drawn position is unsuitable."""
    rng, camera = setting.rng, setting.camera()
    depth = float(1 / rng.uniform(1 / (0.75 * setting.far), 1 / (1.25 * setting.near)))
    centre = setting.ahead(camera, rng.uniform(-0.95, 0.95, 2), depth)
    view = depth * min(_half_view(camera))
    radius = float(min(view * rng.uniform(0.2, 0.55), 0.85 * (setting.nearest(centre) - setting.near)))
    if not radius > 0.05 * view or not room.holds(centre, 0.4 * radius) or _crowded(centre, radius, others):
        return None
    shape = _SHAPES[int(rng.integers(len(_SHAPES)))]
    extent = _extent(rng, shape, radius)
    relief = _relief(rng, extent) if rng.uniform() < 0.4 else None
    rotation = vec(Rotation.random(random_state=rng).as_rotvec())
    key = Key(position=vec(centre), rotation=rotation, extent=vec(extent))
    material = _material(rng, surface(setting, depth, _PATTERNS), setting.metres(depth, 1))
    keys = (key,) if moving == 0 else _path(setting, key, radius, moving)
    name = f"{shape}{len(others) + 1}"
    return Object(name=name, shape=shape, motion=Motion(keys), material=material, relief=relief)


def _crowded(centre: NDArray, radius: float, others: list[Object]) -> bool:
    """True if much of the object would be inside another one."""
    keys = [other.motion.keys[0] for other in others]
    radii = [0.5 * (radius + np.linalg.norm(key.extent) / 2) for key in keys]
    return any(np.linalg.norm(centre - key.position) < reach for key, reach in zip(keys, radii))


def _extent(rng: Generator, shape: Shape, radius: float) -> NDArray:
    """Side lengths of the box around a shape inside a sphere."""
    extent = rng.uniform(0.55, 1.0, 3)
    if shape == "torus":
        extent[1] = 0.3 * extent[0]
    if shape == "plane":
        extent[2] = 0.01
    extent *= 2 * radius / np.linalg.norm(extent)
    return np.asarray(extent)


def _relief(rng: Generator, extent: NDArray) -> Relief:
    size = np.sort(extent)[1] * rng.uniform(0.25, 0.8)
    height = size * rng.uniform(0.05, 0.15)
    return Relief(height=float(height), size=float(size), seed=int(rng.integers(2**31)))


def _path(setting: Setting, start: Key, radius: float, duration: float) -> tuple[Key, ...]:
    """Four evenly spaced keys of random steps, rotations and changes of extent."""
    rng, keys = setting.rng, [start]
    for k in range(1, 4):
        position = np.asarray(keys[-1].position) + rng.normal(size=3) * 0.4 * radius
        if setting.nearest(position) - 1.2 * radius < setting.near:
            position = np.asarray(keys[-1].position)
        step = Rotation.from_rotvec(np.radians(rng.uniform(-35, 35, 3)))
        rotation = vec((step * Rotation.from_rotvec(keys[-1].rotation)).as_rotvec())
        extent = vec(np.asarray(start.extent) * rng.uniform(0.8, 1.2, 3))
        keys.append(Key(position=vec(position), rotation=rotation, extent=extent, time=k * duration / 3))
    return tuple(keys)


def _material(rng: Generator, texture: Texture, pixel: float) -> Material:
    """Random material: mostly dull; metallic one time in ten, transparent one in twenty, with fine bumps one
    in three."""
    metallic = float(rng.uniform(0.6, 1)) if rng.uniform() < 0.1 else 0.0
    transmission = float(rng.uniform(0.5, 0.9)) if not metallic and rng.uniform() < 0.05 else 0.0
    return Material(
        texture=texture,
        roughness=float(rng.uniform(0.25, 1)),
        specular=float(rng.uniform(0, 0.5)),
        metallic=metallic,
        transmission=transmission,
        bump=float(rng.uniform(0.5, 2) * pixel) if rng.uniform() < 0.33 else 0.0,
    )


def seeded(name: str, seed: int) -> Generator:
    """Make a NumPy random generator for the name of a scene generator and a seed; others are independent of
    it."""
    return np.random.default_rng([zlib.crc32(name.encode()), seed])


def vec(values: NDArray) -> Vec3:
    """Convert three numbers to a tuple, as scenes hold them."""
    x, y, z = (float(v) for v in values)
    return x, y, z
