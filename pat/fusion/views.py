"""Images of a rig's cameras, read and developed once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from arraygeom import Rig

from ..media.images import check_size, read_image
from ..media.raw import develop, developed_rig


class Views(NamedTuple):
    """Images ready to fuse, and the rig that says so of them."""

    rig: Rig
    images: dict[str, Tensor]


class ViewFiles(Mapping[str, Tensor]):
    """An image file of each camera, read and developed when asked for, and not kept.

    Asking raises as `read_views` does.
    """

    def __init__(self, rig: Rig, files: Mapping[str, str | Path], *, alpha: str) -> None:
        self.rig, self.files, self.like = rig, files, rig[alpha].sensor

    def __iter__(self) -> Iterator[str]:
        return iter(self.files)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, name: str) -> Tensor:
        path, view = self.files[name], self.rig[name]
        image = read_image(path, name=name, bits=view.sensor.bits)
        check_size(image, view.hw, f"{name}: {path}")
        if view.sensor.bayer and image.shape[0] != 1:
            raise ValueError(f"{name}: {path}: is in colour, and the rig says raw {view.sensor.bayer}: drop 'bayer'")
        return develop(image, view.sensor, like=self.like)

    @property
    def developed(self) -> Rig:
        """The rig that says of the images what they are now."""
        return developed_rig(self.rig, self.files)


def read_views(rig: Rig, files: Mapping[str, str | Path], *, alpha: str) -> Views:
    """Read one image of each camera and develop it.

    Raises ValueError or FileNotFoundError naming the camera and the file for what cannot be read, has another size
    than the rig says, or is in colour where the rig says raw.
    """
    views = ViewFiles(rig, files, alpha=alpha)
    return Views(views.developed, dict(views))
