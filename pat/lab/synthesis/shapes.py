"""Shapes of scenes as meshes in metres, the same for every renderer."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from .scene import Object, Relief, Shape, Vec3

Patch = Callable[[NDArray, NDArray], tuple[NDArray, NDArray, NDArray]]
"""Function from (s, t) in 0..1 to (x, y, z) in [-0.5, 0.5]^3. From outside, s is right where t is down."""

TORUS = 0.3
"""Radius of a torus's tube divided by that of its outline."""

_FLAT = 1
_ROUND = 64
_RELIEF_CELLS = 3
_MOST_CELLS = 96


class Mesh(NamedTuple):
    """Quadrilateral mesh with texture coordinates.

    Attributes:
        vertices: metres in the object's frame, at the extent of its first key.
        faces: vertex numbers, counter-clockwise from outside; a triangle has its last number twice.
        uv: texture position of each face's corners, metres, x right, y down.
    """

    vertices: Float[NDArray, "v 3"]
    faces: Int[NDArray, "f 4"]
    uv: Float[NDArray, "f 4 2"]


class _Surface(NamedTuple):
    """Patch, its cells along s and t, and whether coinciding corners are merged.

    They are not at the tip of a cone, where each has the normal of its own part of the side.
    """

    patch: Patch
    cells: tuple[int, int]
    weld: bool = True


def mesh(item: Object) -> Mesh:
    """Build the mesh of an object, relief included.

    Patches of a plain shape do not share corners, so that edges between them are sharp; patches with relief
    do.

    Raises:
        KeyError: for another shape than `Shape` lists.
    """
    extent = np.asarray(item.motion.keys[0].extent)
    surfaces = (_lathe(item.profile),) if item.shape == "lathe" else SURFACES[item.shape]
    parts = [_part(s, extent, item.relief) for s in surfaces]
    if item.relief is None:
        return _joined([_welded(p, extent) if s.weld else p for p, s in zip(parts, surfaces)])
    flat = _welded(_joined(parts), extent)
    bumps = item.relief.height * _noise(flat.vertices / item.relief.size, item.relief.seed)
    return flat._replace(vertices=flat.vertices + bumps[:, None] * _normals(flat))


def inside(item: Object, point: Float[NDArray, "3"], time: float) -> bool:
    """Return True if a world point, in metres, is inside a solid object at a time, in seconds, or about as
    near to it as its relief is high.

    Planes, rooms and lathes have no inside: always False.
    """
    placement = item.motion.at(time)
    margin = item.relief.height if item.relief else 0.0
    local = placement.R.T @ (point - placement.position) / (placement.extent + 2 * margin)
    return item.shape in _INSIDE and bool(_INSIDE[item.shape](*local))


def _part(surface: _Surface, extent: NDArray, relief: Relief | None) -> Mesh:
    m, n = _cells(surface, extent, relief)
    s, t = np.meshgrid(np.linspace(0, 1, m + 1), np.linspace(0, 1, n + 1), indexing="ij")
    points = np.stack(surface.patch(s, t), -1) * extent
    lengths = _lengths(points)
    uv = np.stack([s * lengths[0], t * lengths[1]], -1)
    corner = np.arange((m + 1) * (n + 1)).reshape(m + 1, n + 1)
    faces = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]], -1).reshape(-1, 4)
    return Mesh(points.reshape(-1, 3), faces, uv.reshape(-1, 2)[faces])


