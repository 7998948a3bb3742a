"""Pairs rendered by Blender: rooms of large, small and thin things, many of them hardly textured.

They have what photographs cut into surfaces lack: what is hidden is truly there, surfaces are slanted and
curved, light and shadow fall on plain walls, and what shines looks different from beside.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arraygeom import Camera, Pose, Rig, intrinsics
from pat.data.pairs import Disparity, StereoPair
from pat.media.colour import srgb_from_linear
from pat.synthesis.blender import RenderSettings, render
from pat.synthesis.furnish import Setting, Surface, furnished, seeded, vec
from pat.synthesis.generators import paints
from pat.synthesis.rendered import RenderedFrame
from pat.synthesis.scene import Key, Material, Motion, Object, Paint, Scene, Shape, Texture, TextureKind

from .pairs import HW, MARGIN, MOST

BASELINE = 0.1
"""Metres between the cameras."""
SETTINGS = RenderSettings(threads=1)


class Thing(NamedTuple):
    """A kind of small things: its shape, and the least and most pixels that it is thick and long."""

    shape: Shape
    thick: tuple[float, float]
    long: tuple[float, float]


SMALL = (
    Thing("cube", (6, 30), (6, 60)),
    Thing("sphere", (6, 30), (6, 30)),
    Thing("cylinder", (6, 25), (10, 80)),
    Thing("cone", (6, 25), (10, 60)),
)
THIN = (Thing("cylinder", (1, 5), (30, 220)), Thing("plane", (4, 16), (20, 80)))


def room_pair(photos: Sequence[Path], seed: int) -> StereoPair:
    """A rendered pair with its true disparity; all that is drawn depends on the seed alone.

    An odd seed gives the mirror image of the pair before, right as alpha. Raises ValueError for a photograph
    that is no image, and where there is no Blender.
    """
    alpha, beta, focal = _rendered(tuple(photos), seed // 2)
    if seed % 2:
        alpha, beta = beta, alpha
    truth = torch.where(alpha.index > 0, focal * BASELINE / alpha.depth, 0.0)
    images = (srgb_from_linear(view.rgb.clamp(0, 1)) for view in (alpha, beta))
    one, two, truth = (x.flip(-1) if seed % 2 else x for x in (*images, truth))
    return StereoPair(f"room {seed}", one, two, MOST + MARGIN, Disparity(truth, truth > 0))


@lru_cache(maxsize=1)
def _rendered(photos: tuple[Path, ...], seed: int) -> tuple[RenderedFrame, RenderedFrame, float]:
    """Left, right and the focal length in pixels; of left, one value in 20 is brighter than .6 to 1.1."""
    rng = seeded("pair of a room", seed)
    focal, most = rng.uniform(1, 2.5) * HW[1], rng.uniform(25, MOST - 5)
    rig = rectified_rig(focal, most, rng.uniform(2, 0.4 * most))
    with TemporaryDirectory() as folder:
        made = render(room(rng, rig, photos, seed), rig, Path(folder) / "room", settings=SETTINGS)
        left, right = (made.frame(name) for name in rig.names)
    bright = rng.uniform(0.6, 1.1) / left.rgb.flatten().quantile(0.95).clamp(min=0.05)
    left, right = (replace(view, rgb=bright * view.rgb) for view in (left, right))
    return left, right, focal


def rectified_rig(focal: float, most: float, least: float) -> Rig:
    """Two cameras beside each other, with the depths of these disparities."""
    K, R = intrinsics(focal, HW), torch.eye(3, dtype=torch.float64)
    places = {"left": 0.0, "right": BASELINE}
    cameras = {
        name: Camera(K=K, cam_from_world=Pose.from_centre(R, K.new_tensor([x, 0, 0])), hw=HW)
        for name, x in places.items()
    }
    return Rig(cameras=cameras, depth=(focal * BASELINE / most, focal * BASELINE / least))


def room(rng: Generator, rig: Rig, photos: Sequence[Path], seed: int) -> Scene:
    """What is in a room: large shapes, small ones, and bunches of thin ones."""
    few = [str(photos[i].resolve()) for i in rng.integers(len(photos), size=8)]
    plain = rng.uniform(0.1, 0.6)

    def surface(setting: Setting, depth: float, kinds: tuple[TextureKind, ...]) -> Texture:
        """A photograph, a pattern, or nearly nothing."""
        drawn = setting.rng.uniform()
        if drawn < plain:
            return _plain(setting, depth)
        return _pattern(setting, depth, kinds) if drawn < plain + 0.12 else _photograph(setting, depth, few)

    scene = furnished("room", seed, rig, surface, 0.0)
    setting = Setting(rig, rng)
    things = [*_scattered(setting, surface), *_bunches(setting, surface)]
    return replace(scene, objects=(*things, *scene.objects))


def _plain(setting: Setting, depth: float) -> Texture:
    """One paint with slow, weak variation."""
    rng = setting.rng
    one = paints(rng)[0]
    other = Paint(vec(np.array(one.rgb) * rng.uniform(0.8, 1.1, 3).clip(0, 1)), one.nir)
    return Texture(
        kind="noise",
        paints=(one, other),
        scale=1 / setting.metres(depth, rng.uniform(40, 300)),
        offset=vec(rng.uniform(-50, 50, 3)),
        grain=0.03 * int(rng.integers(2)),
    )


def _pattern(setting: Setting, depth: float, kinds: tuple[TextureKind, ...]) -> Texture:
    rng = setting.rng
    return Texture(
        kind=kinds[int(rng.integers(len(kinds)))],
        paints=paints(rng),
        scale=1 / setting.metres(depth, float(np.exp(rng.uniform(np.log(5), np.log(50))))),
        offset=vec(rng.uniform(-50, 50, 3)),
        grain=float(rng.uniform(0, 0.3)),
    )


def _photograph(setting: Setting, depth: float, files: Sequence[str]) -> Texture:
    """One of the files, in a fifth of the cases seen through a colour."""
    rng = setting.rng
    return Texture(
        kind="image",
        image=files[int(rng.integers(len(files)))],
        scale=1 / setting.metres(depth, float(np.exp(rng.uniform(np.log(80), np.log(600))))),
        paints=(paints(rng)[0] if rng.uniform() < 0.2 else Paint((1.0, 1.0, 1.0), 1.0),),
        offset=(float(rng.uniform()), float(rng.uniform()), 0.0),
    )


def _scattered(setting: Setting, surface: Surface) -> Iterator[Object]:
    """Small things anywhere."""
    rng = setting.rng
    for i in range(int(rng.integers(0, 25))):
        depth = _depth(setting)
        where = setting.ahead(setting.camera(), rng.uniform(-1, 1, 2), depth)
        thing = SMALL[int(rng.integers(len(SMALL)))]
        yield _object(
            setting, f"small{i}", thing, where, depth, surface(setting, depth, ("noise", "checker"))
        )


def _bunches(setting: Setting, surface: Surface) -> Iterator[Object]:
    """Thin things about as far away as one another, of a surface or two."""
    rng = setting.rng
    for bunch in range(int(rng.integers(0, 4))):
        depth = _depth(setting)
        middle = rng.uniform(-0.8, 0.8, 2)
        kind = THIN[int(rng.integers(len(THIN)))]
        looks = [surface(setting, depth, ("noise", "wave")) for _ in range(2)]
        for i in range(int(rng.integers(2, 16))):
            where = setting.ahead(
                setting.camera(), middle + rng.normal(0, 0.2, 2), depth * rng.uniform(0.9, 1.1)
            )
            yield _object(setting, f"thin{bunch}-{i}", kind, where, depth, looks[i % 2])


def _depth(setting: Setting) -> float:
    """Even in disparity, a little inside of the range."""
    return float(1 / setting.rng.uniform(1.1 / setting.far, 0.9 / setting.near))


def _object(
    setting: Setting, name: str, thing: Thing, where: NDArray, depth: float, texture: Texture
) -> Object:
    """A thing of random size; flat ones face the cameras more or less, others anywhere."""
    rng, flat = setting.rng, thing.shape == "plane"
    thick, long = (setting.metres(depth, float(rng.uniform(*most))) for most in (thing.thick, thing.long))
    extent = (thick, max(thick, long), thick * (0.01 if flat else float(rng.uniform(0.7, 1))))
    anywhere = Rotation.random(random_state=rng).as_rotvec()
    rotation = vec(np.radians(rng.normal(0, [35, 35, 60])) if flat else anywhere)
    key = Key(position=vec(where), rotation=rotation, extent=extent)
    shine = {"roughness": float(rng.uniform(0.3, 1)), "specular": float(rng.uniform(0, 0.5))}
    return Object(
        name=name, shape=thing.shape, motion=Motion((key,)), material=Material(texture=texture, **shine)
    )
