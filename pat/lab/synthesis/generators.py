"""Scene generators: the paper's abstract scenes, and scenes textured with photographs."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.random import Generator

from arraygeom.rig import Rig
from arraygeom.runtime.extras import imported

from ...media.colour import linear_from_srgb
from ...media.images import decoded_photograph
from ...media.suffixes import PHOTO_SUFFIXES
from ...support.folders import files_below
from .furnish import Setting, furnished, vec
from .scene import Paint, Scene, Texture, TextureKind, Vec3


def abstract(seed: int, rig: Rig, *, moving: float = 0.0) -> Scene:
    """Generate one of the paper's scenes: 10 to 20 patterned shapes in a room, in the rig's depth range as
    `furnished` says.

    Args:
        seed: random seed, 0 or more.
        rig: rig that sees the scene; `furnish.DEPTHS` serves without a depth range, 10 near for infinite far.
        moving: seconds for which objects move, rotate and stretch along random paths; 0 for none.

    Returns:
        The scene, the same for the same arguments; fewer shapes if they do not fit.

    Raises:
        ValueError: as `furnished`.
    """
    return furnished("abstract", seed, rig, _pattern, moving)


def photographs(seed: int, rig: Rig, folder: str | Path, *, moving: float = 0.0) -> Scene:
    """Generate a scene like `abstract`, with the images under a folder on all surfaces.

    Args:
        seed: random seed, 0 or more.
        rig: rig that sees the scene.
        folder: folder of images, searched with its subfolders, once for the process; dark ones are avoided.
        moving: seconds for which objects move; 0 for none.

    Returns:
        The scene, the same for the same arguments and images.

    Raises:
        ValueError: for a missing folder, one without images, and as `furnished`.
        OSError: for an image that cannot be read.
    """
    files = _images(Path(folder))

    def image(setting: Setting, depth: float, kinds: tuple[TextureKind, ...]) -> Texture:
        rng, tint = setting.rng, float(setting.rng.uniform(0.75, 1.0))
        width = setting.metres(depth, rng.uniform(150, 400))
        paints = (Paint((tint, tint, tint), float(rng.uniform(0.8, 1.0))),)
        shift = (float(rng.uniform()), float(rng.uniform()), 0.0)
        file = _bright_one(rng, files)
        return Texture(kind="image", image=file, scale=1 / width, paints=paints, offset=shift)

    return furnished("photographs", seed, rig, image, moving)


def generator_named(name: str) -> Callable[..., Scene]:
    """Look up a scene generator: "abstract", "photographs", or your own "module:function".

    Returns:
        The function (your own is not checked to be one), called with seed, rig and `moving` seconds;
        "photographs" needs `folder` too.

    Raises:
        ValueError: for a name that is neither, or cannot be imported.
    """
    ours: dict[str, Callable[..., Scene]] = {"abstract": abstract, "photographs": photographs}
    if name not in ours and ":" not in name:
        raise ValueError(f"no generator is called '{name}': use abstract, photographs or MODULE:FUNCTION")
    return ours.get(name) or imported(name, "generator")


# Surfaces ---------------------------------------------------------------------------------------------------


def _pattern(setting: Setting, depth: float, kinds: tuple[TextureKind, ...]) -> Texture:
    rng = setting.rng
    feature = setting.metres(depth, math.exp(rng.uniform(math.log(10), math.log(50))))
    return Texture(
        kind=kinds[int(rng.integers(len(kinds)))],
        paints=paints(rng),
        scale=1 / feature,
        offset=vec(rng.uniform(-50, 50, 3)),
        distortion=float(rng.choice([0.0, rng.uniform(0.5, 4)])),
        grain=float(rng.uniform(0.1, 0.4)),
    )


def paints(rng: Generator) -> tuple[Paint, ...]:
    """Draw the paints of a pattern, alternately lighter and darker, of similar hues or not.

    Returns:
        Two to four paints.
    """
    hue, width, dark_first = rng.uniform(), rng.choice([0.08, 0.5]), int(rng.integers(2))
    paints = []
    for i in range(int(rng.integers(2, 5))):
        value = rng.uniform(0.25, 0.5) if (i + dark_first) % 2 else rng.uniform(0.6, 0.95)
        encoded = colorsys.hsv_to_rgb((hue + rng.uniform(-width, width)) % 1, rng.uniform(0.1, 0.9), value)
        r, g, b = linear_from_srgb(torch.tensor(encoded, dtype=torch.float64)).tolist()
        paints.append(Paint((r, g, b), _near_infrared(rng, (r, g, b))))
    return tuple(paints)


def _near_infrared(rng: Generator, rgb: Vec3) -> float:
    """Near-infrared reflectance of a dye, a pigment, a leaf, or soot."""
    r, g, b = rgb
    if g > 1.2 * max(r, b):
        return float(rng.uniform(0.4, 0.6))
    kind = rng.choice(["dye", "pigment", "soot"], p=[0.5, 0.4, 0.1])
    if kind == "dye":
        return float(rng.uniform(0.45, 0.8))
    if kind == "soot":
        return float(rng.uniform(0.03, 0.1))
    return float(np.clip(r * rng.uniform(0.8, 1.2), 0.02, 0.9))


@lru_cache(maxsize=8)
def _images(folder: Path) -> tuple[str, ...]:
    files = sorted(str(p.resolve()) for p in files_below(folder) if p.suffix.lower() in PHOTO_SUFFIXES)
    if not files:
        raise ValueError(f"{folder}: no images ({', '.join(sorted(PHOTO_SUFFIXES))}) under this folder")
    return tuple(files)


def _bright_one(rng: Generator, files: tuple[str, ...]) -> str:
    """Draw an image, preferably not one that is black in large parts."""
    drawn = [str(rng.choice(files)) for _ in range(8)]
    return next((file for file in drawn if _blackness(file) < 0.3), drawn[0])


@lru_cache(maxsize=4096)
def _blackness(file: str) -> float:
    """Share of nearly black pixels; 1 for a file that is no image, or too large."""
    small = decoded_photograph(Path(file), cv2.IMREAD_REDUCED_GRAYSCALE_8)
    return 1.0 if small is None else float((small < 24).mean())
