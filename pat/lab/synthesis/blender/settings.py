"""How a scene is rendered: size and quality."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from ..check import CheckLimits


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """What is rendered, and how well.

    `width` resizes the rig so that its widest image has that many pixels; None leaves it as it is. `infrared`
    makes an image of the near infrared beside that of colours. `duration` seconds are rendered at each
    camera's own frame rate and time offset; 0 renders one frame a camera. `threads` of 0 uses all cores.
    `limits` are what the self-check holds the first frames to. `device` "auto" takes a GPU where one is
    usable.
    """

    width: int | None = None
    samples: int = 8
    denoise: Literal["none", "fast", "accurate"] = "fast"
    fast_light: bool = True
    bounces: int = 2
    device: Literal["auto", "cpu", "gpu"] = "cpu"
    threads: int = 0
    infrared: bool = False
    duration: float = 0.0
    limits: CheckLimits = field(default_factory=CheckLimits)


PRESETS: dict[str, dict[str, Any]] = {
    "fast": {"width": 512},
    "paper": {"width": 2048, "samples": 32, "denoise": "accurate", "fast_light": False, "bounces": 4},
}
"""What differs from the defaults, by name: 512 pixels wide, or as the paper's, 2048 and more of each."""
