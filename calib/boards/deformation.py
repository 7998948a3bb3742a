"""Deformed boards, neither flat nor printed true to size: shapes as unknowns of the bundle adjustment.

A print may be longer along one axis, and a sheet be curved. To third order a bent sheet keeps the lengths on
it: with the symmetric curvature C (1/m) about the board's middle, the point q moves to q - C q (q^T C q) / 6,
and out of the plane by q^T C q / 2 - (q^T C q) (q^T C^2 q) / 24; exact to that order for cylinders of any
axis.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.special import fdtrc

PARAMETERS = 4
"""Number of shape parameters: stretch of y against x, curvatures xx, xy, yy (1/m)."""
DEVIATIONS = np.array([0.05, 0.5, 0.5, 0.5])
"""Standard deviations of a board's shape before any measurement."""
SIGNIFICANCE = 1e-3
"""Chance of agreement by accident (Hotelling's test) below which a shape is accepted."""
LEAST_GAIN = 20.0
"""Least fall of the loss (half a chi-square) for a shape to be accepted."""
STEP = 1e-5


@dataclass(frozen=True)
class BoardDeformation:
    """Shapes of boards that are not flat or not printed true; its length is the number of values, four each.

    Attributes:
        values: stretch (y / x - 1) and curvatures xx, xy, yy (1/m, positive where the middle lies in front)
            of each board.
        middle: middle (x, y) of each board, metres.
        part: index of the board, a row of `values`, at each board pose.
    """

    values: Float[np.ndarray, "k 4"]
    middle: Float[np.ndarray, "k 2"]
    part: Int[np.ndarray, " b"]

    @classmethod
    def flat(cls, middle: Float[np.ndarray, "k 2"], part: Int[np.ndarray, " b"]) -> BoardDeformation:
        """Make flat boards with these middles; `part` is the board of each block."""
        return cls(np.zeros((len(middle), PARAMETERS)), middle, part)

    def __len__(self) -> int:
        return self.values.size

    def deformed(self, p: Float[np.ndarray, "n 3"], part: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Deform points of flat boards.

        Args:
            p: points of flat boards, metres.
            part: index of each point's board.

        Returns:
            Points (n, 3) in their board's frame, metres.
        """
        return _deformed(p, self.middle[part], self.values[part])

    def jacobian(
        self, p: Float[np.ndarray, "n 3"], part: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 3 s"]:
        """Differentiate the deformed points by the shapes, by central differences.

        Args:
            p: points of flat boards, metres.
            part: index of each point's board.

        Returns:
            Derivatives (n, 3, s) by all `values`, board by board; 0 by other boards' values.
        """
        jacobian = np.zeros((len(p), 3, *self.values.shape))
        rows, middle, values = np.arange(len(p)), self.middle[part], self.values[part]
        for i, step in enumerate(STEP * np.eye(PARAMETERS)):
            ahead, behind = (_deformed(p, middle, values + sign * step) for sign in (1, -1))
            jacobian[rows, :, part, i] = (ahead - behind) / (2 * STEP)
        return jacobian.reshape(len(p), 3, -1)

    def stepped(self, change: Float[np.ndarray, " s"]) -> BoardDeformation:
        """Return the shapes after a change of all values."""
        return replace(self, values=self.values + change.reshape(self.values.shape))

    @property
    def information(self) -> Float[np.ndarray, " s"]:
        """Inverse variances of the values before any measurement."""
        return np.tile(DEVIATIONS**-2.0, len(self.values))

    def loss(self) -> float:
        """Return half the squared Mahalanobis distance from flat boards."""
        return float(self.information @ self.values.ravel() ** 2) / 2


def _deformed(p: np.ndarray, middle: np.ndarray, values: np.ndarray) -> np.ndarray:
    stretch, a, b, c = values.T
    u, v = p[:, 0] - middle[:, 0], (p[:, 1] - middle[:, 1]) * (1 + stretch)
    cu, cv = a * u + b * v, b * u + c * v
    first, second = cu * u + cv * v, cu**2 + cv**2
    x, y = u - cu * first / 6, v - cv * first / 6
    return np.stack([middle[:, 0] + x, middle[:, 1] + y, p[:, 2] + first / 2 - first * second / 24], -1)


def is_significant(
    values: Float[np.ndarray, " s"], covariance: Float[np.ndarray, "s s"], frames: int
) -> bool:
    """Test whether boards' shapes differ significantly from flat, by Hotelling's test.

    Args:
        values: stretches and curvatures.
        covariance: covariance of these by a jackknife over frames.
        frames: number of frames, 2 or more.

    Returns:
        True if chance explains them with a probability below `SIGNIFICANCE`; False unless there are more
        frames than values. A singular covariance raises numpy.linalg.LinAlgError.
    """
    count = len(values)
    squared = float(values @ np.linalg.solve(covariance, values))
    ratio = squared * (frames - count) / (count * (frames - 1))
    return bool(fdtrc(count, frames - count, ratio) < SIGNIFICANCE)


def described(
    shape: BoardDeformation, deviations: Float[np.ndarray, "k 4"], extents: list[tuple[float, float]]
) -> Iterator[str]:
    """Yield a sentence for each board whose stretch exceeds three standard deviations, and for each of which
    a curvature does.

    Args:
        shape: shapes of the boards.
        deviations: standard deviation of each of its values.
        extents: width and height of each board, metres.
    """
    for k, (extent, deviation) in enumerate(zip(extents, deviations)):
        name = f"board {k + 1}" if len(extents) > 1 else "the board"
        stretch, a, b, c = shape.values[k]
        if abs(stretch) > 3 * deviation[0]:
            yield (
                f"{name} is stretched: squares are {100 * abs(stretch):.2f} ± {100 * deviation[0]:.2g} % "
                f"{'longer' if stretch > 0 else 'shorter'} down than across; this is modelled, "
                "with the size across as specified: measure both"
            )
        relative = float(np.max(np.abs(shape.values[k, 1:]) / deviation[1:]))
        if relative > 3:
            curvatures, axes = np.linalg.eigh(np.array([[a, b], [b, c]]))
            main = int(np.abs(curvatures).argmax())
            curvature, length = float(curvatures[main]), float(np.abs(axes[:, main]) @ np.array(extent))
            depth, side = 1e3 * abs(curvature) * length**2 / 8, "in front of" if curvature > 0 else "behind"
            yield (
                f"{name} is bent: its middle lies {depth:.2f} ± {depth / relative:.2g} mm "
                f"{side} its edges (radius {1 / abs(curvature):.2f} m); "
                "this is modelled: glue it to something stiff and flat"
            )
