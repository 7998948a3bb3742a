"""Sensors of cameras: spectral response, timing and coding."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from .checks import check_above


@dataclass(frozen=True)
class Band:
    """Band of wavelengths.

    Attributes:
        centre: nanometres, more than 0.
        width: nanometres, more than 0.

    Raises:
        ValueError: for other numbers.
        TypeError: for values that are no numbers; tensors are not refused.
    """

    centre: float
    width: float

    def __post_init__(self) -> None:
        _refuse_none(centre=self.centre, width=self.width)
        check_above(0, itself=False, centre=self.centre, width=self.width)


def _refuse_none(**values: object) -> None:
    if missing := [name for name, value in values.items() if value is None]:
        raise TypeError(f"{missing[0]} is None: give a number")


@dataclass(frozen=True)
class Curve:
    """Sampled spectral response.

    Attributes:
        wavelength: wavelengths, nanometres.
        response: response at each wavelength, in any unit.

    Raises:
        ValueError: for no samples, or unequal numbers of wavelengths and responses; values and order are not
            checked.
    """

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
    """Properties of a camera's sensor, which geometry does not use.

    Light times `exposure` times `gain` makes a value. Both are relative: only their ratios between cameras
    matter.

    Attributes:
        response: name (of `RESPONSES`), band or curve; None if unknown.
        frame_rate: frames for each second; None if unknown.
        time_offset: seconds after the rig's clock.
        coding: relation of pixel values to light, "srgb" or "linear".
        bayer: colour filter pattern (of `PATTERNS`) from the top left of raw images; None for none.
        bits: bits of a count: a file's values are 0 to 2^bits - 1; None for the file's own 8 or 16 bits.
        black_level: count that stands for no light.
        exposure: seconds; None if unknown.
        gain: factor of the value; three numbers for red, green and blue.

    Raises:
        ValueError: for numbers out of range, a tuple of other than three gains, another coding, pattern or
            response.
        TypeError: for values that are no numbers.
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
        if isinstance(self.gain, tuple) and len(gains) != 3:
            raise ValueError(f"gain is {self.gain}: wanted one number, or three for red, green and blue")
        _refuse_none(time_offset=self.time_offset, black_level=self.black_level)
        for gain in gains:
            _refuse_none(gain=gain)
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
    """Describe a sensor's spectral response in a word or two; empty if it has none."""
    response = sensor.response
    if isinstance(response, Band):
        return f"{response.centre:g}+-{response.width / 2:g} nm"
    if isinstance(response, Curve):
        return f"{min(response.wavelength):g}-{max(response.wavelength):g} nm"
    return response or ""
