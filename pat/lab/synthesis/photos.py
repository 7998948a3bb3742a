"""Textures in memory, sampled at any position and level of detail.

Each is stored with its pyramid of 2x area averages as packed bytes (R + 256 G + 65536 B in one int32): one
gather fetches one texel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from zipfile import BadZipFile

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from arraygeom.runtime.atomic import write_atomically

from ...media.images import decoded_photograph
from ...media.suffixes import PHOTO_SUFFIXES
from ...support.folders import files_below
from .patterns import patterns, recoloured

LEVELS = 6
_MULTIPLE = 2 ** (LEVELS - 1)


class PhotoBank:
    """Textures of any sizes with their pyramids, on one device (the CPU, until `to`).

    Sides are cropped to multiples of 32, so that every level is a 2x average of the one below. `len(bank)` is
    the number of textures, `bank.photos` of photographs.

    Args:
        images: arrays (h, w, 3), uint8, RGB, with sides of 32 or more, which is not checked.
        photos: number of photographs, which come first; None counts all as photographs.

    Raises:
        ValueError: for no images.
    """

    def __init__(self, images: Iterable[np.ndarray], *, photos: int | None = None):
        levels = [_pyramid(_cropped(p)) for p in images]
        if not levels:
            raise ValueError("a PhotoBank needs at least one image")
        sizes = [[(p.shape[1], p.shape[0]) for p in pyramid] for pyramid in levels]
        counts = np.array([[w * h for w, h in pyramid] for pyramid in sizes])
        starts = np.concatenate([[0], counts.ravel().cumsum()[:-1]]).reshape(counts.shape)
        self.photos = len(levels) if photos is None else photos
        self.texels = torch.from_numpy(np.concatenate([_packed(p) for pyramid in levels for p in pyramid]))
        self.starts = torch.from_numpy(starts).int()
        self.wh = torch.tensor(sizes, dtype=torch.int32)

    @classmethod
    def load(
        cls,
        *folders: str | Path,
        max_edge: int = 1024,
        cache: str | Path | None = None,
        seed: int = 0,
        choose: Callable[[int], bool] = lambda i: True,
    ) -> PhotoBank:
        """Load the images under folders (`read_photographs`), followed by 48 patterns and 48 mixtures of the
        images taken (`recoloured`).

        Args:
            folders: folders, searched with their subfolders.
            max_edge: longest side in pixels that images are reduced to.
            cache: .npz file, written on the first call; once it exists it is read in place of the folders,
                whatever `max_edge` is. None for no cache.
            seed: seed of the patterns and mixtures.
            choose: called with an image's number, from 0 in the order of paths, returns True to take it.

        Raises:
            ValueError: if no image is found or chosen, and for a file that is no cache.
            OSError: if an image cannot be read, or the cache not written.
        """
        if cache and Path(cache).exists():
            images = _cached(Path(cache))
        else:
            images = read_photographs(folders, max_edge)
            if cache:
                with write_atomically(cache) as temporary, temporary.open("wb") as file:
                    np.savez(file, *images)
        chosen = [p for i, p in enumerate(images) if choose(i)]
        if not chosen:
            raise ValueError(f"{len(images)} photographs are too few to learn from and hold out: give more")
        rng = np.random.default_rng(seed)
        return cls(chosen + patterns(rng, 48) + recoloured(chosen, rng, 48), photos=len(chosen))

    def __len__(self) -> int:
        return len(self.wh)

    def to(self, device: torch.device | str) -> PhotoBank:
        """Return the same bank on a device."""
        moved = object.__new__(PhotoBank)
        moved.photos = self.photos
        moved.texels, moved.starts, moved.wh = (x.to(device) for x in (self.texels, self.starts, self.wh))
        return moved

    def lookup(
        self, texture: Int[Tensor, " n"], xy: Float[Tensor, "n 2"], level: Float[Tensor, " n"]
    ) -> Float[Tensor, "3 n"]:
        """Sample colours trilinearly in position and level.

        Args:
            texture: numbers of textures.
            xy: pixels of the full texture, first centre (0, 0), mirrored beyond the sides.
            level: log2 of the distance between samples in pixels of the full texture, clipped to 0..5: 0
                reads the full image, 1 its 2x reduction, whose pixel (0, 0) lies at (0.5, 0.5) of the full.

        Returns:
            Colours (3, n), 0..1, without gradient with respect to the texels.

        Raises:
            IndexError: for a number beyond the textures.
        """
        level = level.clamp(0, LEVELS - 1)
        fine = level.floor().clamp(max=LEVELS - 2)
        weight = level - fine
        index = texture.long() * LEVELS + fine.long()
        scale = torch.exp2(-fine)
        half_pixel = xy.mT + 0.5
        low = self._bilinear(index, half_pixel * scale - 0.5)
        return torch.lerp(low, self._bilinear(index + 1, half_pixel * (0.5 * scale) - 0.5), weight)

    def window(self, texture: int, level: int, xy: tuple[int, int], side: int) -> Float[Tensor, "3 n n"]:
        """Cut a square from one level of a texture, mirrored beyond its sides.

        Args:
            level: level of its pyramid, 0 for the full image, at most 5.
            xy: first pixel (x, y) of the square, may lie outside.
            side: side of the square, pixels of that level.

        Returns:
            Colours (3, side, side), 0..1.

        Raises:
            IndexError: for a number or level beyond the last.
        """
        w, h = self.wh[texture, level].tolist()
        x, y = (_mirrored(start + torch.arange(side), torch.tensor(n)) for start, n in zip(xy, (w, h)))
        return self._fetch(int(self.starts[texture, level]) + w * y[:, None] + x)

    def _bilinear(self, index: Tensor, xy: Tensor) -> Tensor:
        """Colours at positions (2, n) of the level with flat index."""
        start = self.starts.view(-1)[index]
        w, h = self.wh.view(-1, 2)[index].unbind(-1)
        corner = xy.floor()
        fx, fy = xy - corner
        x0, y0 = corner.int()
        columns = _mirrored(x0, w), _mirrored(x0 + 1, w)
        rows = start + w * _mirrored(y0, h), start + w * _mirrored(y0 + 1, h)
        top, bottom = (torch.lerp(self._fetch(r + columns[0]), self._fetch(r + columns[1]), fx) for r in rows)
        return torch.lerp(top, bottom, fy)

    def _fetch(self, index: Tensor) -> Tensor:
        packed = self.texels[index]
        return torch.stack([packed & 255, (packed >> 8) & 255, packed >> 16]).float().mul_(1 / 255)


def _mirrored(i: Tensor, n: Tensor) -> Tensor:
    """Fold indices into 0 .. n - 1 by reflection at the edges: ... 1 0 | 0 1 ... n-1 | n-1 ..."""
    period = 2 * n
    i = i - period * torch.div(i.float(), period.float()).floor().int()
    i = torch.where(i < n, i, period - 1 - i)
    return torch.minimum(i.clamp_(min=0), n - 1)


def _cached(file: Path) -> list[np.ndarray]:
    """Read the images of a cache. Raises ValueError, naming the file, for a damaged or another file."""
    try:
        with np.load(file) as archive:
            return list(archive.values())
    except (BadZipFile, AttributeError, EOFError, OSError, TypeError, ValueError) as error:
        raise ValueError(f"{file}: not a cache of photographs ({error}): remove it") from None


def read_photographs(folders: tuple[str | Path, ...], max_edge: int) -> list[np.ndarray]:
    """Read all photographs (`PHOTO_SUFFIXES`) in folders and their subfolders, reduced to `max_edge` pixels
    on the longest side (but no side under 32).

    Returns:
        Arrays (h, w, 3), uint8, RGB (equal for grey), in the order of all folders' paths; files that
        `decoded_photograph` does not decode, or have a side under 32 pixels, are skipped.

    Raises:
        ValueError: if none is found, as under a missing folder.
        OSError: if a file cannot be read.
    """
    paths = sorted(p for folder in folders for p in files_below(folder) if p.suffix.lower() in PHOTO_SUFFIXES)
    images = [_reduced(p, max_edge) for p in map(_decoded, paths) if p is not None]
    if not images:
        raise ValueError(f"no image found under {', '.join(map(str, folders)) or 'no folder'}")
    return images


def _decoded(path: Path) -> np.ndarray | None:
    """RGB bytes; None for a file that is no image, or too small or large for a texture."""
    image = decoded_photograph(path, cv2.IMREAD_COLOR, least=_MULTIPLE)
    if image is None or min(image.shape[:2]) < _MULTIPLE:
        return None
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _reduced(image: np.ndarray, max_edge: int) -> np.ndarray:
    h, w = image.shape[:2]
    s = max_edge / max(h, w)
    if s >= 1:
        return image
    size = (max(round(w * s), _MULTIPLE), max(round(h * s), _MULTIPLE))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _cropped(image: np.ndarray) -> np.ndarray:
    h, w = (n // _MULTIPLE * _MULTIPLE for n in image.shape[:2])
    return image[:h, :w]


def _pyramid(image: np.ndarray) -> list[np.ndarray]:
    exact = [image.astype(np.float32)]
    for _ in range(LEVELS - 1):
        h, w = exact[-1].shape[:2]
        exact.append(exact[-1].reshape(h // 2, 2, w // 2, 2, 3).mean((1, 3)))
    return [(p + 0.5).astype(np.uint8) for p in exact]


def _packed(image: np.ndarray) -> np.ndarray:
    r, g, b = np.moveaxis(image.reshape(-1, 3).astype(np.int32), -1, 0)
    return r | g << 8 | b << 16
