"""The room around the table of `still_life.py`: what only a wide camera sees of it.

In the frame of the still life: metres, x right, y down, z away, the origin on the table's top.
"""

from __future__ import annotations

from collections.abc import Iterator

from pat.lab.synthesis.scene import Material, Object, Paint, Texture, TextureKind, Vec3

from .props import ball, box, lathed, moved, paint, plain, profile, wood

FLOOR, SHELF, WALL = 0.76, 1.15, 1.45
"""Height of the floor, and depths of the bookshelf's front and of the wall behind it."""
OAK = wood((0.21, 0.10, 0.042), (0.36, 0.19, 0.085), 14.0)
WALNUT = wood((0.07, 0.035, 0.018), (0.13, 0.066, 0.034), 18.0)
BRASS = plain(0.55, 0.36, 0.12, roughness=0.25, metallic=1.0)
_PALE = wood((0.42, 0.28, 0.15), (0.55, 0.38, 0.22), 9.0)
_WHITE = plain(0.72, 0.70, 0.66, roughness=0.5)


def furniture() -> Iterator[Object]:
    """The table's legs, a cupboard under the shelf, rug, armchair, chair, lamp, pictures and window."""
    yield from _under_the_table()
    yield box("skirting", (0, FLOOR - 0.07, WALL - 0.005), (8, 0.14, 0.02), _WHITE)
    rug = pattern("wave", (0.30, 0.045, 0.035), (0.42, 0.30, 0.17), 7.0, distortion=3.0)
    yield box("rug", (-0.25, FLOOR - 0.004, 0.0), (3.5, 0.008, 2.1), rug, yaw=-2)
    yield from moved(_armchair(), "armchair", (-2.25, FLOOR, 0.45), yaw=-38)
    yield from moved(_chair(), "chair", (1.75, FLOOR, -0.15), yaw=62)
    yield from moved(_floor_lamp(), "standing", (-1.62, FLOOR, 1.05))
    yield from _pictures()
    yield from moved(_window(), "window", (2.45, -1.0, WALL - 0.03))


def pattern(
    kind: TextureKind, first: Vec3, second: Vec3, scale: float, distortion: float = 0.0, grain: float = 0.15
) -> Material:
    """A matt material of two colours."""
    paints = (paint(*first), paint(*second))
    texture = Texture(kind=kind, paints=paints, scale=scale, distortion=distortion, grain=grain)
    return Material(texture=texture, roughness=0.95, specular=0.05)


def _under_the_table() -> Iterator[Object]:
    for x in (-1.04, 1.04):
        for z in (-0.11, 0.67):
            yield box(f"leg {x} {z}", (x, 0.4, z), (0.075, 0.72, 0.075), OAK)
    for z in (-0.11, 0.67):
        yield box(f"apron {z}", (0, 0.09, z), (2.1, 0.1, 0.025), OAK)
    yield box("cupboard", (-0.02, 0.46, SHELF + 0.15), (2.4, 0.6, 0.3), WALNUT)
    for i in range(4):
        x = -0.92 + 0.6 * i
        yield box(f"door{i}", (x, 0.46, SHELF - 0.004), (0.57, 0.54, 0.018), WALNUT)
        knob = (x + (0.22 if i % 2 == 0 else -0.22), 0.42, SHELF - 0.03)
        yield ball(f"knob{i}", knob, (0.03, 0.03, 0.03), BRASS)
    top = -1.145
    card, leather = plain(0.36, 0.24, 0.13, grain=0.1), plain(0.05, 0.12, 0.11, grain=0.1)
    yield box("carton", (-0.75, top - 0.13, SHELF + 0.15), (0.42, 0.26, 0.26), card)
    yield box("case", (0.1, top - 0.07, SHELF + 0.15), (0.5, 0.14, 0.24), leather, yaw=4)
    urn = profile(50, 340, 60, 340, 50, 300, 120, 220, 130, 140, 70, 0, 0, 0)
    yield lathed("urn", (0.82, top, SHELF + 0.15), urn, plain(0.50, 0.20, 0.08, roughness=0.3))


