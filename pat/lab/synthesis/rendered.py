"""Rendered scenes on disk: images and ground truth of every camera, rig, description, self-check.

A folder holds `rig.yaml` (the rig as rendered), `scene.yaml`, `render.json` (settings, versions, frames,
check) and one `<camera>-<frame>.npz` for every frame of every camera, with the arrays of `RenderedFrame` by
name.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from arraygeom import Rig, sample
from arraygeom.runtime.atomic import flush

RENDER_FILE = "render.json"
"""Last file written: a folder that has it is complete."""


@dataclass(frozen=True, kw_only=True)
class RenderedFrame:
    """One image with its ground truth, at the pixels' centres.

    Attributes:
        time: seconds.
        rgb: linear radiance, 1 is white, brighter is possible; stored as float16.
        depth: z in metres; infinite where nothing is hit, NaN where the lens sees nothing.
        index: number of the object or layer in the scene plus one; 0 where nothing is hit or seen.
        nir: linear radiance in near infrared; None if not rendered.
    """

    time: float
    rgb: Float[Tensor, "3 h w"]
    depth: Float[Tensor, "h w"]
    index: Int[Tensor, "h w"]
    nir: Float[Tensor, "1 h w"] | None = None


@dataclass(frozen=True)
class Rendered:
    """Rendered folder, read on demand; `about` and `rig` are kept once read.

    Attributes:
        folder: the folder.
    """

    folder: Path

    @cached_property
    def about(self) -> dict[str, Any]:
        """Content of `render.json`: `settings`, `versions`, `seconds` that rendering took, `frames` by camera
        (file and time of each) and `check`, the outcome of `check_views`.

        Raises:
            OSError: if it cannot be read.
            ValueError: if it is no JSON.
        """
        return dict(json.loads((self.folder / RENDER_FILE).read_text(encoding="utf-8")))

    @cached_property
    def rig(self) -> Rig:
        """Rig as rendered, calibrated, with sizes and lenses.

        Raises:
            FileNotFoundError: if the folder has no rig.yaml.
            ValueError: for a damaged rig.yaml.
        """
        return Rig.load(self.folder / "rig.yaml")

    def frames(self, camera: str) -> int:
        """Return the number of frames of a camera.

        Raises:
            ValueError: for an unknown camera.
        """
        return len(self.about["frames"][self.rig.require(camera)])

    def frame(self, camera: str, number: int = 0) -> RenderedFrame:
        """Read one frame of a camera.

        Args:
            number: number of the frame, from 0.

        Returns:
            The frame, float32 (index int64).

        Raises:
            ValueError: for an unknown camera, and a damaged rig.yaml.
            IndexError: for a `number` beyond its frames.
            OSError: if a file cannot be read; a damaged render.json or frame gives ValueError, BadZipFile,
                KeyError, TypeError and others.
        """
        entry = self.about["frames"][self.rig.require(camera)][number]
        with np.load(self.folder / entry["file"]) as arrays:
            kinds = {k: np.int64 if k == "index" else np.float32 for k in arrays}
            tensors = {k: torch.from_numpy(arrays[k].astype(kind)) for k, kind in kinds.items()}
        return RenderedFrame(time=entry["time"], **tensors)


_STORED = {"rgb": np.float16, "nir": np.float16, "index": np.uint16}
_MOST = 6e4


def save_frame(path: Path, frame: RenderedFrame) -> None:
    """Write the arrays of a frame (on the CPU, without gradient) to an .npz file in an existing folder.

    Synced to disk, not atomic. Colours are stored as float16, at most 60,000; object numbers as uint16; the
    time is not written.

    Raises:
        OSError: if it cannot be written.
    """
    arrays: dict[str, NDArray] = {}
    for name, value in vars(frame).items():
        if isinstance(value, Tensor):
            kind = _STORED.get(name, np.float32)
            array = value.numpy()
            arrays[name] = (np.minimum(array, _MOST) if kind == np.float16 else array).astype(kind)
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
    flush(path)


def frame_file(rig: Rig, camera: str, number: int = 0) -> str:
    """Return the name of a frame's file, such as `alpha-0000.npz`.

    Odd characters in the camera's name become _, and the camera's number in the rig stands in front.
    """
    plain = re.sub(r"[^A-Za-z0-9_.+]", "_", camera)
    same = plain == camera and not camera.startswith(".")
    return f"{plain if same else f'{rig.names.index(camera):02d}_{plain}'}-{number:04d}.npz"


def is_rendered(folder: str | Path) -> bool:
    """Return True if a folder holds a complete rendered scene."""
    return (Path(folder) / RENDER_FILE).is_file()


UNEVEN = 0.001
"""Relative second difference that counts as a crease: interpolation errs by up to an eighth of it."""


def depth_between(
    depth: Float[Tensor, "h w"],
    index: Int[Tensor, "h w"],
    x: Float[Tensor, "*n 2"],
    *,
    uneven: float = UNEVEN,
) -> tuple[Float[Tensor, "*n"], Bool[Tensor, "*n"]]:
    """Interpolate depth at positions (x, y), linearly in inverse depth, which is exact on planes.

    Args:
        depth: depth of the pixels, metres; infinite where nothing is hit, as which NaN counts.
        index: object index of each pixel.
        x: positions (x, y), pixels.
        uneven: relative second difference of inverse depth; two neighbours above it have an edge between.

    Returns:
        Depth (*n), infinite between infinite depths; and True on the image where the four pixels around are
        one object, or all hit nothing, without such an edge: elsewhere the depth may lie between two
        surfaces, and off the image it is infinite.
    """
    inverse = torch.where(depth.isfinite(), 1 / depth, 0.0).to(x)
    layers = torch.stack([inverse, index.to(x), *(b.to(x) for b in _creases(inverse, uneven))])[None]
    q, around, across, down = four_around(layers, x).unbind(0)
    flat = (across[0::2] * across[1::2] == 0).all(0) & (down[:2] * down[2:] == 0).all(0)
    clean = (around == around[:1]).all(0) & flat & ((q > 0) == (q[:1] > 0)).all(0)
    between, inside = sample(layers[:, :1], x[None])
    return 1 / between[0, 0], clean & inside[0]


def four_around(layers: Float[Tensor, "1 c h w"], x: Float[Tensor, "*n 2"]) -> Float[Tensor, "c 4 *n"]:
    """Sample the four pixels around positions (x, y): two above, two below, left before right.

    Returns:
        Values (c, 4, *n), 0 beyond the image.
    """
    steps = x.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]]).reshape(4, *[1] * (x.ndim - 1), 2)
    return sample(layers, (x.floor() + steps)[None], interpolation="nearest").values[0]


def _creases(inverse: Float[Tensor, "h w"], uneven: float) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Pixels at creases and steps of inverse depth, along rows and columns.

    Between two such pixels is an edge.
    """
    across, down = torch.zeros_like(inverse, dtype=torch.bool), torch.zeros_like(inverse, dtype=torch.bool)
    across[:, 1:-1] = inverse.diff(n=2, dim=1).abs() > uneven * inverse[:, 1:-1]
    down[1:-1] = inverse.diff(n=2, dim=0).abs() > uneven * inverse[1:-1]
    return across, down
