"""Textures that photographs lack: smooth shades, repeated patterns, colour independent of luminance."""

from __future__ import annotations

import cv2
import numpy as np

from ...media.colour import REC601, to_bytes

_SIDE = 256
_LUMINANCE = np.array(REC601, np.float32)


def patterns(rng: np.random.Generator, count: int) -> list[np.ndarray]:
    """Draw `count` textures in turn: gradients, stripes, tiles, dots, noise.

    Returns:
        Arrays (256, 256, 3), uint8, RGB.
    """
    makers = (_gradient, _stripes, _tiles, _dots, _cloud)
    return [to_bytes(makers[i % len(makers)](rng)) for i in range(count)]


def recoloured(images: list[np.ndarray], rng: np.random.Generator, count: int) -> list[np.ndarray]:
    """Make textures with the luminance (contrast reduced) of one random image and the chroma of another, or
    the same; some are smoothed first.

    Args:
        images: arrays (h, w, 3), uint8, RGB, to take luminance and chroma from.
        rng: random generator.
        count: number of textures.

    Returns:
        `count` arrays (256, 256, 3), uint8, RGB.

    Raises:
        ValueError: for no images.
    """
    return [to_bytes(_mixed(images, rng)) for _ in range(count)]


def _mixed(images: list[np.ndarray], rng: np.random.Generator) -> np.ndarray:
    shape, paint = (_window(images[i], rng) for i in rng.integers(len(images), size=2))
    shape, paint = (_smoothed(p, rng) if rng.random() < 0.4 else p for p in (shape, paint))
    luminance = 0.15 + 0.7 * (shape @ _LUMINANCE)
    return luminance[..., None] + rng.uniform(0.5, 1.5) * (paint - (paint @ _LUMINANCE)[..., None])


def _window(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    h, w = image.shape[:2]
    side = min(h, w, 2 * _SIDE)
    y, x = rng.integers(h - side + 1), rng.integers(w - side + 1)
    window = cv2.resize(image[y : y + side, x : x + side], (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
    return window.astype(np.float32) / 255


def _smoothed(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), rng.uniform(4, 30))


def _colours(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.uniform(0.05, 0.95, (n, 3)).astype(np.float32)


def _grid() -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:_SIDE, :_SIDE].astype(np.float32) / _SIDE
    return x, y


def _between(colours: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return colours[0] + (colours[1] - colours[0]) * weight[..., None]


def _gradient(rng: np.random.Generator) -> np.ndarray:
    x, y = _grid()
    corners = _colours(rng, 4)
    return _between(np.stack([_between(corners[:2], x), _between(corners[2:], x)]), y)


def _stripes(rng: np.random.Generator) -> np.ndarray:
    x, _ = _grid()
    wave = 0.5 + 0.5 * np.sin(2 * np.pi * rng.integers(4, 20) * x)
    return _between(_colours(rng, 2), np.clip((wave - 0.5) * rng.uniform(1, 8) + 0.5, 0, 1))


def _tiles(rng: np.random.Generator) -> np.ndarray:
    """Bricks or checkers: each tile of its own shade, with joints."""
    rows, columns = rng.integers(3, 12, size=2)
    x, y = _grid()
    row = np.floor(y * rows)
    shifted = (x * columns + rng.choice([0, 0.5]) * (row % 2)) % columns
    shade = rng.normal(0, rng.uniform(0.02, 0.2), (rows, columns))[row.astype(int), shifted.astype(int)]
    joint = (shifted % 1 < 0.06) | (y * rows % 1 < 0.08)
    wall, mortar = _colours(rng, 2)
    return np.where(joint[..., None], mortar, wall + shade[..., None]).astype(np.float32)


def _dots(rng: np.random.Generator) -> np.ndarray:
    n, (x, y) = rng.integers(4, 14), _grid()
    distance = np.hypot(x * n % 1 - 0.5, y * n % 1 - 0.5)
    return _between(_colours(rng, 2), np.clip((rng.uniform(0.15, 0.45) - distance) * 12 + 0.5, 0, 1))


def _cloud(rng: np.random.Generator) -> np.ndarray:
    """Noise of several octaves with independent colour channels."""
    octaves: list[np.ndarray] = []
    for k in range(1, 8):
        noise = rng.normal(0, 1, (2**k, 2**k, 3)).astype(np.float32)
        wide = cv2.resize(noise, (_SIDE, _SIDE), interpolation=cv2.INTER_CUBIC)
        octaves.append(wide * rng.uniform(0.4, 0.9) ** k)
    return _colours(rng, 1)[0] + 0.2 * sum(octaves)
