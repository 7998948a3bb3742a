"""A camera's sensor: its spectral response, timing and coding."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from .checks import check_above


@dataclass(frozen=True)
class Band:
    """A band of wavelengths, in nanometres."""

    centre: float
    width: float

    def __post_init__(self) -> None:
        check_above(0, itself=False, centre=self.centre, width=self.width)


@dataclass(frozen=True)
class Curve:
    """A sampled spectral response: `response[i]` at `wavelength[i]` nanometres."""

    wavelength: tuple[float, ...]
    response: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.wavelength) != len(self.response) or not self.wavelength:
            counts = f"{len(self.wavelength)} wavelengths and {len(self.response)} responses"
            raise ValueError(f"a curve has a response for each wavelength, one or more; got {counts}")


PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""Colour filter patterns: the first two pixels of the first row, then of the second."""
RESPONSES = (
    *("mono", "rgb", "red", "green", "blue", "red edge", "nir", "swir", "thermal"),
    "luminance of light",  # of developed images: pat.media.raw.LIGHT
)
"""Names of spectral responses."""
CODINGS = ("srgb", "linear")


@dataclass(frozen=True)
class Sensor:
    """Facts about a camera that geometry does not use.

    `response` is a name (of `RESPONSES`), a band or a curve. `frame_rate` is in frames a second,
    `time_offset` in seconds after the rig's clock. `coding` says how pixel values relate to light:
    "srgb" or "linear". `bayer` is the colour filter pattern from the top left ("RGGB"), for raw images.

    A file's values are counts from 0 to 2^bits - 1 (by default the file's own 8 or 16 bits), of which
    `black_level` stands for no light. Light times `exposure` (seconds) times `gain` makes the value; a gain
    of three numbers is of red, green and blue. Both are relative: only their ratios between cameras matter.
    """

    response: str | Band | Curve | None = None
    frame_rate: float | None = None
    time_offset: float = 0.0
    coding: str = "srgb"
    bayer: str | None = None
    bits: int | None = None
    black_level: float = 0.0
    exposure: float | None = None
    gain: float | tuple[float, float, float] = 1.0

    def __post_init__(self) -> None:
        gains = self.gain if isinstance(self.gain, tuple) else (self.gain,)
        check_above(0, itself=False, frame_rate=self.frame_rate, exposure=self.exposure)
        check_above(-math.inf, itself=False, time_offset=self.time_offset)
        for gain in gains:
            check_above(0, itself=False, gain=gain)
        check_above(1, whole=True, bits=self.bits)
        check_above(0, black_level=self.black_level)
        stated = None if isinstance(self.response, Band | Curve) else self.response
        for name, value, allowed in (
            ("coding", self.coding, CODINGS),
            ("bayer", self.bayer, (None, *PATTERNS)),
            ("response", stated, (None, *RESPONSES)),
        ):
            if value not in allowed:
                raise ValueError(f"{name} is {value!r}: wanted {' or '.join(repr(v) for v in allowed if v)}")


torch.serialization.add_safe_globals([Band, Curve, Sensor])


def response_text(sensor: Sensor) -> str:
    """The spectral response in a word or two, if one is stated."""
    response = sensor.response
    if isinstance(response, Band):
        return f"{response.centre:g}+-{response.width / 2:g} nm"
    if isinstance(response, Curve):
        return f"{min(response.wavelength):g}-{max(response.wavelength):g} nm"
    return response or ""
