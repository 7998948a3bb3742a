"""A room one would photograph: a table with a still life before a bookshelf, a window's light and a lamp.

Everything is arranged in a frame of its own, metres: x right, y down, z away from the camera, the origin in
the middle of the table's front part, on its top.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from arraygeom import Camera, Rig
from pat.lab.synthesis.furnish import seeded, vec
from pat.lab.synthesis.scene import Key, Light, Material, Motion, Object, Paint, Scene, Texture, Vec3, World

from .props import arranged, ball, box, first_camera, lathed, moved, on_path, paint, plain, profile
from .room import BRASS, FLOOR, OAK, SHELF, WALNUT, furniture, pattern

VIEW = 1.4
"""Metres of the still life that the first camera's image is wide."""
WIDE = 2.0 * VIEW
"""Width of a camera's view at the table, metres, from which on there is a room around it."""
DOWNWARDS = 13.0
"""Degrees by which the first camera faces downwards."""
AIM = (0.0, -0.17, 0.2)
"""The point of the room that is in the middle of its image."""
DAYLIGHT, LAMPLIGHT = (0.92, 0.98, 1.0), (1.0, 0.78, 0.5)
BULB = 12.0
"""Radiance of the lamp's bulb, 1 being the white of paper in the light of the window."""


def still_life(seed: int, rig: Rig, *, moving: float = 0.0) -> Scene:
    """The room in front of a rig's first camera, level and at a distance that shows the still life whole.

    `seed` draws the books. Where a camera sees much more than the table, there is a whole room. With `moving`
    seconds, the ball is thrown through the image and takes so long. Raises ValueError if the rig has no
    calibrated camera.
    """
    camera, rng = first_camera(rig), seeded("still-life", seed)
    objects = [*_furniture(), *_books(rng), *_plant(rng), *_pottery(), *_fruit(), *_toys(moving), *_lamp()]
    distance = VIEW * float(camera.K[0, 0]) / camera.hw[1]
    cameras = [c for c in rig.cameras.values() if isinstance(c, Camera)]
    if any(distance * c.hw[1] / float(c.K[0, 0]) > WIDE for c in cameras):
        objects += _room(rng)
    world = World((0.06, 0.065, 0.07), 0.06)
    return arranged(
        "still-life", seed, rig, objects, _LIGHTS, world, aim=AIM, distance=distance, down=DOWNWARDS
    )


_LIGHTS = (
    Light(
        kind="area", power=125, position=(-2.4, -1.7, -0.6), direction=(2.2, 1.4, 0.9), rgb=DAYLIGHT, size=1.3
    ),
    Light(
        kind="area",
        power=14,
        position=(1.8, -1.9, -1.6),
        direction=(-1.5, 1.5, 1.9),
        rgb=(1.0, 0.93, 0.85),
        size=1,
    ),
    Light(kind="point", power=1.7, position=(0.62, -0.36, 0.42), rgb=LAMPLIGHT, nir=1.8, size=0.03),
)

# Surfaces ---------------------------------------------------------------------------------------------------


_PLASTER = pattern("noise", (0.40, 0.43, 0.36), (0.47, 0.50, 0.42), 7.0, grain=0.05)
_CLOTH = pattern("checker", (0.62, 0.58, 0.50), (0.16, 0.25, 0.38), 26.0, grain=0.1)

# What is in the room ----------------------------------------------------------------------------------------


def _furniture() -> Iterator[Object]:
    yield box("table", (0, 0.02, 0.28), (2.3, 0.04, 1.0), OAK)
    yield box("runner", (0.05, -0.002, 0.26), (0.62, 0.004, 0.62), _CLOTH, yaw=12)
    yield box("wall", (0, -0.9, SHELF + 0.34), (8, 4.5, 0.04), _PLASTER)
    yield box("floor", (0, 0.78, 0.0), (8, 0.04, 4), WALNUT)
    for i, y in enumerate((-1.12, -0.70, -0.28, 0.14)):
        yield box(f"board{i}", (-0.02, y, SHELF + 0.15), (2.4, 0.025, 0.3), WALNUT)
    for i, x in enumerate((-1.22, 0.35, 1.18)):
        yield box(f"side{i}", (x, -0.5, SHELF + 0.15), (0.025, 1.5, 0.3), WALNUT)
    yield box("back", (-0.02, -0.5, SHELF + 0.31), (2.4, 1.5, 0.01), plain(0.11, 0.075, 0.05, roughness=0.8))


_CLOTHBOUND: tuple[Vec3, ...] = (
    (0.36, 0.035, 0.03), (0.03, 0.08, 0.26), (0.02, 0.16, 0.09), (0.55, 0.34, 0.05), (0.60, 0.55, 0.44),
    (0.05, 0.05, 0.06), (0.25, 0.10, 0.22), (0.03, 0.25, 0.28), (0.50, 0.16, 0.04), (0.20, 0.20, 0.19),
)  # fmt: skip


