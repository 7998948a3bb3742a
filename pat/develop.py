"""Pictures as cameras record them -> pictures to fuse: what the rig says of counts, filters, exposure and coding.

Pictures to fuse are coded as sRGB, on alpha's scale of light: where exposures and gains are known, a surface has one
value in all of them. Ordinary pictures, of which the rig says nothing, pass as they are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom import Rig, Sensor

from .images import read_image
from .sensors import Coded, Linear


class Views(NamedTuple):
    """Pictures ready to fuse, and the rig that says so of them."""

    rig: Rig
    images: dict[str, Tensor]


class ViewFiles(Mapping[str, Tensor]):
    """A picture file of each camera, read and developed when asked for, and not kept.

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
        picture = read_image(path, name=name, bits=view.sensor.bits)
        check_size(picture, view.hw, f"{name}: {path}")
        if view.sensor.bayer and picture.shape[0] != 1:
            raise ValueError(f"{name}: {path}: is in colour, and the rig says raw {view.sensor.bayer}: drop 'bayer'")
        return develop(picture, view.sensor, like=self.like)

    @property
    def developed(self) -> Rig:
        """The rig that says of the pictures what they are now."""
        rig = self.rig
        for name in self.files:
            rig = rig.with_camera(name, rig[name].replace(sensor=developed(rig[name].sensor)))
        return rig


def read_views(rig: Rig, files: Mapping[str, str | Path], *, alpha: str) -> Views:
    """Read one picture of each camera and develop it.

    Raises ValueError or FileNotFoundError naming the camera and the file for what cannot be read, has another size
    than the rig says, or is in colour where the rig says raw.
    """
    views = ViewFiles(rig, files, alpha=alpha)
    return Views(views.developed, dict(views))


def check_size(picture: Float[Tensor, "c h w"], hw: tuple[int, int], label: str) -> None:
    """Raises ValueError unless the picture has this height and width."""
    if tuple(picture.shape[1:]) != hw:
        got, wanted = (f"{w}x{h}" for h, w in (picture.shape[1:], hw))
        raise ValueError(f"{label}: is {got}, the rig says {wanted}: resize the rig, or give the right picture")


def develop(picture: Float[Tensor, "c h w"], sensor: Sensor, *, like: Sensor | None = None) -> Float[Tensor, "c2 h w"]:
    """The picture coded as sRGB: black level off, colours from the filter pattern, light on `like`'s scale.

    `picture` holds counts over 2^bits - 1. Values stay above 0, and exceed 1 where `sensor` saw more light than white
    is on `like`'s scale. The exposure counts only where both are known.
    """
    factor = _light(sensor, like or sensor)
    if sensor.black_level:
        black = sensor.black_level / (2.0 ** (sensor.bits or 16) - 1)
        picture = ((picture - black) / (1 - black)).clamp(min=0)
    if sensor.bayer:
        picture = demosaiced(picture, sensor.bayer)
    if factor == (1.0, 1.0, 1.0):
        return _coded(picture) if sensor.coding == "linear" else picture
    linear = picture if sensor.coding == "linear" else _linear(picture)
    scale = linear.new_tensor(factor if len(linear) == 3 else factor[1:2])
    return _coded(linear * scale[:, None, None])


def developed(sensor: Sensor) -> Sensor:
    """What is true of a camera's pictures once they are developed: values are sRGB, counts and filters are gone."""
    return dataclasses.replace(sensor, coding="srgb", bayer=None, bits=None, black_level=0.0, gain=1.0)


def demosaiced(raw: Float[Tensor, "1 h w"], pattern: str) -> Float[Tensor, "3 h w"]:
    """Colours of a raw picture behind a colour filter mosaic, interpolated along edges (OpenCV, in 16 bits)."""
    code = getattr(cv2, f"COLOR_Bayer{pattern}2RGB_EA")
    counts = np.rint(raw[0].clamp(0, 1).numpy().astype(np.float64) * 65535).astype(np.uint16)
    colours = cv2.demosaicing(counts, code).astype(np.float32) / np.float32(65535)
    return torch.from_numpy(colours).movedim(-1, 0).contiguous().to(raw)


def light_of(sensor: Sensor, like: Sensor) -> float:
    """The value (0..1 is up to white) that `sensor` gives to light that is 1 on `like`'s scale, in grey or green."""
    return 1 / _light(sensor, like)[1]


def _light(sensor: Sensor, like: Sensor) -> tuple[float, float, float]:
    """What to multiply linear red, green and blue with; a grey picture takes the middle one."""
    both = sensor.exposure is not None and like.exposure is not None
    exposure = like.exposure / sensor.exposure if both and like.exposure and sensor.exposure else 1.0
    wanted = _gains(like)[1]
    r, g, b = (exposure * wanted / gain for gain in _gains(sensor))
    return r, g, b


def _gains(sensor: Sensor) -> tuple[float, float, float]:
    return sensor.gain if isinstance(sensor.gain, tuple) else (sensor.gain,) * 3


def _coded(linear: Tensor) -> Tensor:
    return Coded().apply(linear[None], Generator())[0]


def _linear(coded: Tensor) -> Tensor:
    return Linear().apply(coded[None], Generator())[0]


def to_linear(coded: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """Linear light of sRGB values."""
    return Linear().apply(coded.reshape(1, -1, *coded.shape[-2:]), Generator()).reshape(coded.shape)
