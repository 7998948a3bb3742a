"""Settings of rendering: size and quality."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from ..check import CheckLimits


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Settings of rendering by Blender.

    Attributes:
        width: width in pixels of the rig's widest image; all are resized by the same factor. None keeps the
            sizes.
        samples: rays for each pixel.
        denoise: "none", or the quality of the denoiser.
        fast_light: True for Blender's fast approximation of indirect light.
        bounces: reflections of light.
        threads: CPU threads; 0 uses all cores.
        infrared: True to render near infrared beside colours.
        duration: seconds to render, at each camera's frame rate and time offset; 0 renders one frame of each
            camera.
        limits: limits of the self-check, applied to the first frames.
    """

    width: int | None = None
    samples: int = 8
    denoise: Literal["none", "fast", "accurate"] = "fast"
    fast_light: bool = True
    bounces: int = 2

    threads: int = 0
    infrared: bool = False
    duration: float = 0.0
    limits: CheckLimits = field(default_factory=CheckLimits)


PRESETS: dict[str, dict[str, Any]] = {
    "fast": {"width": 512},
    "paper": {"width": 2048, "samples": 32, "denoise": "accurate", "fast_light": False, "bounces": 4},
}
"""Presets by name, beside the defaults: 512 pixels wide, or as the paper's 2048 at higher quality."""