def _books(rng: Generator) -> Iterator[Object]:
    for row, (top, left, right) in enumerate(((-0.28, -1.2, 0.33), (0.14, -1.2, 0.33), (-0.28, 0.37, 0.8))):
        yield from _row_of_books(rng, f"book{row}", top, left, right)
    for i, colour in enumerate(_CLOTHBOUND[1:5]):
        y = -0.0125 + 0.14 - 0.02 - 0.036 * i
        middle = (0.72 + 0.01 * i, y, SHELF + 0.14)
        yield box(f"lying{i}", middle, (0.27, 0.034, 0.19), plain(*colour), yaw=6 * i - 8)


def _room(rng: Generator) -> Iterator[Object]:
    """Yield the objects around the table: furniture, more books, a tall plant."""
    yield from furniture()
    for i, (left, right) in enumerate(((-1.2, 0.33), (0.37, 1.16))):
        yield from _row_of_books(rng, f"upper book{i}", -0.70, left, right)
    yield from moved(_plant(rng), "tall", (3.3, FLOOR, 0.2), size=2.3)


def _row_of_books(rng: Generator, name: str, board: float, left: float, right: float) -> Iterator[Object]:
    """Books on a shelf's board of some height, between two sides."""
    x = left + 0.01
    while x < right - 0.06:
        width, height = float(rng.uniform(0.018, 0.055)), float(rng.uniform(0.2, 0.33))
        yield from _book(rng, f"{name}.{x:.2f}", x + width / 2, board - 0.0125, (width, height))
        x += width + (float(rng.uniform(0.05, 0.16)) if rng.uniform() < 0.06 else 0.0015)


def _book(rng: Generator, name: str, x: float, floor: float, wh: tuple[float, float]) -> Iterator[Object]:
    width, height = wh
    z = SHELF + 0.05 + float(rng.uniform(0, 0.03)) + 0.09
    colour = tuple(float(c * rng.uniform(0.7, 1.3)) for c in _CLOTHBOUND[int(rng.integers(len(_CLOTHBOUND)))])
    cover = plain(*colour, roughness=0.6, grain=0.15)
    yield box(name, (x, floor - height / 2, z), (width, height, 0.18), cover)
    bright = sum(colour) > 0.6
    label = plain(*((0.08, 0.05, 0.04) if bright else (0.62, 0.47, 0.20)), roughness=0.4)
    places = rng.choice([0.12, 0.2, 0.35, 0.6, 0.8, 0.88], int(rng.integers(1, 4)), replace=False)
    for fraction in sorted(places):
        position = (x, floor - height * (1 - float(fraction)), z - 0.0005)
        extent = (width * 0.99, float(rng.uniform(0.004, 0.022)), 0.18)
        yield box(f"{name}.{fraction}", position, extent, label)


def _plant(rng: Generator) -> Iterator[Object]:
    clay, soil = plain(0.42, 0.15, 0.07, roughness=0.85, grain=0.15), plain(0.03, 0.02, 0.012, roughness=1.0)
    x, z = -0.52, 0.38
    pot = profile(0, 120, 83, 120, 83, 140, 98, 140, 98, 110, 90, 108, 70, 0, 0, 0)
    yield lathed("pot", (x, 0, z), pot, clay)
    yield lathed("saucer", (x, 0, z), profile(0, 8, 100, 12, 115, 20, 110, 0, 0, 0), clay)
    yield ball("soil", (x, -0.118, z), (0.16, 0.012, 0.16), soil)
    for i in range(44):
        azimuth, lean = i * 137.5, 12 + 62 * (i / 44) ** 0.8
        length = float(rng.uniform(0.16, 0.27))
        rotation = Rotation.from_euler("xy", (lean, azimuth), degrees=True)
        tip = rotation.apply([0, -1, 0])
        green = (0.05 + 0.05 * float(rng.uniform()), 0.20 + 0.12 * float(rng.uniform()), 0.035)
        paints = tuple(paint(*(factor * c for c in green), nir=0.55) for factor in (1.0, 1.35))
        leaf = Material(texture=Texture(kind="noise", paints=paints, scale=60.0), roughness=0.4, specular=0.4)
        middle = np.array([x, -0.13, z]) + tip * length / 2
        blade = ball(f"leaf{i}", vec(middle), (0.035 + 0.02 * float(rng.uniform()), length, 0.004), leaf)
        key = replace(blade.motion.keys[0], rotation=vec(rotation.as_rotvec()))
        yield replace(blade, motion=Motion((key,)))


