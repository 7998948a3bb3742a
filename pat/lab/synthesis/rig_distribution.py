"""Distribution of random rigs. Imports no torch: the command line reads it for its options."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Range = tuple[float, float]


@dataclass(frozen=True)
class RigDistribution:
    """Distribution of random rigs. Pairs are (low, high) bounds; all but `toe_in` are drawn evenly in the
    logarithm.

    Attributes:
        mode: "rectified" (betas displaced along x alone, images resized copies of alpha's geometry, so that
            x_beta = s (x_alpha - disparity) up to the half pixel; plus with alpha on the right) or "general".
        betas: number of betas.
        parallax: displacement of the nearest depth against infinity, alpha's pixels; sets the baseline.
        near: near bound, metres.
        depth_ratio: far / near.
        frame: width of the whole image as a multiple of alpha's, which is a patch of it.
        focal: focal length as a multiple of that width.
        resolutions: beta's pixels a radian over alpha's, and its size over alpha's; one is drawn for each
            beta of a batch, before `focal_ratio`.
        alpha: side of alpha against a beta in rectified rigs; "either" draws one for each beta of each rig.
        focal_ratio: further factor of beta's focal length (general).
        rotation: size of a random rotation, degrees: two standard deviations about each axis (general).
        toe_in: rotation of betas towards a point of the scene, 0 parallel, 1 fully (general).
        decentring: largest offset of beta's patch from alpha's view, as a fraction of its size (general).

    Raises:
        ValueError: for bounds (but `toe_in`) that are not positive, finite and in order, no betas, and
            resolutions that are none or not positive.
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
            raise ValueError(f"betas must be 1 or more, resolutions > 0: {self.betas}, {self.resolutions}")
