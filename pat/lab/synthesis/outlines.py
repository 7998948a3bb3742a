"""Random outlines of layers as signed distances: blobs, polygons, rods, fences, branches, shapes
with holes."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

_FINE = 384
SIDE = 96
_BORDER = 2 * _FINE // SIDE


@functools.cache
def outlines(count: int, seed: int) -> Float[Tensor, "count 1 side side"]:
    """Draw random outlines as signed distance maps, positive inside, on the square [-1, 1]^2 (side length 2).

    The border is always outside, so that positions may be clamped to the square.

    Returns:
        Maps (count, 1, 96, 96), float32, distances in the square's units; cached for the process: not to be
        modified.
    """
    rng = np.random.default_rng(seed)
    makers = (_blob, _polygon, _cloud, _rods, _fence, _branches, _box)
    shares = np.array([4, 3, 1.5, 1, 0.6, 1, 4])
    chosen = rng.choice(len(makers), size=count, p=shares / shares.sum())
    return torch.from_numpy(np.stack([_distance(_holed(makers[i](rng), rng)) for i in chosen])[:, None])


def _distance(mask: np.ndarray) -> np.ndarray:
    mask[:_BORDER] = mask[-_BORDER:] = 0
    mask[:, :_BORDER] = mask[:, -_BORDER:] = 0
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5)
    signed = np.where(mask > 0, inside - 0.5, 0.5 - outside).astype(np.float32) * (2 / _FINE)
    return cv2.resize(signed, (SIDE, SIDE), interpolation=cv2.INTER_AREA)


def _filled(points: np.ndarray) -> np.ndarray:
    return cv2.fillPoly(np.zeros((_FINE, _FINE), np.uint8), [_pixels(points)], (1,))


def _pixels(points: np.ndarray) -> np.ndarray:
    return np.round((points + 1) * (_FINE / 2) - 0.5).astype(np.int32)


def _line(mask: np.ndarray, ends: np.ndarray, width: int) -> None:
    start, end = _pixels(ends).tolist()
    cv2.line(mask, start, end, (1,), thickness=width)


def _polar(radius: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)


def _blob(rng: np.random.Generator) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    k = np.arange(1, 8)[:, None]
    waves = rng.normal(0, rng.uniform(0.1, 0.5), (7, 1)) / k * np.cos(k * angle + rng.uniform(0, 6.3, (7, 1)))
    radius = np.exp(waves.sum(0))
    return _filled(_polar(0.95 * radius / radius.max(), angle))


def _polygon(rng: np.random.Generator) -> np.ndarray:
    n = rng.integers(3, 9)
    angle = np.sort(rng.uniform(0, 2 * np.pi, n)) * 0.5 + np.linspace(0, 2 * np.pi, n, endpoint=False) * 0.5
    return _filled(_polar(rng.uniform(0.35, 0.95, n), angle))


def _box(rng: np.random.Generator) -> np.ndarray:
    w, h = rng.uniform(0.3, 0.95, 2)
    return _filled(np.array([[-w, -h], [w, -h], [w, h], [-w, h]]))


def _cloud(rng: np.random.Generator) -> np.ndarray:
    """Thresholded noise inside a disc: foliage, holes, islands."""
    n = int(rng.integers(4, 14))
    coarse = rng.normal(0, 1, (n, n)).astype(np.float32)
    noise = cv2.resize(coarse, (_FINE, _FINE), interpolation=cv2.INTER_CUBIC)
    y, x = np.mgrid[-1 : 1 : _FINE * 1j, -1 : 1 : _FINE * 1j]
    return (noise + 2 * (0.75 - np.hypot(x, y)) > 0.2).astype(np.uint8)


def _rods(rng: np.random.Generator) -> np.ndarray:
    mask = np.zeros((_FINE, _FINE), np.uint8)
    for ends in rng.uniform(-0.95, 0.95, (rng.integers(1, 5), 2, 2)):
        _line(mask, ends, int(rng.integers(8, 22)))
    return mask


def _fence(rng: np.random.Generator) -> np.ndarray:
    n, thick = rng.integers(3, 8), rng.uniform(0.12, 0.4)
    phase = np.arange(_FINE) * n / _FINE % 1 < thick
    mask = np.repeat(phase[None], _FINE, 0)
    return (mask | phase[:, None] if rng.random() < 0.4 else mask).astype(np.uint8)


def _branches(rng: np.random.Generator) -> np.ndarray:
    mask = np.zeros((_FINE, _FINE), np.uint8)
    _grow(mask, rng, np.array([0.0, 0.95]), -np.pi / 2 + rng.normal(0, 0.2), 0.6, 20)
    return mask


def _grow(
    mask: np.ndarray, rng: np.random.Generator, start: np.ndarray, angle: float, length: float, width: int
) -> None:
    if width < 5:
        return
    end = start + length * np.array([np.cos(angle), np.sin(angle)])
    _line(mask, np.stack([start, end]), width)
    for _ in range(rng.integers(2, 4)):
        _grow(mask, rng, end, angle + rng.normal(0, 0.6), length * rng.uniform(0.6, 0.85), width - 5)


def _holed(mask: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if rng.random() < 0.2:
        centre = _pixels(rng.uniform(-0.4, 0.4, 2)).tolist()
        cv2.circle(mask, centre, int(rng.integers(15, 60)), (0,), thickness=-1)
    return mask
