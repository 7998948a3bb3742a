"""What a camera records, apart from where: its spectral response, timing and coding."""

from __future__ import annotations

from dataclasses import dataclass


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


@dataclass(frozen=True)
class Sensor:
    """Facts about a camera that geometry carries along but does not use.

    `response` is a name ("mono", "rgb", "nir"), a band or a curve. `frame_rate` is in frames a second,
    `time_offset` in seconds after the rig's clock. `coding` says how pixel values relate to light:
    "srgb" or "linear". `bayer` is the colour filter pattern from the top left ("RGGB"), for raw pictures.
    """

    response: str | Band | Curve | None = None
    frame_rate: float | None = None
    time_offset: float = 0.0
    coding: str = "srgb"
    bayer: str | None = None
