"""Chains as lists in a file.

    mono:
      - decode-srgb
      - spectral: luminance
      - gaussian-blur: 0.8
      - resample: 0.5
      - noise: {full_well: 8000, read: 3}
      - clip
      - encode-srgb
      - quantise: 8

A step is its name, or its name with its options; a single value is its first option. Steps are named as their
classes are, in small letters with hyphens.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from pat.sensors import BoxBlur, Clip, GaussianBlur, Jitter, Noise, Quantise, Resample, Step
from pat.support.schema import from_document, near

from .steps import DecodeSRGB, EncodeSRGB, Exposure, Mosaic, MotionBlur, Spectral

_CLASSES: tuple[type[Step], ...] = (
    *(DecodeSRGB, EncodeSRGB, Spectral, Exposure, BoxBlur, GaussianBlur, MotionBlur),
    *(Resample, Mosaic, Noise, Clip, Quantise, Jitter),
)
STEPS: dict[str, type[Step]] = {re.sub(r"(?<=[a-z])(?=[A-Z])", "-", c.__name__).lower(): c for c in _CLASSES}
"""Every step by its name in files."""


def read_chain(value: Any, where: str = "chain") -> tuple[Step, ...]:
    """The steps of a list as YAML has it. Raises ValueError naming the entry (`where`), the nearest name.

    >>> read_chain(["decode-srgb", {"noise": {"full_well": 8000, "read": 3}}, {"quantise": 12}])
    (DecodeSRGB(), Noise(full_well=8000.0, read=3.0, counts='gaussian'), Quantise(bits=12))
    """
    if not isinstance(value, list):
        raise ValueError(
            f"{where}: wanted a list of steps, such as [decode-srgb, {{noise: {{full_well: 8000}}}}]"
        )
    return tuple(_step(entry, f"{where}[{i}]") for i, entry in enumerate(value))


def read_chains(value: Any, where: str = "sensors") -> dict[str, tuple[Step, ...]]:
    """One chain for each camera, from a mapping of names to lists."""
    if not isinstance(value, Mapping):
        raise ValueError(f"{where}: wanted a mapping of cameras to lists of steps")
    return {str(name): read_chain(steps, f"{where}.{name}") for name, steps in value.items()}


def _step(entry: Any, where: str) -> Step:
    name, options = (
        next(iter(entry.items())) if isinstance(entry, Mapping) and len(entry) == 1 else (entry, {})
    )
    if not isinstance(name, str):
        raise ValueError(f"{where}: is {entry!r}; wanted a step's name, or one name with its options")
    if name not in STEPS:
        raise ValueError(f"{where}: no step is called '{name}'{near(name, STEPS)}")
    kind = STEPS[name]
    is_band = kind is Spectral and isinstance(options, Mapping) and options and "response" not in options
    if isinstance(options, Mapping) and not is_band:
        return from_document(kind, dict(options), f"{where}.{name}")
    first = next((f.name for f in fields(kind)), None)  # type: ignore[arg-type]
    if first is None:
        raise ValueError(f"{where}.{name}: takes no options, got {options!r}")
    return from_document(kind, {first: options}, f"{where}.{name}")