def _pottery() -> Iterator[Object]:
    glaze = {"roughness": 0.12, "specular": 0.6}
    colours = (0.02, 0.09, 0.33), (0.72, 0.70, 0.64), (0.45, 0.03, 0.02)
    blue, white, red = (plain(*colour, **glaze) for colour in colours)
    vase = profile(22, 330, 30, 335, 32, 330, 24, 300, 24, 260, 75, 190, 85, 130)
    yield lathed("vase", (-0.24, 0, 0.52), [*vase, *profile(50, 20, 50, 0, 0, 0)], blue)
    clays = (paint(0.72, 0.66, 0.5), paint(0.5, 0.2, 0.07))
    bands = Texture(kind="wave", paints=clays, scale=60.0, distortion=0.6)
    jar = profile(0, 235, 16, 235, 20, 220, 12, 205, 60, 190, 66, 180, 66, 170)
    jar += profile(90, 150, 100, 90, 70, 5, 70, 0, 0, 0)
    yield lathed("jar", (0.26, 0, 0.6), jar, Material(texture=bands, roughness=0.25, specular=0.5))
    mug = profile(36, 12, 38, 95, 42, 97, 44, 92, 44, 8, 40, 0, 0, 0)
    yield lathed("mug", (0.36, 0, 0.1), [*profile(0, 10), *mug], white)
    key = Key(position=(0.412, -0.05, 0.1), rotation=(math.pi / 2, 0, 0), extent=(0.062, 0.012, 0.066))
    yield Object(name="handle", shape="torus", motion=Motion((key,)), material=white)
    coffee = plain(0.045, 0.02, 0.01, roughness=0.05, specular=0.6)
    yield ball("coffee", (0.36, -0.082, 0.1), (0.076, 0.003, 0.076), coffee)
    bowl = profile(0, 20, 60, 22, 115, 60, 128, 85, 133, 86, 133, 82, 100, 30)
    yield lathed("bowl", (0.02, -0.004, 0.24), [*bowl, *profile(55, 8, 55, 0, 0, 0)], red)


def _fruit() -> Iterator[Object]:
    peel = Texture(kind="noise", paints=(paint(0.75, 0.22, 0.012), paint(0.88, 0.30, 0.02)), scale=110.0)
    orange = Material(texture=peel, roughness=0.45, specular=0.4, bump=0.0012)
    skin = Texture(kind="noise", paints=(paint(0.45, 0.025, 0.015), paint(0.55, 0.40, 0.06)), scale=22.0)
    apple = Material(texture=skin, roughness=0.2, specular=0.5)
    green = plain(0.28, 0.42, 0.04, roughness=0.2, specular=0.5, grain=0.1)
    lemon = plain(0.80, 0.60, 0.03, roughness=0.4, specular=0.4, grain=0.08)
    round_ = profile(0, 62, 8, 66, 30, 73, 42, 50, 34, 12, 14, 0, 0, 5)
    for i, (x, z) in enumerate(((-0.045, 0.24), (0.035, 0.28), (0.03, 0.19))):
        yield ball(f"orange{i}", (x, -0.085, z), (0.082, 0.078, 0.082), orange, euler=(40 * i, 15, 70 * i))
    yield lathed("apple", (0.095, -0.05, 0.235), round_, apple, euler=(0, 0, 14))
    yield lathed("apple2", (-0.02, -0.105, 0.235), round_, green, euler=(-10, 0, -8))
    yield lathed("apple3", (-0.2, 0.0, 0.16), round_, apple, euler=(8, 60, -6))
    yield ball("lemon", (-0.13, -0.03, 0.09), (0.085, 0.058, 0.058), lemon, euler=(0, 35, 0))


def _toys(moving: float) -> Iterator[Object]:
    colours = ((0.55, 0.03, 0.03), (0.03, 0.30, 0.08), (0.03, 0.10, 0.45), (0.75, 0.48, 0.03))
    positions = ((0.56, -0.025, 0.13), (0.63, -0.025, 0.2), (0.585, -0.075, 0.16), (0.49, -0.025, 0.22))
    for i, (position, yaw, colour) in enumerate(zip(positions, (20, -15, 40, 5), colours)):
        painted = plain(*colour, roughness=0.55, grain=0.1)
        yield box(f"block{i}", position, (0.05, 0.05, 0.05), painted, yaw=yaw)
    stripes = Texture(kind="checker", paints=(paint(0.80, 0.60, 0.03), paint(0.05, 0.12, 0.45)), scale=13.0)
    surface = Material(texture=stripes, roughness=0.3, specular=0.4)
    toy = ball("ball", (-0.36, -0.05, 0.12), (0.1, 0.1, 0.1), surface)
    yield on_path(toy, _throw(moving), (1.5, 0.4, 5.0)) if moving else toy


def _throw(duration: float) -> list[tuple[float, Vec3]]:
    """A throw from left to right before the shelf."""
    times = np.linspace(0, 1, 9)
    return [
        (float(duration * t), (float(-0.5 + 0.95 * t), float(-0.3 - 0.36 * t * (1 - t)), 0.05)) for t in times
    ]


def _lamp() -> Iterator[Object]:
    linen = Texture(paints=(paint(0.85, 0.62, 0.36),))
    shade = Material(texture=linen, roughness=0.9, specular=0.1, emission=0.62)
    bulb = Material(texture=Texture(paints=(Paint(LAMPLIGHT, 1.0),)), emission=BULB)
    x, z = 0.62, 0.42
    yield lathed("lamp", (x, 0, z), profile(0, 300, 8, 300, 8, 30, 30, 20, 80, 12, 80, 0), BRASS)
    yield lathed("shade", (x, -0.33, z), profile(72, 200, 74, 200, 140, 2, 142, 0, 138, 2), shade)
    yield ball("bulb", (x, -0.36, z), (0.05, 0.06, 0.05), bulb)
