"""A rendered scene on disk: images and ground truth of every camera, its rig, its description, its check.

A folder holds `rig.yaml` (the rig as rendered), `scene.yaml`, `render.json` (settings, versions, frames,
check) and one `<camera>-<frame>.npz` for every frame of every camera, with the arrays of `Frame` by name.
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

from arraygeom.rig import Rig
from arraygeom.runtime.atomic import flush
from arraygeom.sampling import sample

RENDER_FILE = "render.json"
"""The last file written: a folder that has it is complete."""


@dataclass(frozen=True, kw_only=True)
class RenderedFrame:
    """One image and its ground truth, at the pixels' centres.

    `rgb` is linear radiance (stored as float16, 1 is white by intent, brighter is possible), `nir` that of
    the near infrared. `depth` is z in metres (float32), infinite where nothing is. `index` is 0 where nothing
    is, else the object's number in the scene plus one. Pixels that a lens does not see have `depth` NaN and
    index 0.
    """

    time: float
    rgb: Float[Tensor, "3 h w"]
    depth: Float[Tensor, "h w"]
    index: Int[Tensor, "h w"]
    nir: Float[Tensor, "1 h w"] | None = None


@dataclass(frozen=True)
class Rendered:
    """A rendered folder. Images are read lazily."""

    folder: Path

    @cached_property
    def about(self) -> dict[str, Any]:
        """The content of `render.json`: `settings`, `versions`, `seconds`, `frames` and `check`."""
        return dict(json.loads((self.folder / RENDER_FILE).read_text(encoding="utf-8")))

    @cached_property
    def rig(self) -> Rig:
        """The cameras as rendered: sizes included, calibrated, with their lenses."""
        return Rig.load(self.folder / "rig.yaml")

    def frames(self, camera: str) -> int:
        """How many frames of a camera there are."""
        return len(self.about["frames"][self.rig.require(camera)])

    def frame(self, camera: str, number: int = 0) -> RenderedFrame:
        """One frame of a camera, as float32 (index: int64)."""
        entry = self.about["frames"][self.rig.require(camera)][number]
        with np.load(self.folder / entry["file"]) as arrays:
            kinds = {k: np.int64 if k == "index" else np.float32 for k in arrays}
            tensors = {k: torch.from_numpy(arrays[k].astype(kind)) for k, kind in kinds.items()}
        return RenderedFrame(time=entry["time"], **tensors)


_STORED = {"rgb": np.float16, "nir": np.float16, "index": np.uint16}
_MOST = 6e4


def save_frame(path: Path, frame: RenderedFrame) -> None:
    """Write the arrays of a frame, synced to disk."""
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
    """The name of a frame's file; the camera's number is in front where its name has odd characters."""
    plain = re.sub(r"[^A-Za-z0-9_.+]", "_", camera)
    same = plain == camera and not camera.startswith(".")
    return f"{plain if same else f'{rig.names.index(camera):02d}_{plain}'}-{number:04d}.npz"


def is_rendered(folder: str | Path) -> bool:
    """Whether a folder holds a complete rendered scene."""
    return (Path(folder) / RENDER_FILE).is_file()


UNEVEN = 0.001
"""Where allowed, interpolation is off by an eighth of this: a hundredth of a pixel at a disparity of 80."""


def depth_between(
    depth: Float[Tensor, "h w"],
    index: Int[Tensor, "h w"],
    x: Float[Tensor, "*n 2"],
    *,
    uneven: float = UNEVEN,
) -> tuple[Float[Tensor, "*n"], Bool[Tensor, "*n"]]:
    """Depth at positions (x, y), whether the four pixels around are of one object, no step or crease.

    Inverse depth is interpolated, which is exact on planes. Infinite depths stay infinite. More than `uneven`
    counts as a step or crease: how far, relatively, an inverse depth is from the middle of its neighbours'.
    """
    inverse = torch.where(depth.isfinite(), 1 / depth, 0.0).to(x)
    layers = torch.stack([inverse, index.to(x), *(b.to(x) for b in _creases(inverse, uneven))])[None]
    steps = x.new_tensor([[0, 0], [1, 0], [0, 1], [1, 1]]).reshape(4, *[1] * (x.ndim - 1), 2)
    corners = sample(layers, (x.floor() + steps)[None], interpolation="nearest").values[0]
    q, around, across, down = corners.unbind(0)
    flat = (across[0::2] * across[1::2] == 0).all(0) & (down[:2] * down[2:] == 0).all(0)
    clean = (around == around[:1]).all(0) & flat & ((q > 0) == (q[:1] > 0)).all(0)
    return 1 / sample(layers[:, :1], x[None]).values[0, 0], clean


def _creases(inverse: Float[Tensor, "h w"], uneven: float) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Creases and steps of inverse depth, along rows and columns. Between two such pixels is an edge."""
    across, down = torch.zeros_like(inverse, dtype=torch.bool), torch.zeros_like(inverse, dtype=torch.bool)
    across[:, 1:-1] = inverse.diff(n=2, dim=1).abs() > uneven * inverse[:, 1:-1]
    down[1:-1] = inverse.diff(n=2, dim=0).abs() > uneven * inverse[1:-1]
    return across, down
