"""Loops along the channels: inner products with taps, weighted sums of taps, additions to them."""

from __future__ import annotations

from llvmlite.binding import get_host_cpu_features

from arraygeom.runtime.compiled import compiled

from .emit import LANES, NARROW
from .layout import BLOCK, from_pixel, of, pointers
from .vectors import (
    TAP_BLOCK,
    add_totals,
    dot_row,
    extend_row,
    fma_row,
    fma_taps,
    fold_row,
    from_index,
    gather_row,
    load_row,
    nothing_narrow,
    splat,
    store,
    store_row,
    zero,
)

ROW = 4
"""Vectors of channels that are processed at once."""
AT_ONCE = 2 if get_host_cpu_features().get("avx512f") else 1
"""Taps that are summed at once, each with its own accumulators: as registers allow."""
CHUNK = 48
"""Taps that the pixels of a block process in turn while these stay in the first cache: 16 KiB."""


# ---- one pixel -----------------------------------------------------------------------------------


@compiled
def fill(numbers, first, last, filler):
    """numbers[j] = filler for first <= j < last."""
    for j in range(first, last):
        numbers[j] = filler


@compiled
def copy(array, start, n, out):
    """out[c] = array[start + c]."""
    for c in range(n):
        out[c] = array[start + c]


@compiled
def inner_products(x, rows, first, last, image, channels, out):
    """Compute inner products: out[t] = x . image[rows[t]] for first <= t < last.

    Args:
        x: vector of `channels` numbers.
        rows: numbers of pixels; read up to a multiple of TAP_BLOCK after `first`, so padded with any pixel's.
        image: pixels of `channels` numbers, one after the other.
        out: numbers to write; from `last` up to a multiple of LANES after `first` they mean nothing.
    """
    c = 0
    for t in range(first, last, LANES):
        store(out, t, splat(zero(x)))
    while c + ROW * LANES <= channels:
        _inner_products_of_row(x, rows, first, last, image, channels, c, out)
        c += ROW * LANES
    if c < channels:
        _inner_products_of_rest(x, rows, first, last, image, channels, c, out)


@compiled
def _inner_products_of_row(x, rows, first, last, image, channels, c, out):
    row = load_row(x, c, ROW, LANES)
    for t in range(first, last, TAP_BLOCK):
        add_totals(
            out,
            t,
            dot_row(row, image, rows[t] * channels + c),
            dot_row(row, image, rows[t + 1] * channels + c),
            dot_row(row, image, rows[t + 2] * channels + c),
            dot_row(row, image, rows[t + 3] * channels + c),
        )


@compiled
def _inner_products_of_rest(x, rows, first, last, image, channels, first_channel, out):
    whole = first_channel + (channels - first_channel) // NARROW * NARROW
    for t in range(first, last, TAP_BLOCK):
        starts = rows[t] * channels, rows[t + 1] * channels, rows[t + 2] * channels, rows[t + 3] * channels
        totals = extend_row((nothing_narrow(x),), TAP_BLOCK)
        for c in range(first_channel, whole, NARROW):
            totals = fma_row(load_row(x, c, 1, NARROW)[0], gather_row(image, starts, c), totals)
        add_totals(out, t, *totals)
        for c in range(whole, channels):
            for k in range(TAP_BLOCK):
                out[t + k] += x[c] * image[starts[k] + c]


@compiled
def weighted_sum(weights, rows, first, last, image, channels, begin, end, out):
    """Add a weighted sum of pixels: out[c] += weights[t] image[rows[t], c] for begin <= c < end.

    The sum is over first <= t < last. Taps are read up to a multiple of TAP_BLOCK after `first`: beyond
    `last` weights have to be 0, and rows any pixel's, such as 0. `image` has `channels` numbers a pixel.
    """
    c = begin
    while c + ROW * LANES <= end:
        _weighted_sum_4(weights, rows, first, last, image, channels, c, out)
        c += ROW * LANES
    while c + 2 * LANES <= end:
        _weighted_sum_2(weights, rows, first, last, image, channels, c, out)
        c += 2 * LANES
    while c + NARROW <= end:
        _weighted_sum_1(weights, rows, first, last, image, channels, c, out)
        c += NARROW
    for tail in range(c, end):
        for t in range(first, last):
            out[tail] += weights[t] * image[rows[t] * channels + tail]


def _weighted_sum(n, taps, lanes):
    """Make `weighted_sum` for n vectors of channels, with accumulators for `taps` taps at a time."""
    accumulators = n * taps

    @compiled
    def sum_row(weights, rows, first, last, image, channels, c, out):
        totals = extend_row(load_row(out, c, n, lanes), accumulators)
        for t in range(first, last, taps):
            totals = fma_taps(weights, rows, t, image, channels, c, totals, n)
        store_row(out, c, fold_row(totals, n))

    return sum_row


