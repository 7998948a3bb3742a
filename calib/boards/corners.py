"""Chessboard corners to a hundredth of a pixel, by fitting a parametric corner model to the image.

Four squares meet in a corner: grey is a + b S(d) S(e) with d, e the distances in pixels from the two edges, S
the step from -1 to 1 blurred by a Gaussian. Position, levels and blur of each corner are fitted by least
squares to the pixels beside its edges (Gauss-Newton); the directions and curvatures of the edges come from a
smooth map of the whole board, fitted to all its corners. The pixels used are symmetric about the corner, so
that gamma, glare and ink bleed, which move every edge towards one colour, hardly move a corner.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.special import erf

from arraygeom.robust import cauchy, least_squares, robust_least_squares

LONGEST_EDGE = 12.0
"""Pixels of an edge that are used at most: distorted edges are parabolas no further."""
SHORTEST_EDGE = 2.5
"""Visible pixels of an edge below which its corner is not refined."""
WIDEST_BAND = 5.0
"""Largest number of pixels used on either side of an edge."""
NARROWEST_BAND = 0.7
"""Smallest number of pixels used on either side of an edge."""
BLEED = 0.7
"""Pixels by which the blur of neighbouring edges extends into the corner's own squares."""
STEPS = 12
CONVERGED = 1e-3
"""Step in pixels below which the iteration ends."""
BLUR = 0.4, 3.0
"""Least and largest standard deviation of the blur, pixels."""
DEGREES = {0: 0, 12: 1, 30: 3, 42: 4, 54: 5}
"""Degree of the polynomial part of the board's map, by the least number of points."""
PASSES = 2
"""Number of fits of the board's map, each to the refined corners."""
FEWEST = 8
"""Corners that must be good to predict the others."""
MISFIT = 0.4
"""Largest residual of a corner (root mean square, as a share of its contrast)."""
LARGEST_SHIFT = 0.5
"""Largest distance of a corner from its prediction, as a share of its edges' length."""

Array = np.ndarray
Map = Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n 2"]]


class EdgeGeometry(NamedTuple):
    """Geometry of the two edges through each chessboard corner: first along the board's y, then along x.

    Attributes:
        along: tangent of each edge (x, y), pixels for each square.
        normal: unit normal (x, y) to the side of the board's larger x (first) and larger y (second).
        curvature: pixels along the normal by which the edge leaves its tangent, per squared pixel along it.
    """

    along: Float[np.ndarray, "n 2 2"]
    normal: Float[np.ndarray, "n 2 2"]
    curvature: Float[np.ndarray, "n 2"]


