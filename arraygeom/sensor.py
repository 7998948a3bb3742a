"""A camera's sensor: its spectral response, timing and coding."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Band:
    """A band of wavelengths, in nanometres."""

    centre: float
    width: float


@dataclass(frozen=True)
class Curve:
    """A sampled spectral response: `response[i]` at `wavelength[i]` nanometres."""

    wavelength: tuple[float, ...]
    response: tuple[float, ...]


PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""Colour filter patterns: the first two pixels of the first row, then of the second."""


@dataclass(frozen=True)
class Sensor:
    """Facts about a camera that geometry does not use.

    `response` is a name ("mono", "rgb", "nir"), a band or a curve. `frame_rate` is in frames a second,
    `time_offset` in seconds after the rig's clock. `coding` says how pixel values relate to light:
    "srgb" or "linear". `bayer` is the colour filter pattern from the top left ("RGGB"), for raw images.

    A file's values are counts from 0 to 2^bits - 1 (by default the file's own 8 or 16 bits), of which
    `black_level` stands for no light. Light times `exposure` (seconds) times `gain` makes the value; a gain of three
    numbers is of red, green and blue. Both are relative: only their ratios between cameras matter.
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


torch.serialization.add_safe_globals([Band, Curve, Sensor])
