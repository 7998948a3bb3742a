"""Attention of each pixel to a window around it, for images that lie row by row, a row's channels in turn.

A sample is the same step away from every pixel, so that work on one is work on `LANES` pixels side by side:
inner products with it, and its share of the mean.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .emit import LANES, compiled
from .layout import pointers
from .softmax import exponentials
from .vectors import add, div, fma, keep_above, load, maximum, splat, store, sub

ROWS = 16
"""Rows of pixels that a thread takes at a time."""
TOGETHER = 4
"""Samples whose inner products are made together: a query is loaded once for all."""
LOWEST, LEAST = np.finfo(np.float32).min, np.finfo(np.float32).tiny
"""The lowest score, so that of -inf alone all weights are 0; and the least weight that counts."""


class Rows(NamedTuple):
    """An image: flat numbers (h, channels, w), `stride` from one row of them to the next, the first at
    `start`. As many before and behind may be read."""

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
def attend_rows(images, bias, out, window, top):
    """`ROWS` rows of `out` (channels, h, stride), flat, from `top` on: the mean of the values of the window
    by the softmax of inner products and the samples' bias. What is outside the image does not count.

    `images` are query, key and value. Rows of `out` have room for `LANES` pixels.
    """
    scores = np.empty(window.size * window.size * LANES, np.float32)
    _attend(pointers((*images, bias, out, scores)), window, top)


@compiled
def _attend(arrays, window, top):
    query, key, value, bias, out, scores = arrays
    height, width, size, spacing = window
    half, stride = size // 2, max(width, LANES)
    for y in range(top, min(top + ROWS, height)):
        above, below = min(half, y // spacing), min(half, (height - 1 - y) // spacing)
        rows, first = above + below + 1, y - above * spacing
        for block in range(0, width, LANES):
            x = max(0, min(block, width - LANES))
            for i in range(rows):
                here = i * size, (half - above + i) * size
                _score((query, key, bias, scores), (x, y, first + i * spacing), here, window)
            for j in range(size):
                _leave_out(scores, rows, j, x + (j - half) * spacing, window)
            mass = _exponentiate(scores, rows * size)
            for c in range(value.channels):
                mean = _sum((value, scores), (x, first, c), rows, window)
                store(out, (c * height + y) * stride + x, div(mean, mass))


@compiled
def _score(arrays, place, here, window):
    """The scores of one row of samples: of the pixels from (x, y) on with those in row `other`. `here` is the
    first of them among those in the image, and among all."""
    query, key, bias, scores = arrays
    x, y, other = place
    t, sample = here
    spacing, stride = window.spacing, key.stride
    own = query.start + y * query.channels * stride + x
    line = key.start + other * key.channels * stride + x - window.size // 2 * spacing
    j = 0
    while j + TOGETHER <= window.size:
        a, b = splat(bias[sample + j]), splat(bias[sample + j + 1])
        c, d = splat(bias[sample + j + 2]), splat(bias[sample + j + 3])
        for channel in range(key.channels):
            q, at = load(query.numbers, own + channel * stride), line + j * spacing + channel * stride
            a = fma(q, load(key.numbers, at), a)
            b = fma(q, load(key.numbers, at + spacing), b)
            c = fma(q, load(key.numbers, at + 2 * spacing), c)
            d = fma(q, load(key.numbers, at + 3 * spacing), d)
        store(scores, (t + j) * LANES, a)
        store(scores, (t + j + 1) * LANES, b)
        store(scores, (t + j + 2) * LANES, c)
        store(scores, (t + j + 3) * LANES, d)
        j += TOGETHER
    while j < window.size:
        a = splat(bias[sample + j])
        for channel in range(key.channels):
            q, at = load(query.numbers, own + channel * stride), line + j * spacing + channel * stride
            a = fma(q, load(key.numbers, at), a)
        store(scores, (t + j) * LANES, a)
        j += 1


@compiled
def _leave_out(scores, rows, j, x, window):
    """Sample j of each row, which is x for the first pixel, does not count for those where it is not in the
    image."""
    first, last = min(max(0, -x), LANES), max(0, min(LANES, window.width - x))
    for i in range(rows if last - first < LANES else 0):
        for lane in range(LANES):
            if lane < first or lane >= last:
                scores[(i * window.size + j) * LANES + lane] = -np.inf


@compiled
def _exponentiate(scores, n):
    """From n scores of each pixel to exp(score - the pixel's largest), in place; their sums."""
    top, mass = splat(LOWEST), splat(np.float32(0))
    for t in range(n):
        top = maximum(load(scores, t * LANES), top)
    for t in range(n):
        weight = exponentials(sub(load(scores, t * LANES), top))
        store(scores, t * LANES, weight)
        mass = add(mass, weight)
    return maximum(splat(LEAST), mass)


@compiled
def _sum(arrays, place, rows, window):
    """The weighted sum of one channel of the values."""
    value, scores = arrays
    x, first, channel = place
    size, spacing, total = window.size, window.spacing, splat(np.float32(0))
    for i in range(rows):
        line = ((first + i * spacing) * value.channels + channel) * value.stride
        at = value.start + line + x - size // 2 * spacing
        for j in range(size):
            weight = load(scores, (i * size + j) * LANES)
            seen = keep_above(weight, splat(LEAST), load(value.numbers, at + j * spacing))
            total = fma(weight, seen, total)
    return total
