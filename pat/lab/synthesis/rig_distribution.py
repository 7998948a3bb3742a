"""What random rigs are drawn from. Torch is not imported: the command line reads it for its options."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Range = tuple[float, float]


@dataclass(frozen=True)
class RigDistribution:
    """A distribution of random rigs. Pairs are ranges; lengths are drawn evenly in their logarithm.

    - `mode`: "rectified" (betas displaced along x alone, their images resized copies of alpha's geometry, so
      that x_beta = s (x_alpha - disparity) up to the half pixel) or "general".
    - `parallax`: displacement of the nearest depth against infinity, in alpha's pixels; sets the baseline.
    - `near` in metres and `depth_ratio` = far / near.
    - `frame`: width of the whole image as a multiple of alpha's, which is a patch of it; `focal`: focal
      length as a multiple of that width.
    - `resolutions`: beta's pixels a radian over alpha's and its size over alpha's; one is drawn for each
      camera of a batch.
    - `alpha`, rectified only: whether alpha is the left camera, the right, or either (one draw a rig).
    - general only: `focal_ratio` (on top of the resolution), `rotation` in degrees about a random axis,
      `toe_in` (how far betas rotate towards a point of the scene: 0 parallel, 1 wholly), `decentring` (how
      far beta's patch misses alpha's, as a fraction of its size).
    """

    mode: Literal["rectified", "general"] = "rectified"
    betas: int = 1
    parallax: Range = (12.0, 120.0)
    near: Range = (0.5, 8.0)
    depth_ratio: Range = (1.5, 40.0)
    frame: Range = (1.0, 4.0)
    focal: Range = (0.7, 1.5)
    resolutions: tuple[float, ...] = (1.0, 0.5, 0.25)
    alpha: Literal["left", "right", "either"] = "either"
    focal_ratio: Range = (0.5, 2.0)
    rotation: float = 4.0
    toe_in: Range = (0.0, 1.0)
    decentring: float = 0.1

    def __post_init__(self) -> None:
        for name in ("parallax", "near", "depth_ratio", "frame", "focal", "focal_ratio"):
            low, high = getattr(self, name)
            if not 0 < low <= high < math.inf:
                raise ValueError(f"{name} must be two positive numbers in order, got {low:g} and {high:g}")
        if self.betas < 1 or not self.resolutions or not min(self.resolutions) > 0:
            raise ValueError(
                f"betas must be at least 1 and resolutions positive, got {self.betas}, {self.resolutions}"
            )
