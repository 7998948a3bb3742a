"""A garden, a house, a wood under the sky, through a long lens: what visible light and infrared tell apart.

Leaves and grass are bright in the near infrared and the sky is dark; dyes of cloth do not absorb there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from numpy.random import Generator

from arraygeom.rig import Rig
from pat.lab.synthesis.furnish import seeded
from pat.lab.synthesis.scene import (
    Light,
    Material,
    Object,
    Paint,
    Relief,
    Scene,
    Texture,
    TextureKind,
    Vec3,
    World,
)

from .props import arranged, ball, box, first_camera, lathed, paint, plain

WIDE = 5.6
"""Metres that the first camera's image is wide at the washing line."""
LEAVES = 0.55
"""Near infrared that leaves reflect."""

_LIGHTS = (
    Light(kind="sun", power=3.0, direction=(0.55, 0.62, 0.6), rgb=(1.0, 0.94, 0.84), nir=1.1, size=0.01),
)


def landscape(seed: int, rig: Rig, *, moving: float = 0.0) -> Scene:
    """The garden in front of a rig's first camera, level, at a distance that shows the washing line whole.

    `seed` draws the trees; nothing moves. Raises ValueError if the rig has no calibrated camera.
    """
    camera, rng = first_camera(rig), seeded("landscape", seed)
    objects = [*_ground(rng), *_washing(), *_fence(), *_house(), *_trees(rng), *_beds(rng)]
    distance = WIDE * float(camera.K[0, 0]) / camera.hw[1]
    sky = World((0.30, 0.47, 0.75), 0.16)
    return arranged(
        "landscape", seed, rig, objects, _LIGHTS, sky, aim=(0, -1.75, 0), distance=distance, down=1.5
    )


def _leafy(dark: Vec3, light: Vec3, scale: float, kind: TextureKind = "noise") -> Material:
    shades = (dark, 0.5), (light, 1.0), (dark, 0.7), (light, 0.9)
    paints = tuple(Paint(rgb, LEAVES * share) for rgb, share in shades)
    texture = Texture(kind=kind, paints=paints, scale=scale, grain=0.25)
    return Material(texture=texture, roughness=0.9, specular=0.05)


_GRASS = _leafy((0.06, 0.14, 0.025), (0.13, 0.24, 0.05), 3.0)
_BARK = plain(0.13, 0.09, 0.06, roughness=0.95, specular=0.05, grain=0.3)
_WHITE = plain(0.74, 0.72, 0.68, roughness=0.6)
_GREYS = (paint(0.34, 0.30, 0.25, nir=0.4), paint(0.45, 0.40, 0.34, nir=0.45))
_STONE = Material(texture=Texture(kind="noise", paints=_GREYS, scale=9), roughness=0.95)


def _ground(rng: Generator) -> Iterator[Object]:
    yield box("meadow", (0, 0.05, 80), (400, 0.1, 240), _GRASS)
    yield box("path", (0.7, 0.0, 12), (1.1, 0.02, 60), _STONE, yaw=-3)
    for i in range(7):
        green = 0.10 + 0.05 * float(rng.uniform())
        wood = _leafy((0.035, 0.5 * green, 0.03), (0.07, green, 0.04), 0.25)
        middle = (-60 + 21 * i + float(rng.uniform(-6, 6)), 2.0, 128 + float(rng.uniform(-8, 8)))
        yield ball(f"hill{i}", middle, (48, float(rng.uniform(10, 20)), 24), wood)


def _washing() -> Iterator[Object]:
    for side in (-2.45, 2.3):
        yield lathed(f"post {side}", (side, 0, 0), [(0, 2.1), (0.05, 2.1), (0.05, 0), (0, 0)], _BARK)
    yield box("line", (-0.07, -2.0, 0), (4.75, 0.012, 0.012), _WHITE)
    dyes = (0.55, 0.03, 0.03), (0.72, 0.70, 0.66), (0.03, 0.09, 0.38), (0.75, 0.5, 0.04), (0.02, 0.02, 0.025)
    widths, heights = (0.62, 0.95, 0.7, 0.55, 0.6), (0.85, 0.6, 0.95, 0.75, 1.05)
    x = -2.1
    for i, (rgb, width, height) in enumerate(zip(dyes, widths, heights)):
        light = paint(*(min(1.6 * c + 0.02, 0.9) for c in rgb))
        checks = Texture(kind="checker", paints=(paint(*rgb), light), scale=9)
        cloth = Material(texture=checks, roughness=0.95, specular=0.03)
        middle = (x + width / 2, -1.99 + height / 2, 0.02 * (-1) ** i)
        yield box(f"cloth{i}", middle, (width, height, 0.012), cloth, yaw=14 * (-1) ** i)
        x += width + 0.2


