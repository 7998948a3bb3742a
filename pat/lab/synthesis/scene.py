"""Description of a scene for any renderer: objects, materials, lights and motions, as frozen values.

The world is the rig's: metres, in the directions of the rig's `cam_from_world`; radians, seconds. Colours are
linear reflectances and radiances of red, green and blue (Rec. 709 primaries), with one of near infrared
beside them.
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
    """Reflectance of a surface, 0..1.

    Attributes:
        rgb: linear red, green and blue.
        nir: near infrared.
    """

    rgb: Vec3
    nir: float


@dataclass(frozen=True, kw_only=True)
class Texture:
    """Layout of paints on a surface.

    Attributes:
        kind: pattern, in the object's own coordinates (brick: along its surface), that runs through the
            paints in order; "plain", the first paint alone; or "image".
        paints: paints of a pattern; an image is multiplied by the first.
        scale: features of a pattern for each metre; an image's width covers 1 / scale metres and is mirrored
            beyond.
        offset: shift of the coordinates, in features of a pattern, in widths and heights of an image.
        distortion: irregularity of magic, noise and wave, 0 for none.
        grain: strength of fine noise, 0..1.
        image: sRGB file; its near infrared is red plus 1.5 times the excess of green over red and blue
            (leaves), at most 1, times the paint's.
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
    """Texture of a surface and its reflection; 0..1 as in Disney's principled model.

    Attributes:
        texture: colours.
        roughness: roughness.
        specular: specular level.
        metallic: share of metal.
        transmission: share of light passed through.
        bump: metres of relief that follow the pattern, in shading only; without effect for images.
        emission: strength of light in the paint's colour.
    """

    texture: Texture = field(default_factory=Texture)
    roughness: float = 0.6
    specular: float = 0.3
    metallic: float = 0.0
    transmission: float = 0.0
    bump: float = 0.0
    emission: float = 0.0


class ObjectPose(NamedTuple):
    """Pose of a shape that fills [-0.5, 0.5]^3: X_world = R diag(extent) X_object + position.

    Attributes:
        R: rotation from the object's axes to the world's.
        position: position of the middle, metres.
        extent: lengths along its axes, metres.
    """

    R: Float[NDArray, "3 3"]
    position: Float[NDArray, "3"]
    extent: Float[NDArray, "3"]


@dataclass(frozen=True, kw_only=True)
class Key:
    """Placement of an object at a time.

    Attributes:
        position: position of the middle, metres.
        rotation: vector of the rotation from the object's axes to the world's, radians.
        extent: lengths along its axes, metres.
        time: seconds.
    """

    position: Vec3
    rotation: Vec3 = (0.0, 0.0, 0.0)
    extent: Vec3 = (1.0, 1.0, 1.0)
    time: float = 0.0


@dataclass(frozen=True)
class Motion:
    """Keys of a motion; positions and extents change evenly between them, rotations evenly about an axis.

    Nothing moves before the first and after the last.

    Attributes:
        keys: keys in order of time.

    Raises:
        ValueError: for no keys, or times that do not rise.
    """

    keys: tuple[Key, ...]

    def __post_init__(self) -> None:
        times = [k.time for k in self.keys]
        if not times or any(a >= b for a, b in pairwise(times)):
            raise ValueError(f"a motion needs keys whose times rise, got times {times}")

    def at(self, time: float) -> ObjectPose:
        """Interpolate the object's pose at a time in seconds.

        Returns:
            The pose, float64.
        """
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
    """Bumps and dents of a surface.

    Attributes:
        height: amplitude to both sides, metres.
        size: typical width, metres.
        seed: random seed.
    """

    height: float
    size: float
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Object:
    """Shape with a material. Object `i` of a scene has the index i + 1 in rendered index images.

    Attributes:
        name: name in messages.
        shape: kind of shape; a "room" is a cube seen from inside and casts no shadow.
        motion: placement over time.
        material: its surface.
        relief: bumps of the surface; None for a smooth one.
        profile: points (radius 0..0.5, y -0.5..0.5), from the top, that a "lathe" sweeps around the y axis.

    Raises:
        ValueError: for a lathe without a profile of 2 points or more, and another shape with one.
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
    """Light source.

    Attributes:
        kind: "area", "sun" or "point".
        power: watts (sun: watts for each square metre) in each colour, times `rgb` or `nir`.
        position: world position, metres; without effect for a sun.
        direction: world direction that an area light or a sun shines to.
        rgb: relative power in red, green and blue.
        nir: relative power in near infrared.
        size: side of an area light or radius of a point light, metres; angle of a sun, radians.
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
    """Light that shines from all directions, and is the background.

    Attributes:
        rgb: radiance of red, green and blue.
        nir: radiance of near infrared.
    """

    rgb: Vec3 = (0.0, 0.0, 0.0)
    nir: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Content of a scene.

    Attributes:
        objects: objects.
        lights: light sources.
        world: light from all around.
        depth: (near, far) in metres, the range from the cameras that it is made for.
        generator: name of the generator that made it; empty if none.
        seed: seed that it was made from.
    """

    objects: tuple[Object, ...]
    lights: tuple[Light, ...] = ()
    world: World = World()
    depth: tuple[float, float] = (1.0, 20.0)
    generator: str = ""
    seed: int = 0

    def save(self, path: str | Path) -> None:
        """Write the scene to a YAML file, atomically, for the record; nothing reads it back.

        Raises:
            OSError: if it cannot be written.
        """
        document = {"format": FORMAT, **to_document(self)}
        write_text(path, dump_yaml(document, width=120, default_flow_style=None))
