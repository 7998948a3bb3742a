"""How a scene is rendered: size, quality, passes, and the optics of each camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from ..check import CheckLimits

Pass = Literal["normals", "flow", "nir", "alpha"]


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Optics of a camera, which a rig file does not hold.

    `pixel_pitch` is the width of a pixel in metres; with fx it gives the focal length, hence the aperture of an
    `f_number`. `focus` is the distance in metres that is sharp. `shutter` is the exposure time in seconds, centred
    on the moment of the frame. Without `f_number` everything is sharp, without `shutter` there is no motion blur.
    """

    f_number: float | None = None
    focus: float | None = None
    shutter: float | None = None
    pixel_pitch: float = 5e-6

    def __post_init__(self) -> None:
        for name in ("f_number", "focus", "shutter", "pixel_pitch"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be above 0, got {value:g}")
        if (self.f_number is None) != (self.focus is None):
            raise ValueError("depth of field needs both f_number and focus (the distance in metres that is sharp)")


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """What is rendered, and how well.

    `width` resizes the rig so that its widest image has that many pixels; None leaves it as it is. `passes` are
    made beside colour, depth and index ("alpha" leaves the world's light out of the images). `duration` seconds
    are rendered at each camera's own frame rate and time offset; 0 renders one frame a camera. `optics` is by
    camera name. `threads` of 0 uses all cores. `limits` are what the self-check holds the first frames to. `device`
    "auto" takes a GPU where one is usable.
    """

    width: int | None = None
    samples: int = 8
    denoise: Literal["none", "fast", "accurate"] = "fast"
    fast_light: bool = True
    bounces: int = 2
    engine: Literal["cycles", "eevee"] = "cycles"
    device: Literal["auto", "cpu", "gpu"] = "cpu"
    threads: int = 0
    passes: tuple[Pass, ...] = ()
    duration: float = 0.0
    optics: dict[str, Optics] = field(default_factory=dict)
    limits: CheckLimits = field(default_factory=CheckLimits)

    @classmethod
    def preset(cls, name: str, **changes: Any) -> RenderSettings:
        """ "fast" (512 pixels wide, 8 samples, quick denoising and light) or "paper" (2048 wide, more of each).

        Raises ValueError for another name.
        """
        if name not in PRESETS:
            raise ValueError(f"unknown preset '{name}' (known: {', '.join(PRESETS)})")
        return cls(**{**PRESETS[name], **changes})


PRESETS: dict[str, dict[str, Any]] = {
    "fast": {"width": 512},
    "paper": {"width": 2048, "samples": 32, "denoise": "accurate", "fast_light": False, "bounces": 4},
}