def _fence() -> Iterator[Object]:
    for i in range(46):
        x = -6.6 + 0.3 * i
        if abs(x - 0.55) > 0.65:
            yield box(f"pale{i}", (x, -0.45, 6), (0.09, 0.9, 0.03), _WHITE)
    for side, middle, width in (("left", -3.5, 6.6), ("right", 4.45, 6.5)):
        for y in (-0.3, -0.7):
            yield box(f"rail {side}{y}", (middle, y, 6.04), (width, 0.06, 0.03), _WHITE)


def _house() -> Iterator[Object]:
    paints = (
        paint(0.36, 0.13, 0.08, nir=0.42),
        paint(0.42, 0.17, 0.10, nir=0.45),
        paint(0.55, 0.5, 0.44, nir=0.55),
    )
    brick = Material(texture=Texture(kind="brick", paints=paints, scale=4.0), roughness=0.9, specular=0.1)
    tile = Texture(
        kind="brick", paints=(paint(0.16, 0.07, 0.05, nir=0.2), paint(0.22, 0.1, 0.07, nir=0.25)), scale=2.5
    )
    glass = plain(0.03, 0.04, 0.05, roughness=0.05, specular=0.8)
    x, z = -1.6, 24.0
    yield box("house", (x, -2.3, z + 3), (7.0, 4.6, 6), brick)
    for side in (-1, 1):
        roof = Material(texture=tile, roughness=0.85)
        yield box(f"roof{side}", (x + side * 1.95, -5.8, z + 3), (4.7, 0.16, 6.8), roof, roll=side * 36)
    for k in range(12):
        yield box(f"gable{k}", (x, -4.7 - 0.2 * k, z + 3.01), (6.6 - 0.55 * k, 0.22, 6), brick)
    yield box("door", (x + 2.1, -1.05, z), (1.0, 2.1, 0.08), plain(0.03, 0.16, 0.10, roughness=0.4))
    for i, (dx, y) in enumerate(((-2.2, -1.5), (0.1, -1.5), (-2.2, -3.6), (0.1, -3.6), (2.2, -3.6))):
        yield box(f"frame{i}", (x + dx, y, z), (1.3, 1.3, 0.07), _WHITE)
        for j, shift in enumerate((-0.28, 0.28)):
            yield box(f"pane{i}{j}", (x + dx + shift, y, z - 0.03), (0.5, 1.1, 0.04), glass)
    yield box("chimney", (x - 1.6, -7.0, z + 3), (0.7, 1.8, 0.7), brick)


def _trees(rng: Generator) -> Iterator[Object]:
    positions = ((3.4, 9.0, 5.2), (6.4, 30.0, 8.0), (-8.3, 38.0, 9.5), (9.5, 60.0, 11.0), (-3.0, 66.0, 12.0))
    for i, (x, z, height) in enumerate(positions):
        trunk = [(0, 0.5 * height), (0.025 * height, 0.5 * height), (0.03 * height, 0), (0, 0)]
        yield lathed(f"trunk{i}", (x, 0, z), trunk, _BARK)
        green = 0.16 + 0.08 * float(rng.uniform())
        leaves = _leafy((0.02, 0.32 * green, 0.012), (0.35 * green, green, 0.03), 50 / height, "voronoi")
        for j in range(11):
            offset = rng.uniform(-1, 1, 3) * (0.22, 0.24, 0.22)
            radius = float(rng.uniform(0.26, 0.42)) * height
            dx, dy, dz = (float(step) for step in offset)
            middle = (x + dx * height, (-0.68 + dy) * height, z + dz * height)
            yield _bush(f"crown{i}.{j}", middle, (radius, 0.8 * radius, radius), leaves, seed=100 * i + j)


def _bush(name: str, middle: Vec3, extent: Sequence[float], leaves: Material, *, seed: int) -> Object:
    relief = Relief(height=0.1 * extent[0], size=0.13 * extent[0], seed=seed)
    return replace(ball(name, middle, (extent[0], extent[1], extent[2]), leaves), relief=relief)


def _beds(rng: Generator) -> Iterator[Object]:
    leaves = _leafy((0.03, 0.09, 0.02), (0.09, 0.20, 0.04), 22.0, "voronoi")
    for i in range(12):
        x = -3.4 + 0.62 * i
        if abs(x - 0.6) > 0.7:
            size = float(rng.uniform(0.5, 0.8))
            yield _bush(f"bush{i}", (x, -0.15, 3.2), (size, 0.9 * size, size), leaves, seed=i)
    colours = ((0.62, 0.03, 0.04), (0.75, 0.52, 0.03), (0.65, 0.62, 0.60), (0.35, 0.05, 0.38))
    for i in range(90):
        x, petals = float(rng.uniform(-3.6, 3.6)), plain(*colours[i % 4], roughness=0.8)
        if abs(x - 0.6) > 0.8:
            middle = (x, -float(rng.uniform(0.2, 0.55)), 2.85 + float(rng.uniform(-0.05, 0.15)))
            yield ball(f"flower{i}", middle, (0.07, 0.06, 0.05), petals)