def refine_corners(
    grey: UInt8[np.ndarray, "h w"],
    x: Float[np.ndarray, "n 2"],
    p: Float[np.ndarray, "n 2"],
    *,
    clear: float = 0.5,
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Refine chessboard corners near `x` by fitting the corner model.

    Args:
        grey: image, 8 bits.
        x: approximate pixels, float64.
        p: positions on the board, in squares.
        clear: squares from a corner's edges within which there is nothing but its own four squares.

    Returns:
        Pixels, and True for corners that fit the model; the others keep `x`. Fewer than `FEWEST` corners are
        not fitted: all keep `x` and are True.

    Raises:
        cv2.error: if no homography fits the corners.
    """
    refined, good = x, np.ones(len(x), dtype=bool)
    for _ in range(PASSES):
        if good.sum() < FEWEST:
            break
        board = smooth_map(p, refined, good)
        shape = _shape(board, p)
        refined, good = _fitted(grey.astype(np.float32), board(p), shape, clear)
    return np.where(good[:, None], refined, x), good


def smooth_map(p: Float[np.ndarray, "n 2"], x: Float[np.ndarray, "n 2"], good: Bool[np.ndarray, " n"]) -> Map:
    """Fit a smooth map from the board to the image: a homography plus a polynomial, of degree up to 5,
    robustly.

    Args:
        p: positions on the board, in any unit.
        x: pixels of these.
        good: mask of the points to fit to, 4 or more.

    Returns:
        Function from board positions (n, 2), in the unit of p, to pixels (n, 2). cv2.error if no homography
        fits the points.
    """

    def weigh(rest: torch.Tensor) -> torch.Tensor:
        off = rest.norm(dim=-1)
        return cauchy(off, max(3 * float(off.quantile(0.5)), 1e-3)).square()

    middle, size = p[good].mean(0), max(float(np.abs(p[good] - p[good].mean(0)).max()), 1e-9)
    H, kept = cv2.findHomography(p[good], x[good], cv2.RANSAC, 3.0)
    weight = torch.from_numpy(kept[:, 0]).double() if kept.mean() > 0.5 else torch.ones(len(kept)).double()
    degree = max(d for fewest, d in DEGREES.items() if good.sum() >= fewest)
    flat = cv2.perspectiveTransform(p[good][:, None], H)[:, 0]
    terms = torch.from_numpy(monomials((p[good] - middle) / size, degree).T)
    bent = torch.from_numpy(x[good] - flat)
    fit = robust_least_squares(terms, bent, least_squares(terms, bent, weight), weigh, steps=3)
    coefficients = fit.coefficients.numpy()
    return lambda q: (
        cv2.perspectiveTransform(q[:, None], H)[:, 0] + monomials((q - middle) / size, degree) @ coefficients
    )


def monomials(q: Float[np.ndarray, "n 2"], degree: int) -> Float[np.ndarray, "n m"]:
    """Compute all products (n, m) of powers of u and v up to a total degree."""
    u, v = q.T
    return np.stack([u**i * v**j for i in range(degree + 1) for j in range(degree + 1 - i)], 1)


def _shape(board: Map, p: Array) -> EdgeGeometry:
    """Edges along the board's y (first) and x (second), by differences over a quarter of a square."""
    step, middle = 0.25, board(p)
    ends = [[board(p + s * step * np.eye(2)[axis]) for s in (1, -1)] for axis in (1, 0)]
    along = np.stack([(a - b) / (2 * step) for a, b in ends], 1)
    curve = np.stack([(a + b - 2 * middle) / step**2 for a, b in ends], 1)
    length = np.linalg.norm(along, axis=-1)
    normal = np.stack([along[..., 1], -along[..., 0]], -1) / length[..., None]
    normal *= np.sign((normal * along[:, ::-1]).sum(-1, keepdims=True))
    return EdgeGeometry(along, normal, (curve * normal).sum(-1) / 2 / length**2)


def _fitted(grey: Array, start: Array, shape: EdgeGeometry, clear: float) -> tuple[Array, Array]:
    """Corners fitted from their predicted positions, and True where the fit is good."""
    length = np.linalg.norm(shape.along, axis=-1).min(1)
    inside = np.minimum(start, np.array(grey.shape)[::-1] - 1 - start).min(1)
    extent = np.minimum(np.minimum(0.45 * length, LONGEST_EDGE), inside - 1)
    sine = np.abs(np.linalg.det(shape.normal))
    width = np.minimum(clear * length * sine - BLEED, WIDEST_BAND)
    usable = (extent >= SHORTEST_EDGE) & (width >= NARROWEST_BAND) & (sine > 0.2)
    fitted, good = start.copy(), np.zeros(len(start), dtype=bool)
    if usable.any():
        edges = EdgeGeometry(*(v[usable] for v in shape))
        positions, misfit = _least_squares(grey, start[usable], edges, extent[usable], width[usable])
        near = np.linalg.norm(positions - start[usable], axis=-1) < LARGEST_SHIFT * extent[usable]
        fitted[usable], good[usable] = positions, near & (misfit < MISFIT)
    return fitted, good


class CornerModel(NamedTuple):
    """Parameters of the corner model a + b S S (see the module), one row for each corner.

    Attributes:
        x: position (x, y), pixels.
        level: a, the mean of black and white, in grey values.
        contrast: b, half their difference, of either sign.
        blur: standard deviation of the blur, pixels.
    """

    x: Float[np.ndarray, "n 2"]
    level: Float[np.ndarray, "n 1"]
    contrast: Float[np.ndarray, "n 1"]
    blur: Float[np.ndarray, "n 1"]

    def changed(self, step: Float[np.ndarray, "n 5"]) -> CornerModel:
        """Return the model after a step of at most a pixel and a factor of the blur between 0.6 and 1.6."""
        blur = (self.blur * np.exp(step[:, 4:].clip(-0.5, 0.5))).clip(*BLUR)
        return CornerModel(
            self.x + step[:, :2].clip(-1, 1), self.level + step[:, 2:3], self.contrast + step[:, 3:4], blur
        )


def _least_squares(
    grey: Array, start: Array, shape: EdgeGeometry, extent: Array, width: Array
) -> tuple[Array, Array]:
    """Gauss-Newton on all corners at once: positions, and residuals (root mean square) in contrasts."""
    half = int(np.ceil(extent.max()))
    square = np.stack(np.meshgrid(*2 * [np.arange(-half, half + 1)]), -1).reshape(-1, 2)
    pixels = np.rint(start).astype(int)[:, None] + square
    values = grey[pixels[..., 1].clip(0, grey.shape[0] - 1), pixels[..., 0].clip(0, grey.shape[1] - 1)]
    model = _initial_model(values, start, *_distances(pixels - start[:, None], shape, extent, width))
    for _ in range(STEPS):
        root, d, e = _distances(pixels - model.x[:, None], shape, extent, width)
        left, J = _linearised(values, model, shape.normal, d, e)
        J *= root[..., None]
        A = J.swapaxes(1, 2) @ J
        A += 1e-6 * np.eye(5) * (np.trace(A, axis1=1, axis2=2)[:, None, None] / 5 + 1e-9)
        step = np.linalg.solve(A, J.swapaxes(1, 2) @ (root * left)[..., None])[..., 0]
        model = model.changed(step)
        if np.abs(step[:, :2]).max() < CONVERGED:
            break
    misfit = np.sqrt(((root * left) ** 2).sum(1) / (root**2).sum(1).clip(1e-9))
    return model.x, misfit / np.abs(model.contrast[:, 0]).clip(1e-9)


def _initial_model(values: Array, x: Array, root: Array, d: Array, e: Array) -> CornerModel:
    """Model with level and contrast fitted at the given positions, and a blur of 1."""
    pattern, weight = erf(d) * erf(e), root**2
    level = np.average(values, weights=weight + 1e-9, axis=1)[:, None]
    contrast = (weight * pattern * (values - level)).sum(1) / (weight * pattern**2).sum(1).clip(1e-9)
    return CornerModel(x, level, contrast[:, None], np.ones((len(x), 1)))


def _linearised(values: Array, model: CornerModel, normal: Array, d: Array, e: Array) -> tuple[Array, Array]:
    """Residuals (n, m) and derivatives (n, m, 5) of the model, at distances d and e from the edges."""
    _, _, b, blur = model
    S, T = (erf(v / (2**0.5 * blur)) for v in (d, e))
    by_d, by_e = (b * (2 / np.pi) ** 0.5 / blur * np.exp(-((v / blur) ** 2) / 2) for v in (d, e))
    by_d, by_e = by_d * T, by_e * S
    by_x = [-(by_d * normal[:, :1, k] + by_e * normal[:, 1:, k]) for k in (0, 1)]
    J = np.stack([*by_x, np.ones_like(d), S * T, -(by_d * d + by_e * e)], -1)
    return values - model.level - b * S * T, J


def _distances(offset: Array, shape: EdgeGeometry, extent: Array, width: Array) -> tuple[Array, Array, Array]:
    """Square root of each pixel's weight, and its distances from the first and the second edge."""
    unit = shape.along / np.linalg.norm(shape.along, axis=-1, keepdims=True)
    straight = np.einsum("npk,njk->npj", offset, shape.normal)
    run = np.einsum("npk,njk->npj", offset, unit)
    d, e = np.moveaxis(straight - shape.curvature[:, None] * run**2, -1, 0)
    far = np.linalg.norm(offset, axis=-1)
    beside = np.minimum(np.abs(d), np.abs(e))
    weight = np.clip(extent[:, None] + 0.5 - far, 0, 1) * np.clip(width[:, None] + 0.5 - beside, 0, 1)
    return np.sqrt(weight), d, e
