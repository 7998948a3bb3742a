"""A scene apart from any renderer: objects, materials, lights and motions, as frozen values that serialise.

The world is the rig's: metres, and whatever directions the rig's `cam_from_world` give it. Radians, seconds.
Colours are linear reflectances and radiances of red, green and blue (Rec. 709 primaries), with one of the
near infrared beside them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from arraygeom.runtime.atomic import write_text
from arraygeom.runtime.safe_yaml import dump_yaml

from ...support.schema import to_document

Vec3 = tuple[float, float, float]
Shape = Literal["plane", "cube", "sphere", "cylinder", "cone", "torus", "lathe", "room"]
TextureKind = Literal["plain", "voronoi", "magic", "brick", "checker", "noise", "wave", "image"]

FORMAT = "pat-scene 1"


@dataclass(frozen=True)
class Paint:
    """What a surface reflects, 0..1: linear red, green and blue, and near infrared."""

    rgb: Vec3
    nir: float


@dataclass(frozen=True, kw_only=True)
class Texture:
    """How paints are laid on a surface.

    Patterns live in the object's own coordinates in metres and have about `scale` features a metre; `offset`
    shifts them, `distortion` (0 to some) makes them irregular, `grain` (0..1) lays fine noise over them. They
    run through the `paints` in order. An "image" is a file (sRGB) whose width covers 1 / `scale` metres of
    the surface and which repeats beyond; it is multiplied by the first paint's colour. Its near infrared is
    its red plus 1.5 times by how much green exceeds red and blue (leaves), times the paint's.
    """

    kind: TextureKind = "plain"
    paints: tuple[Paint, ...] = (Paint((0.5, 0.5, 0.5), 0.5),)
    scale: float = 1.0
    offset: Vec3 = (0.0, 0.0, 0.0)
    distortion: float = 0.0
    grain: float = 0.0
    image: str = ""


@dataclass(frozen=True, kw_only=True)
class Material:
    """A surface: its texture and how it shines.

    `roughness`, `specular`, `metallic` and `transmission` are 0..1 as in Disney's principled model; `bump`
    metres of relief follow the texture in shading only; `emission` makes the surface shine its paint, unlit.
    """

    texture: Texture = field(default_factory=Texture)
    roughness: float = 0.6
    specular: float = 0.3
    metallic: float = 0.0
    transmission: float = 0.0
    bump: float = 0.0
    emission: float = 0.0


class ObjectPose(NamedTuple):
    """X_world = R diag(extent) X_object + position, for a shape that fills [-0.5, 0.5]^3."""

    R: Float[NDArray, "3 3"]
    position: Float[NDArray, "3"]
    extent: Float[NDArray, "3"]


@dataclass(frozen=True, kw_only=True)
class Key:
    """Where an object is at a time: middle's position, rotation vector (radians), extent along its axes."""

    position: Vec3
    rotation: Vec3 = (0.0, 0.0, 0.0)
    extent: Vec3 = (1.0, 1.0, 1.0)
    time: float = 0.0


@dataclass(frozen=True)
class Motion:
    """Keys in order of time. Between them positions and extents change evenly and rotations evenly about an
    axis; before the first and after the last nothing moves."""

    keys: tuple[Key, ...]

    def __post_init__(self) -> None:
        times = [k.time for k in self.keys]
        if not times or any(a >= b for a, b in pairwise(times)):
            raise ValueError(f"a motion needs keys whose times rise, got times {times}")

    def at(self, time: float) -> ObjectPose:
        """Where the object is at a time in seconds."""
        from scipy.spatial.transform import Rotation, Slerp  # here, as it takes .2 s to import

        times, rotations, positions, extents = (
            np.array([getattr(key, name) for key in self.keys], float)
            for name in ("time", "rotation", "position", "extent")
        )
        if len(times) == 1:
            return ObjectPose(Rotation.from_rotvec(rotations[0]).as_matrix(), positions[0], extents[0])
        turn = Slerp(times, Rotation.from_rotvec(rotations))(np.clip(time, times[0], times[-1]))
        position, extent = (
            np.array([np.interp(time, times, axis) for axis in values.T]) for values in (positions, extents)
        )
        return ObjectPose(turn.as_matrix(), position, extent)


@dataclass(frozen=True, kw_only=True)
class Relief:
    """Bumps and dents in the surface itself, `height` metres to both sides and about `size` metres across."""

    height: float
    size: float
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Object:
    """A shape with a material, and perhaps a relief.

    A "room" is a cube seen from inside; it casts no shadow. A "lathe" is the surface that `profile` sweeps
    around the y axis: from its top, pairs of a radius (0..0.5) and a y (-0.5..0.5). Object `i` of a scene has
    the index i + 1 in rendered index images.
    """

    name: str
    shape: Shape
    motion: Motion
    material: Material = field(default_factory=Material)
    relief: Relief | None = None
    profile: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        if (self.shape == "lathe") != (len(self.profile) > 1):
            raise ValueError(f"'{self.name}': a lathe, and nothing else, needs a profile of 2 points or more")


@dataclass(frozen=True, kw_only=True)
class Light:
    """A light. `power` is in watts ("sun": watts a square metre), for each of the colours times that colour.

    `direction` is where an area light or a sun shines to. `size` is the side of an area light or the radius
    of a point light in metres, and the angle of a sun in radians.
    """

    kind: Literal["area", "sun", "point"]
    power: float
    position: Vec3 = (0.0, 0.0, 0.0)
    direction: Vec3 = (0.0, 0.0, 1.0)
    rgb: Vec3 = (1.0, 1.0, 1.0)
    nir: float = 1.0
    size: float = 0.1


@dataclass(frozen=True)
class World:
    """Light from all directions that no object blocks: radiance of red, green, blue and near infrared."""

    rgb: Vec3 = (0.0, 0.0, 0.0)
    nir: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The content of a scene. `depth` is (near, far) in metres, `generator` and `seed` are its origin."""

    objects: tuple[Object, ...]
    lights: tuple[Light, ...] = ()
    world: World = World()
    depth: tuple[float, float] = (1.0, 20.0)
    generator: str = ""
    seed: int = 0

    def save(self, path: str | Path) -> None:
        """Write the scene to a YAML file, atomically, for the record."""
        document = {"format": FORMAT, **to_document(self)}
        write_text(path, dump_yaml(document, width=120, default_flow_style=None))
