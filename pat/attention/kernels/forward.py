"""Forward pass: values, statistics, and logarithms of the sums of exponentials."""

from __future__ import annotations

import math

import numpy as np

from arraygeom.runtime.compiled import compiled

from .channels import block_products, block_sums, copy, fill
from .emit import LANES
from .layout import BLOCK, of, pixel_of, pointers
from .sampling import distribute, find_samples
from .softmax import find_scores, softmax
from .vectors import fma, from_index, largest, load, maximum, mul, splat, sub, take, total, zero

LEAST_DEVIATION = np.float32(1e-4)


@compiled(nogil=True, cache=True)
def forward(call, share, outputs):
    """Compute the outputs of a share of alpha's pixels; written in place."""
    call, share, outputs = pointers(call), pointers(share), pointers(outputs)
    begin = share.first + take(share.counter) * share.size
    while begin < share.last:
        end = min(begin + share.size, share.last)
        for first in range(begin, end, BLOCK):
            _forward_block(first, min(BLOCK, end - first), call, share.block, outputs)
        begin = share.first + take(share.counter) * share.size


@compiled
def _forward_block(first, pixels, call, block, outputs):
    """Process a block of alpha's pixels."""
    d, dv = call.channels, call.value_channels
    for i in range(pixels):
        here = pixel_of(block, i)
        copy(call.query, (first + i) * d, d, here.query)
        find_samples(first + i, call.geometry, here)
    block_products(pixels, block.tap_count, block.query, block.rows, call.key, d, block.by_key)
    for i in range(pixels):
        p, here = first + i, pixel_of(block, i)
        outputs.logsum[p] = _find_weights(p, call, outputs.measured, here)
        if outputs.measured:
            _find_statistics(here, from_index(outputs.statistics, 4 * p))
    block_sums(pixels, block.tap_count, block.by_key, block.rows, call.value, dv, block.query)
    for i in range(pixels):
        copy(of(block.query, i), 0, dv, from_index(outputs.value, (first + i) * dv))


@compiled
def _find_weights(p, call, measured, here):
    """Convert the inner products of pixel p's taps to their weights, in place.

    Returns the log of the sum of exponentials.
    """
    n = here.sample_count[0]
    logsum = zero(here.by_key) - np.float32(np.inf)
    if call.geometry.nearest and n == here.tap_count[0] and n > 0:
        return _find_tap_weights(p, n, call, measured, here)
    if n > 0:
        find_scores(p, call, here)
        logsum = softmax(n, here.score, here.weight)
    if logsum == -np.inf:
        here.tap_count[0] = 0
    else:
        distribute(here.weight, call.geometry, here, here.by_key)
    return logsum


@compiled
def _find_tap_weights(p, n, call, measured, here):
    """Compute `_find_weights` where each sample has its own tap, without going to samples and back."""
    by_tap = here.by_key
    if call.biased:
        for j in range(n):
            by_tap[j] += call.bias[p * call.geometry.samples + here.index[j]]
    fill(by_tap, n, n + LANES, zero(by_tap) - np.float32(np.inf))
    logsum = softmax(n, by_tap, by_tap)
    if logsum == -np.inf:
        here.tap_count[0] = 0
    elif measured:
        copy(by_tap, 0, n + LANES, here.weight)
    return logsum


@compiled
def _find_statistics(here, statistics):
    """Write expected position, spread and largest of the weights (padded with 0); all 0 without taps."""
    nothing = zero(here.x)
    if here.tap_count[0] == 0:
        fill(statistics, 0, 4, nothing)
        return
    n = here.sample_count[0]
    x = y = squared = peak = splat(nothing)
    for j in range(0, n, LANES):
        w = load(here.weight, j)
        x = fma(w, load(here.x, j), x)
        y = fma(w, load(here.y, j), y)
    statistics[0], statistics[1] = total(x), total(y)
    x, y = splat(statistics[0]), splat(statistics[1])
    for j in range(0, n, LANES):
        w = load(here.weight, j)
        dx, dy = sub(load(here.x, j), x), sub(load(here.y, j), y)
        squared = fma(w, fma(dx, dx, mul(dy, dy)), squared)
        peak = maximum(w, peak)
    spread = math.sqrt(total(squared))
    statistics[2] = spread if spread > LEAST_DEVIATION else nothing
    statistics[3] = largest(peak)
