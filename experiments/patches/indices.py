"""The paper's index files: for every alpha pixel, the beta pixels it attends to, precomputed on disk.

`xxs_ID.npy` holds rows and `yys_ID.npy` columns, or `xxs_ID_k.npy` and `yys_ID_k.npy` for the k-th of several
betas: whole numbers (int16), counted from 0, one line for each alpha pixel, row by row, with n entries each,
(h w, n). Their F was exported from MATLAB, whose pixels count from 1. How the paper fills lines with fewer
than n pixels is not documented; here they repeat their first pixel, and lines without any hold -1. For
comparison only.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from arraygeom.atomic import write_atomically
from arraygeom.pixels import HW
from arraygeom.segments import Positions


def index_files(folder: str | Path, name: str, beta: int | None = None) -> tuple[Path, Path]:
    """The files of rows and of columns."""
    end = f"{name}.npy" if beta is None else f"{name}_{beta}.npy"
    return Path(folder) / f"xxs_{end}", Path(folder) / f"yys_{end}"


def read_indices(folder: str | Path, name: str, hw: HW, *, beta: int | None = None) -> Positions:
    """Positions (h, w, n, 2), x before y, for an alpha of height and width `hw`.

    Raises FileNotFoundError, and ValueError for files that are not as documented.
    """
    rows, columns = (_read(file, hw) for file in index_files(folder, name, beta))
    if rows.shape != columns.shape:
        raise ValueError(
            f"{folder}: rows of '{name}' have shape {rows.shape} and "
            f"columns {columns.shape}: not of one field"
        )
    xy = torch.from_numpy(np.stack([columns, rows], -1).astype(np.float32)).unflatten(0, hw)
    mask = (xy >= 0).all(-1)
    return Positions(torch.where(mask[..., None], xy, 0.0), mask)


def write_indices(
    folder: str | Path, name: str, positions: Positions, *, beta: int | None = None
) -> list[Path]:
    """Write both files, each atomically; returns their paths.

    Raises ValueError for positions (h, w, n, 2) that are not whole pixels, or beyond what int16 holds.
    """
    xy, mask = positions.xy, positions.mask
    if xy.ndim != 4:
        raise ValueError(
            f"index files need the field of every alpha pixel, (h, w, n, 2); got {tuple(xy.shape)}"
        )
    if not torch.equal(xy, xy.round()) or xy.abs().max() > np.iinfo(np.int16).max:
        raise ValueError("index files hold whole pixels up to 32767: use a field such as NearestVoxels")
    filled = torch.where(mask[..., None], xy, _first(xy, mask))
    written = list(index_files(folder, name, beta))
    for file, axis in zip(written, (1, 0)):
        with write_atomically(file) as temporary:
            np.save(temporary, filled[..., axis].flatten(0, 1).numpy().astype(np.int16))
    return written


def agreement(one: Positions, other: Positions) -> Float[Tensor, "h w"]:
    """For each alpha pixel, how many pixels two fields share over how many either has (1 if none)."""
    a, b = (_keys(p) for p in (one, other))
    common = (a[..., :, None] == b[..., None, :]).any(-1) & (a >= 0)
    both = common.sum(-1)
    either = (a >= 0).sum(-1) + (b >= 0).sum(-1) - both
    return torch.where(either > 0, both / either.clamp(min=1), 1.0)


def _keys(positions: Positions) -> Tensor:
    """One number for every pixel, each once, -1 for the others."""
    keys = positions.xy[..., 1].long() * (1 << 20) + positions.xy[..., 0].long()
    keys = torch.where(positions.mask, keys, -1).sort(-1).values
    again = torch.nn.functional.pad(keys.diff(dim=-1) == 0, (1, 0))
    return torch.where(again, -1, keys)


def _first(xy: Tensor, mask: Tensor) -> Tensor:
    """The first pixel that counts (h, w, 1, 2), -1 where there is none."""
    index = mask.int().argmax(-1)[..., None, None].expand(*xy.shape[:2], 1, 2)
    return torch.where(mask.any(-1)[..., None, None], xy.gather(2, index), -1.0)


def _read(file: Path, hw: HW) -> NDArray:
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such index file")
    try:
        values = np.load(file)
    except (ValueError, EOFError, OSError) as error:
        raise ValueError(f"{file}: not a NumPy file ({error})") from None
    if values.ndim != 2 or not np.issubdtype(values.dtype, np.integer):
        raise ValueError(
            f"{file}: holds {values.dtype} of shape {values.shape}; wanted whole numbers, (h w, n)"
        )
    if len(values) != hw[0] * hw[1]:
        raise ValueError(
            f"{file}: has {len(values)} lines; an alpha of {hw[1]}x{hw[0]} pixels has {hw[0] * hw[1]}"
        )
    return values
