"""Attention of each pixel to a window around it, for images that lie row by row, a row's channels in turn.

A sample is the same step away from every pixel, so that work on one is work on `LANES` pixels side by side:
inner products with it, and its share of the mean.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .emit import LANES, compiled
from .layout import of, pointers
from .softmax import exponentials
from .vectors import add, fma, from_index, load, maximum, splat, store, sub

ROWS = 16
"""Rows of pixels that a thread takes at a time."""
TOGETHER = 4
"""Samples whose inner products are made together: a query is loaded once for all."""
LOWEST = np.finfo(np.float32).min
"""What scores are compared with at least: of -inf alone all weights are 0."""


class Rows(NamedTuple):
    """An image: flat numbers (h, channels, w), `stride` from one row of numbers to the next, the first at
    `start`. As many before and behind are there to be read."""

    numbers: Any
    start: int
    channels: int
    stride: int


class Window(NamedTuple):
    """`size` x `size` samples around each pixel of an image, `spacing` pixels apart."""

    height: int
    width: int
    size: int
    spacing: int


@compiled(nogil=True, cache=True, fastmath={"contract"})
def attend_rows(query, key, value, out, bias, window, top):
    """`ROWS` rows of `out` (channels, h, w), from `top` on: the mean of the values of the window by the
    softmax of inner products and the samples' bias. What is outside the image does not count."""
    height, width, size, spacing = window
    scores = np.empty((size * size, LANES), np.float32)
    found = np.empty((2, LANES), np.float32)
    for y in range(top, min(top + ROWS, height)):
        above, below = min(size // 2, y // spacing), min(size // 2, (height - 1 - y) // spacing)
        rows, first = above + below + 1, y - above * spacing
        weights = scores[: rows * size]
        of_samples = bias[(size // 2 - above) * size :]
        for block in range(0, width, LANES):
            x = max(0, min(block, width - LANES))
            for i in range(rows):
                _score(
                    pointers((query.numbers, key.numbers, weights, of_samples)),
                    query.start + y * query.channels * query.stride + x,
                    key.start + (first + i * spacing) * key.channels * key.stride + x,
                    i * size,
                    (key.channels, key.stride),
                    window,
                )
            left, right = _whole(x, window)
            for j in range(size):
                if j < left or j >= right:
                    start, end = _inside(x + (j - size // 2) * spacing, width)
                    for i in range(rows):
                        weights[i * size + j, :start] = -np.inf
                        weights[i * size + j, end:] = -np.inf
            _exponentiate(pointers((weights, found[1])), len(weights))
            for c in range(value.channels):
                line = value.start + (first * value.channels + c) * value.stride + x - size // 2 * spacing
                further = spacing * value.channels * value.stride
                _average(pointers((value.numbers, weights, found[0])), (line, further, rows), (left, right), window)
                for j in range(size):
                    if j < left or j >= right:
                        start, end = _inside(x + (j - size // 2) * spacing, width)
                        for i in range(rows):
                            at = line + i * further + j * spacing
                            for lane in range(start, end):
                                found[0, lane] += weights[i * size + j, lane] * value.numbers[at + lane]
                for lane in range(min(LANES, width)):
                    mass = found[1, lane]
                    out[c, y, x + lane] = found[0, lane] / (mass if mass != 0 else np.float32(1))


@compiled
def _whole(x, window):
    """The first of a row's samples that is in the image for all lanes from x on, and the end of these."""
    _, width, size, spacing = window
    reach = size // 2 * spacing
    left = min(max(0, -((x - reach) // spacing)), size)
    return left, max(left, min(size, (width - LANES - x + reach) // spacing + 1))


@compiled
def _inside(x, width):
    """The first of the lanes from x on that are in the image, and the end of these."""
    return min(max(0, -x), LANES), max(0, min(LANES, width - x))


@compiled
def _score(arrays, own, others, t, channels, window):
    """The scores of one row of samples, from sample t on: `own` is where the queries are, `others` the keys
    beside them."""
    query, key, scores, bias = arrays
    _, _, size, spacing = window
    channels, stride = channels
    others -= size // 2 * spacing
    j = 0
    while j + TOGETHER <= size:
        at = others + j * spacing
        a, b = splat(bias[t + j]), splat(bias[t + j + 1])
        c, d = splat(bias[t + j + 2]), splat(bias[t + j + 3])
        for channel in range(channels):
            q, k = load(query, own + channel * stride), at + channel * stride
            a = fma(q, load(key, k), a)
            b = fma(q, load(key, k + spacing), b)
            c = fma(q, load(key, k + 2 * spacing), c)
            d = fma(q, load(key, k + 3 * spacing), d)
        store(of(scores, t + j), 0, a)
        store(of(scores, t + j + 1), 0, b)
        store(of(scores, t + j + 2), 0, c)
        store(of(scores, t + j + 3), 0, d)
        j += TOGETHER
    while j < size:
        a = splat(bias[t + j])
        for channel in range(channels):
            here = channel * stride
            a = fma(load(query, own + here), load(key, others + j * spacing + here), a)
        store(of(scores, t + j), 0, a)
        j += 1


@compiled
def _average(arrays, lines, whole, window):
    """The sums of the values in one channel of the samples that are in the image for all pixels."""
    value, scores, out = arrays
    line, further, rows = lines
    left, right = whole
    mean = splat(np.float32(0))
    for i in range(rows):
        for j in range(left, right):
            at = line + i * further + j * window.spacing
            mean = fma(load(of(scores, i * window.size + j), 0), load(value, at), mean)
    store(out, 0, mean)


@compiled
def _exponentiate(arrays, n):
    """From n scores of each pixel to exp(score - the pixel's largest), in place, and their sums."""
    scores, total = arrays
    top, mass = splat(LOWEST), splat(np.float32(0))
    for t in range(n):
        top = maximum(load(of(scores, t), 0), top)
    for t in range(n):
        weight = exponentials(sub(load(of(scores, t), 0), top))
        store(of(scores, t), 0, weight)
        mass = add(mass, weight)
    store(total, 0, mass)
