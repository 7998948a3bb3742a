"""Backward pass: gradients of alpha's pixels, and weights with which `scatter` adds to beta's."""

from __future__ import annotations

import numpy as np

from arraygeom.runtime.compiled import compiled

from .channels import block_products, block_sums, copy, fill
from .emit import LANES
from .layout import BLOCK, Taps, from_pixel, of, pixel_of, pointers, replaced
from .sampling import HALF, course_of, distribute, find_samples, interpolate, interpolation_slopes
from .softmax import exponentiate, find_scores
from .vectors import fma, from_index, load, mul, splat, store, sub, take, total, zero


@compiled(nogil=True, cache=True)
def backward(call, saved, share, taps, gradients):
    """Compute the gradients of a share of alpha's pixels, and their weighted taps; written in place.

    Args:
        call: inputs of attention (`Call`).
        saved: results of `forward`, and gradients by them (`Saved`).
        share: pixels of this caller (`Share`).
        taps: `TapList` to write: beta's pixels and weights, which `scatter` adds up later.
        gradients: `Gradients` to write, of query, points and bias.
    """
    call, saved, share, taps, gradients = pointers((call, saved, share, taps, gradients))
    begin = share.first + take(share.counter) * share.size
    while begin < share.last:
        end = min(begin + share.size, share.last)
        for first in range(begin, end, BLOCK):
            _backward_block(first, min(BLOCK, end - first), call, saved, share.block, taps, gradients)
        begin = share.first + take(share.counter) * share.size


@compiled
def _backward_block(first, pixels, call, saved, block, taps, gradients):
    """Process a block of alpha's pixels."""
    d, dv = call.channels, call.value_channels
    slot = first - taps.first
    block = replaced(block, Taps(from_pixel(taps.tap_count, slot), from_pixel(taps.rows, slot)))
    key_weight, value_weight = from_pixel(taps.key_weight, slot), from_pixel(taps.value_weight, slot)
    for i in range(pixels):
        p, here = first + i, pixel_of(block, i)
        copy(call.query, p * d, d, here.query)
        copy(saved.value_upstream, p * dv, dv, here.upstream)
        here.tap_count[0] = 0
        if saved.logsum[p] > -np.inf:
            find_samples(p, call.geometry, here)
    block_products(pixels, block.tap_count, block.query, block.rows, call.key, d, block.by_key)
    block_products(pixels, block.tap_count, block.upstream, block.rows, call.value, dv, block.by_value)
    for i in range(pixels):
        here = pixel_of(block, i)
        if here.tap_count[0] > 0:
            _backward_pixel(first + i, call, saved, here, gradients)
            distribute(here.weight, call.geometry, here, of(value_weight, i))
            distribute(here.score_slope, call.geometry, here, of(key_weight, i))
    if gradients.wants_query:
        block_sums(pixels, block.tap_count, key_weight, block.rows, call.key, d, block.query)
        for i in range(pixels):
            copy(of(block.query, i), 0, d, from_index(gradients.query, (first + i) * d))


@compiled
def _backward_pixel(p, call, saved, here, gradients):
    """Recompute the weights of pixel p, and the gradients by weights, scores, points and bias."""
    n, samples = here.sample_count[0], call.geometry.samples
    statistics = from_index(saved.statistics, saved.step * p)
    upstream = from_index(saved.statistics_upstream, saved.step * p)
    find_scores(p, call, here)
    exponentiate(n, here.score, here.weight, saved.logsum[p])
    interpolate(here.by_value, call.geometry, here, here.slope)
    _score_gradient(n, here, statistics, upstream)
    if gradients.wants_points:
        _position_gradient(p, n, call.geometry, here, statistics, upstream, gradients.points)
    if gradients.wants_bias:
        for j in range(n):
            gradients.bias[p * samples + here.index[j]] = here.score_slope[j]


@compiled
def _score_gradient(n, here, statistics, upstream):
    """Convert gradients by the weights to gradients by the scores.

    `slope` holds the gradients by the values' weights.
    """
    nothing = zero(upstream)
    x, y, spread = statistics[0], statistics[1], statistics[2]
    gx, gy, gspread = upstream[0], upstream[1], upstream[2]
    pull = HALF * gspread / spread if spread > 0 else nothing
    if gx != 0 or gy != 0 or pull != 0:
        for j in range(n):
            away = (here.x[j] - x) ** 2 + (here.y[j] - y) ** 2
            here.slope[j] += gx * here.x[j] + gy * here.y[j] + pull * away
    if upstream[3] != 0:
        best = 0
        for j in range(1, n):
            best = j if here.weight[j] > here.weight[best] else best
        here.slope[best] += upstream[3]
    fill(here.slope, n, n + LANES, nothing)
    mean = splat(nothing)
    for j in range(0, n, LANES):
        mean = fma(load(here.weight, j), load(here.slope, j), mean)
    mean = splat(total(mean))
    for j in range(0, n, LANES):
        store(here.score_slope, j, mul(load(here.weight, j), sub(load(here.slope, j), mean)))


@compiled
def _position_gradient(p, n, geometry, here, statistics, upstream, out):
    """Gradients by the positions of the samples, and by the points that define them."""
    nothing = zero(upstream)
    centre_x, centre_y, spread = statistics[0], statistics[1], statistics[2]
    gx, gy, gspread = upstream[0], upstream[1], upstream[2]
    pull = gspread / spread if spread > 0 else nothing
    x0 = y0 = x1 = y1 = nothing
    course = course_of(n, here)
    for j in range(n):
        x, y, w = here.x[j], here.y[j], here.weight[j]
        dx, dy = w * (gx + pull * (x - centre_x)), w * (gy + pull * (y - centre_y))
        if not geometry.nearest:
            kx, ky = interpolation_slopes(j, course, here, here.by_key)
            vx, vy = interpolation_slopes(j, course, here, here.by_value)
            dx += here.score_slope[j] * kx + w * vx if (x >= nothing) & (x <= geometry.last_x) else nothing
            dy += here.score_slope[j] * ky + w * vy if (y >= nothing) & (y <= geometry.last_y) else nothing
        i = here.index[j]
        if geometry.straight:
            u = geometry.fractions[i]
            x1, y1 = x1 + u * dx, y1 + u * dy
            x0, y0 = x0 + dx - u * dx, y0 + dy - u * dy
        else:
            offset = 2 * (p * geometry.samples + i)
            out[offset], out[offset + 1] = dx, dy
    if geometry.straight:
        out[4 * p], out[4 * p + 1], out[4 * p + 2], out[4 * p + 3] = x0, y0, x1, y1