_weighted_sum_4, _weighted_sum_2 = _weighted_sum(ROW, AT_ONCE, LANES), _weighted_sum(2, 2, LANES)
_weighted_sum_1 = _weighted_sum(1, 4, NARROW)


# ---- a block of pixels ---------------------------------------------------------------------------


@compiled
def block_products(pixels, counts, x, rows, image, channels, out):
    """Compute `inner_products` for the pixels of a block, some taps in turn: neighbours touch much the same
    pixels of beta, which then stay in the first cache."""
    for t in range(0, _most(counts, pixels), CHUNK):
        for i in range(pixels):
            last = min(t + CHUNK, of(counts, i)[0])
            inner_products(of(x, i), of(rows, i), t, last, image, channels, of(out, i))


@compiled
def block_sums(pixels, counts, weights, rows, image, channels, out):
    """Compute the `weighted_sum` of every pixel of a block, some taps in turn as in `block_products`.

    Args:
        pixels: number of pixels of the block.
        counts: number of taps of each pixel; a `Column`, as are `weights`, `rows` and `out`.
        weights: weights of each pixel's taps, padded as for `weighted_sum`.
        rows: numbers of the taps' pixels in `image`, padded likewise.
        image: beta's image, flat, `channels` numbers a pixel.
        out: sums (channels) of each pixel to write.
    """
    for i in range(pixels):
        fill(of(out, i), 0, channels, zero(out.first))
    for c in range(0, channels, ROW * LANES):
        end = min(c + ROW * LANES, channels)
        for t in range(0, _most(counts, pixels), CHUNK):
            for i in range(pixels):
                last = min(t + CHUNK, of(counts, i)[0])
                weighted_sum(of(weights, i), of(rows, i), t, last, image, channels, c, end, of(out, i))


@compiled
def _most(counts, n):
    most = 0
    for i in range(n):
        most = max(most, of(counts, i)[0])
    return most


# ---- additions to beta's pixels ------------------------------------------------------------------


@compiled(nogil=True, cache=True)
def scatter(taps, weights, last, x, channels, first_channel, last_channel, out):
    """Add to beta's pixels: out[row, c] += weight x[pixel, c] for all taps of the alpha pixels from
    `taps.first` to before `last`.

    Taps of a block are added in turn, as in `block_products`. One caller owns the channels from
    `first_channel` to before `last_channel`, so the order of additions, and with it every bit, is the same
    however many callers share the work.

    Args:
        taps: `TapList` of the pixels.
        weights: one of its two lists of weights.
        x: alpha's query or gradients by the output, all pixels, flat, `channels` numbers a pixel.
        out: gradient by beta's key or value to add to, of the same form.
    """
    taps, (weights, x, out) = pointers(taps), pointers((weights, x, out))
    for first in range(0, last - taps.first, BLOCK):
        pixels = min(BLOCK, last - taps.first - first)
        counts = from_pixel(taps.tap_count, first)
        for t in range(0, _most(counts, pixels), CHUNK):
            for i in range(pixels):
                end = min(t + CHUNK, of(counts, i)[0])
                source = from_index(x, (taps.first + first + i) * channels)
                rows, weight = of(taps.rows, first + i), of(weights, first + i)
                _scatter(rows, weight, t, end, source, channels, first_channel, last_channel, out)


@compiled
def _scatter(rows, weights, first, last, x, channels, first_channel, last_channel, out):
    c = first_channel
    while c + 2 * LANES <= last_channel:
        _scatter_2(rows, weights, first, last, x, channels, c, out)
        c += 2 * LANES
    while c + NARROW <= last_channel:
        _scatter_1(rows, weights, first, last, x, channels, c, out)
        c += NARROW
    for tail in range(c, last_channel):
        one = x[tail]
        for t in range(first, last):
            out[rows[t] * channels + tail] += weights[t] * one


def _scatter_rows(n, lanes):
    """Make `_scatter` for n vectors of channels."""

    @compiled
    def scatter_row(rows, weights, first, last, x, channels, c, out):
        row = load_row(x, c, n, lanes)
        for t in range(first, last):
            target = rows[t] * channels + c
            store_row(out, target, fma_row(weights[t], row, load_row(out, target, n, lanes)))

    return scatter_row


_scatter_2, _scatter_1 = _scatter_rows(2, LANES), _scatter_rows(1, NARROW)
