"""Distance of beta's points across their search segments: a camera that moved a little since its calibration.

The displacement across the segments is modelled as affine in alpha's pixels: a shift, a rotation about the
optical axis, another angle of view. It is fitted robustly to displacements of small windows (Lucas and Kanade
1981), each freed of its displacement along its segment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from arraygeom import Segments
from arraygeom.fields.grid import FieldOnGrid
from arraygeom.pixels import HW
from arraygeom.robust import cauchy, normal_deviation, robust_least_squares

from ..matching.inputs import Extent
from ..matching.subpixel import SETTINGS as SUBPIXEL
from ..support.settings import size, tuned

Image = NDArray[Any]


@dataclass(frozen=True)
class AlignmentSettings:
    """Settings of the fit of the displacement across the search segments.

    Lengths are pixels of the images given, brightness is 0 to 1. Middlebury is its tune half.

    `pat lab settings` prints the value of each with its meaning and reason.
    """

    blur: float = tuned(
        1.0, "Middlebury, tune half: deviation of the blur before gradients, and before a response is fitted"
    )
    radius: int = tuned(7, "Middlebury: of the windows, to either side")
    steps: int = size(6, "Gauss-Newton steps at most")
    finest: float = size(5e-3, "A step below this ends them")
    farthest: float = size(2.0, "A window's displacement in one step is at most this")
    deviation: float = size(0.05, "Standard deviation of displacements about the plane, at least")
    least: float = tuned(0.2, "Middlebury: pixels of the largest displacement below which a rig is right")
    better: float = tuned(0.98, "Middlebury: the residual over that without, up to which it is accepted")
    windows: int = size(50, "Fewest windows with texture")


SETTINGS = AlignmentSettings()


@dataclass(frozen=True)
class Misalignment:
    """Displacement of beta's image across the search segments: shift + across u + down v, in widths of alpha.

    (u, v) is a pixel's position from the middle of alpha, in widths of alpha. Beta is taken to have alpha's
    angular resolution. A displacement is positive along `normals`: the direction from the segment's end to
    its start, turned by a right angle from x towards y.

    Attributes:
        shift: displacement in the middle of alpha.
        across: change per width of alpha to the right.
        down: change per width of alpha downwards.
    """

    shift: float = 0.0
    across: float = 0.0
    down: float = 0.0

    def __add__(self, other: Misalignment) -> Misalignment:
        return Misalignment(self.shift + other.shift, self.across + other.across, self.down + other.down)

    def at(self, x: Float[Tensor, "*n 2"], hw: HW) -> Float[Tensor, "*n"]:
        """Compute the displacement of alpha's pixels, pixels of alpha.

        Args:
            hw: alpha's size without padding.
        """
        u, v = ((x[..., i] + 0.5) / hw[1] - 0.5 * hw[1 - i] / hw[1] for i in range(2))
        return hw[1] * (self.shift + self.across * u + self.down * v)

    def largest(self, hw: HW) -> float:
        """Compute the largest displacement of any pixel, pixels of alpha."""
        h, w = hw
        corners = torch.tensor([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]], dtype=torch.float64)
        return float(self.at(corners, hw).abs().max())

    def applied(self, field: FieldOnGrid, hw: HW) -> FieldOnGrid:
        """Return the field with its segments displaced; a field of explicit positions stays.

        Args:
            hw: alpha's size without padding.
        """
        if self == Misalignment() or field.pixels is None:
            return field
        return field.displaced(lambda locations, x: self.at(x, hw)[..., None] * normals(locations))


def normals(segments: Segments) -> Float[Tensor, "*n 2"]:
    """Compute unit vectors across the segments; zero where a segment is a point."""
    direction = Extent.from_segments(segments).towards
    return torch.stack([-direction[..., 1], direction[..., 0]], -1)


@torch.no_grad()
def fit_misalignment(
    alpha: Float[Tensor, "h w"],
    beta: Float[Tensor, "hb wb"],
    position: Float[Tensor, "h w 2"],
    normal: Float[Tensor, "h w 2"],
    weight: Float[Tensor, "h w"],
) -> Misalignment:
    """Estimate the displacement of beta across its segments, from matches.

    Args:
        alpha: brightness of alpha, 0..1.
        beta: brightness of beta, as bright and sharp as alpha.
        position: positions (x, y) of alpha's pixels in beta, by the matches.
        normal: unit vectors across the segments (`normals`).
        weight: weight of each match, 0 to 1.

    Returns:
        The misalignment, in widths of this alpha; all zeros for too little texture, for one below
        `SETTINGS.least` pixels everywhere, or if it explains the images hardly better.
    """
    arrays = (t.detach().cpu().float().numpy() for t in (alpha, beta, position, normal, weight))
    views = _Windows.from_arrays(*arrays)
    height, width = alpha.shape
    coefficients: NDArray[np.float64] = np.zeros(3)
    for _ in range(SETTINGS.steps):
        step = views.step(coefficients)
        if step is None:
            return Misalignment()
        coefficients = coefficients + step
        if np.abs(step).max() < SETTINGS.finest:
            break
    misalignment = Misalignment(*(float(c) / width for c in coefficients))
    if misalignment.largest((height, width)) < SETTINGS.least:
        return Misalignment()
    accepted = views.residual(coefficients) < SETTINGS.better * views.residual(np.zeros(3))
    return misalignment if accepted else Misalignment()


class _Windows(NamedTuple):
    """Blurred images, beta's gradients, and the terms on which the displacement depends (3, h, w)."""

    alpha: Image
    beta: Image
    gradients: tuple[Image, Image]
    position: Image
    normal: Image
    weight: Image
    design: Image

    @classmethod
    def from_arrays(
        cls, alpha: Image, beta: Image, position: Image, normal: Image, weight: Image
    ) -> _Windows:
        height, width = alpha.shape
        y, x = np.mgrid[:height, :width].astype(np.float32)
        design = np.stack([np.ones_like(x), (x + 0.5) / width - 0.5, (y + 0.5 - height / 2) / width])
        alpha_soft, beta_soft = (cv2.GaussianBlur(p, (0, 0), SETTINGS.blur) for p in (alpha, beta))
        horizontal = cv2.Sobel(beta_soft, cv2.CV_32F, 1, 0, ksize=3) / 8
        vertical = cv2.Sobel(beta_soft, cv2.CV_32F, 0, 1, ksize=3) / 8
        return cls(alpha_soft, beta_soft, (horizontal, vertical), position, normal, weight, design)

    def _sampled(self, coefficients: NDArray[np.float64]) -> tuple[Image, Image, Image, Image]:
        """Sample beta and its gradients at the displaced matches, with the weight of those inside beta."""
        displaced = self.position + np.tensordot(coefficients, self.design, 1)[..., None] * self.normal
        columns, rows = (np.ascontiguousarray(displaced[..., i], np.float32) for i in range(2))
        height, width = self.beta.shape
        inside = (columns > 2) & (rows > 2) & (columns < width - 3) & (rows < height - 3)
        planes, beyond = (self.beta, *self.gradients), cv2.BORDER_REPLICATE
        value, gx, gy = (cv2.remap(p, columns, rows, cv2.INTER_LINEAR, borderMode=beyond) for p in planes)
        return value, gx, gy, self.weight * inside.astype(np.float32)

    def _mean(self, plane: Image, weight: Image) -> Image:
        side = (2 * SETTINGS.radius + 1,) * 2
        product: Image = weight * plane
        return cv2.blur(product, side) / (cv2.blur(weight, side) + 1e-6)

    def residual(self, coefficients: NDArray[np.float64]) -> float:
        """Return the mean difference of the images where these match, freed of its mean in each window."""
        value, _, _, weight = self._sampled(coefficients)
        rest = self.alpha - value
        return float((weight * np.abs(rest - self._mean(rest, weight))).sum() / max(weight.sum(), 1.0))

    def step(self, coefficients: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return the change (3) of the coefficients (3), pixels, by one step; None for too little texture."""
        value, gx, gy, weight = self._sampled(coefficients)
        across = gx * self.normal[..., 0] + gy * self.normal[..., 1]
        along_segment = gx * self.normal[..., 1] - gy * self.normal[..., 0]
        rest = self.alpha - value
        rest = rest - self._mean(rest, weight)
        products = across * across, across * along_segment, along_segment * along_segment
        strength, mixed, other = (self._mean(product, weight) for product in products)
        towards, aside = self._mean(across * rest, weight), self._mean(along_segment * rest, weight)
        strength = strength - mixed**2 / (other + 1e-6)
        towards = towards - mixed * aside / (other + 1e-6)
        some = (slice(None, None, 4), slice(None, None, 4))
        useful = (strength[some] > SUBPIXEL.flat / 10) & (weight[some] > 0.3)
        if useful.sum() < SETTINGS.windows:
            return None
        steps = towards[some][useful] / (strength[some][useful] + SUBPIXEL.flat / 10)
        counts = strength[some][useful] / (strength[some][useful] + SUBPIXEL.flat)
        limit = SETTINGS.farthest
        return _robust_plane(self.design[:, ::4, ::4][:, useful], np.clip(steps, -limit, limit), counts)


def _robust_plane(design: NDArray, values: NDArray, weight: NDArray) -> NDArray[np.float64]:
    """Solve weighted least squares with Cauchy's weights."""
    terms, wanted, counts = (torch.from_numpy(x).double() for x in (design, values, weight))

    def weigh(rest: Tensor) -> Tensor:
        return counts * cauchy(rest, 2 * normal_deviation(rest, SETTINGS.deviation))

    eye = torch.eye(len(terms), dtype=torch.float64)
    return robust_least_squares(terms, wanted, 0 * eye[0], weigh, precision=1e-3 * eye).coefficients.numpy()