def _joined(parts: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    faces = np.concatenate([p.faces + start for p, start in zip(parts, starts)])
    return Mesh(np.concatenate([p.vertices for p in parts]), faces, np.concatenate([p.uv for p in parts]))


def _cells(surface: _Surface, extent: NDArray, relief: Relief | None) -> tuple[int, int]:
    if relief is None:
        return surface.cells
    grid = np.linspace(0, 1, 17)
    points = np.stack(surface.patch(*np.meshgrid(grid, grid, indexing="ij")), -1) * extent
    wanted = (math.ceil(_RELIEF_CELLS * length / relief.size) for length in _lengths(points))
    m, n = (min(max(w, c), _MOST_CELLS) for w, c in zip(wanted, surface.cells))
    return m, n


def _lengths(points: NDArray) -> tuple[float, float]:
    """Longest line along each of the two directions of a grid of points."""
    along_s = np.linalg.norm(np.diff(points, axis=0), axis=-1).sum(0).max()
    along_t = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(1).max()
    return float(along_s), float(along_t)


def _welded(loose: Mesh, extent: NDArray) -> Mesh:
    """Merge coinciding corners, and drop faces without area."""
    corners = np.round(loose.vertices / extent, 6)
    _, first, new = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    faces, uv = _triangles_last(new.reshape(-1)[loose.faces], loose.uv)
    keep = np.array([len(set(f)) >= 3 for f in faces.tolist()])
    return Mesh(loose.vertices[first], faces[keep], uv[keep])


def _triangles_last(faces: NDArray, uv: NDArray) -> tuple[NDArray, NDArray]:
    """Rotate faces with two equal adjacent corners so that these come last."""
    faces, uv = faces.copy(), uv.copy()
    for i in range(3):
        rows = np.flatnonzero(faces[:, i] == faces[:, i + 1])
        faces[rows], uv[rows] = np.roll(faces[rows], 2 - i, axis=1), np.roll(uv[rows], 2 - i, axis=1)
    return faces, uv


def _normals(surface: Mesh) -> NDArray:
    """Unit normals at the vertices, outwards."""
    a, b, c, d = (surface.vertices[surface.faces[:, i]] for i in range(4))
    by_face = np.cross(c - a, d - b)
    total = np.zeros_like(surface.vertices)
    for i in range(4):
        np.add.at(total, surface.faces[:, i], by_face)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def _noise(points: NDArray, seed: int) -> NDArray:
    """Smooth noise in -1..1 with features about 1 across: plane waves of random directions."""
    waves, rng = 24, np.random.default_rng(seed)
    direction = rng.normal(size=(waves, 3))
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    direction *= (2 * np.pi * rng.uniform(0.35, 0.8, (waves, 1))) / length
    total = np.cos(points @ direction.T + rng.uniform(0, 2 * np.pi, waves)).sum(1)
    return np.tanh(total / math.sqrt(waves / 2) / 1.5)


def _quad(origin: Vec3, along_s: Vec3, along_t: Vec3) -> Patch:
    o, a, b = (np.asarray(v, float) for v in (origin, along_s, along_t))
    return lambda s, t: tuple(o[i] + a[i] * s + b[i] * t for i in range(3))  # type: ignore[return-value]


def _revolved(radius: Callable[[NDArray], NDArray], y: Callable[[NDArray], NDArray], sign: int = 1) -> Patch:
    """Surface that a profile, by radius and y along t, sweeps around the y axis; backwards for `sign` -1."""

    def patch(s: NDArray, t: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        azimuth = 2 * np.pi * s * sign
        return radius(t) * np.cos(azimuth), y(t), radius(t) * np.sin(azimuth)

    return patch


def _lathe(profile: tuple[tuple[float, float], ...]) -> _Surface:
    """Surface that a profile sweeps around the y axis; its corners are points of the surface."""
    index = np.arange(len(profile))
    radius, y = (lambda t, v=v: np.interp(t * (len(profile) - 1), index, v) for v in np.array(profile).T)
    return _Surface(_revolved(radius, y), (_ROUND, len(profile) - 1))


_SPHERE = _revolved(lambda t: 0.5 * np.sin(np.pi * t), lambda t: -0.5 * np.cos(np.pi * t))
_TORUS = _revolved(
    lambda t: 0.5 * (1 - TORUS) + 0.5 * TORUS * np.cos(2 * np.pi * t), lambda t: 0.5 * np.sin(2 * np.pi * t)
)
_CYLINDER = _revolved(lambda t: np.full_like(t, 0.5), lambda t: t - 0.5)
_CONE = _revolved(lambda t: 0.5 * t, lambda t: t - 0.5)
_TOP = _revolved(lambda t: 0.5 * t, lambda t: np.full_like(t, -0.5))
_BOTTOM = _revolved(lambda t: 0.5 * t, lambda t: np.full_like(t, 0.5), -1)
_CUBE = (
    _quad((-0.5, -0.5, -0.5), (1, 0, 0), (0, 1, 0)),
    _quad((0.5, -0.5, 0.5), (-1, 0, 0), (0, 1, 0)),
    _quad((0.5, -0.5, -0.5), (0, 0, 1), (0, 1, 0)),
    _quad((-0.5, -0.5, 0.5), (0, 0, -1), (0, 1, 0)),
    _quad((-0.5, -0.5, 0.5), (1, 0, 0), (0, 0, -1)),
    _quad((-0.5, 0.5, -0.5), (1, 0, 0), (0, 0, 1)),
)

SURFACES: dict[Shape, tuple[_Surface, ...]] = {
    "plane": (_Surface(_quad((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0)), (_FLAT, _FLAT)),),
    "cube": tuple(_Surface(q, (_FLAT, _FLAT)) for q in _CUBE),
    "room": tuple(_Surface(q, (_FLAT, _FLAT)) for q in _CUBE),
    "sphere": (_Surface(_SPHERE, (_ROUND, _ROUND // 2)),),
    "cylinder": tuple(_Surface(p, (_ROUND, _FLAT)) for p in (_CYLINDER, _TOP, _BOTTOM)),
    "cone": (_Surface(_CONE, (_ROUND, _FLAT), weld=False), _Surface(_BOTTOM, (_ROUND, _FLAT))),
    "torus": (_Surface(_TORUS, (_ROUND, _ROUND // 2)),),
}

_INSIDE: dict[Shape, Callable[[float, float, float], bool]] = {
    "cube": lambda x, y, z: max(abs(x), abs(y), abs(z)) < 0.5,
    "sphere": lambda x, y, z: math.hypot(x, y, z) < 0.5,
    "cylinder": lambda x, y, z: math.hypot(x, z) < 0.5 and abs(y) < 0.5,
    "cone": lambda x, y, z: math.hypot(x, z) < 0.5 * (y + 0.5) and abs(y) < 0.5,
    "torus": lambda x, y, z: ((math.hypot(x, z) - 0.35) / 0.15) ** 2 + (y / 0.5) ** 2 < 1,
}