def _armchair() -> Iterator[Object]:
    cloth = pattern("noise", (0.045, 0.13, 0.14), (0.07, 0.18, 0.19), 130.0)
    yield box("base", (0, -0.23, 0), (0.78, 0.2, 0.72), cloth)
    yield box("back", (0, -0.55, 0.33), (0.78, 0.7, 0.15), cloth)
    yield ball("seat", (0, -0.37, -0.04), (0.6, 0.22, 0.72), cloth)
    for side in (-1, 1):
        yield box(f"arm{side}", (0.36 * side, -0.4, -0.01), (0.13, 0.38, 0.72), cloth)
        yield lathed(f"foot{side}", (0.32 * side, 0, -0.3), profile(30, 140, 15, 0, 0, 0), WALNUT)
    checks = pattern("checker", (0.7, 0.42, 0.04), (0.6, 0.5, 0.3), 9.0)
    yield ball("cushion", (0.03, -0.6, 0.2), (0.44, 0.4, 0.16), checks)


def _chair() -> Iterator[Object]:
    yield box("seat", (0, -0.46, 0), (0.42, 0.035, 0.42), _PALE)
    for x in (-0.18, 0.18):
        yield box(f"front leg {x}", (x, -0.23, -0.18), (0.035, 0.46, 0.035), _PALE)
        yield box(f"back leg {x}", (x, -0.46, 0.19), (0.035, 0.92, 0.035), _PALE)
    for i in range(3):
        yield box(f"slat{i}", (0, -0.62 - 0.12 * i, 0.19), (0.36, 0.06, 0.02), _PALE)


def _floor_lamp() -> Iterator[Object]:
    yield lathed("pole", (0, 0, 0), profile(0, 1550, 12, 1550, 12, 30, 130, 20, 140, 0, 0, 0), BRASS)
    linen = Material(texture=Texture(paints=(paint(0.85, 0.66, 0.42),)), roughness=0.9, emission=0.4)
    yield lathed("shade", (0, -1.45, 0), profile(140, 300, 142, 300, 210, 0, 208, 0), linen)


def _pictures() -> Iterator[Object]:
    sea = ((0.03, 0.10, 0.22), (0.55, 0.60, 0.62), (0.20, 0.33, 0.40), (0.62, 0.42, 0.22))
    field = ((0.45, 0.33, 0.06), (0.10, 0.20, 0.05), (0.55, 0.48, 0.35), (0.30, 0.07, 0.04))
    pictures = (-2.2, -1.15, 0.95, 0.7, sea), (-1.55, -0.75, 0.4, 0.5, field)
    for i, (x, y, w, h, paints) in enumerate(pictures):
        yield box(f"frame{i}", (x, y, WALL - 0.01), (w, h, 0.03), WALNUT)
        yield box(f"mount{i}", (x, y, WALL - 0.013), (w - 0.07, h - 0.07, 0.03), _WHITE)
        colours = tuple(paint(*rgb) for rgb in paints)
        painted = Texture(kind="wave", paints=colours, scale=2.6, distortion=5.0, offset=(3.0 * i, 1.0, 2.0))
        canvas = Material(texture=painted, roughness=0.6)
        yield box(f"painting{i}", (x, y, WALL - 0.016), (w - 0.2, h - 0.2, 0.03), canvas)


def _window() -> Iterator[Object]:
    dusk = Material(texture=Texture(paints=(Paint((0.16, 0.24, 0.40), 0.1),)), emission=1.0)
    yield box("panes", (0, 0, 0), (1.1, 1.3, 0.01), dusk)
    for x in (-0.55, 0, 0.55):
        yield box(f"post {x}", (x, 0, -0.02), (0.06, 1.36, 0.05), _WHITE)
    for y in (-0.65, -0.1, 0.65):
        yield box(f"bar {y}", (0, y, -0.02), (1.16, 0.06, 0.05), _WHITE)
    yield box("sill", (0, 0.7, -0.08), (1.3, 0.04, 0.2), _WHITE)
    linen = plain(0.46, 0.18, 0.10, roughness=0.95, specular=0.05, grain=0.1)
    for side in (-1, 1):
        for i in range(5):
            fold = profile(55, 2300, 55, 0, 0, 0)
            foot = (side * (0.56 + 0.085 * i), 1.6, -0.09 - 0.02 * (i % 2))
            yield lathed(f"curtain{side}{i}", foot, fold, linen)
    yield box("rail", (0, -0.72, -0.1), (2.1, 0.025, 0.025), BRASS)
