"""Images of one camera in the order of time: read when they are asked for, cached, denoised."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from torch import Tensor

from arraygeom import Rig

from ..sensors import NoiseLevel
from .low_light import noisy_view
from .views import read_view

CACHED = 96 * 2**20
"""Bytes of images cached per camera: 25 grey frames of 1280x800."""


@runtime_checkable
class Frames(Protocol):
    """Images (C, H, W), 0..1, of one camera in the order of time: a list, or read on access: `ImageFiles`."""

    def __len__(self) -> int:
        """Return the number of images."""
        ...

    def __getitem__(self, i: int, /) -> Tensor:
        """Return image `i`."""
        ...


class ImageFiles:
    """Image files of one camera, read and developed on access, with the errors of `read_view` and of lists.

    Args:
        paths: files, in the order of time.
        rig: the cameras.
        name: name of the camera.
        alpha: camera to whose scale of light the images are brought.

    Raises:
        ValueError: for an `alpha` that the rig lacks.
    """

    def __init__(self, paths: Sequence[Path], rig: Rig, name: str, *, alpha: str) -> None:
        self.paths, self.name = list(paths), name
        self.rig, self.like = rig, rig[alpha].sensor

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, i: int, /) -> Tensor:
        """Read and develop image `i`.

        Raises:
            FileNotFoundError: for a missing file, with camera and file.
            ValueError: for a file that cannot be read or does not fit the rig, with camera and file.
        """
        return read_view(self.rig, self.name, self.paths[i], like=self.like)


class CachedFrames:
    """Frames with a cache of the last used ones, up to `CACHED` bytes or one image.

    An image is the cached tensor itself, or that of `frames`, not to be changed in place.

    Args:
        frames: images of one camera.
        level: noise level of the images, which are then denoised if it is noticeable; None leaves them.
    """

    def __init__(self, frames: Frames, level: NoiseLevel | None = None) -> None:
        self.frames, self.level = frames, level
        self.cached: OrderedDict[int, Tensor] = OrderedDict()

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, i: int, /) -> Tensor:
        if i not in self.cached:
            image = self.frames[i]
            view = None if self.level is None else noisy_view(image, self.level)
            self.cached[i] = image if view is None else view.denoised[0]
        self.cached.move_to_end(i)
        while len(self.cached) > 1 and sum(image.nbytes for image in self.cached.values()) > CACHED:
            self.cached.popitem(last=False)
        return self.cached[i]
