"""Attention of each pixel to a window around it, for images with channels first.

A sample is the same step away from every pixel, so that work on one is work on a whole row of pixels side by
side: inner products with it, and its share of the mean.
"""

from __future__ import annotations

import numpy as np

from arraygeom.runtime.compiled import compiled

from .emit import LANES
from .layout import of, pointers
from .softmax import exponentials
from .vectors import add, load, maximum, splat, store, sub

ROWS = 16
"""Rows of pixels that a thread takes at a time."""
LOWEST = np.finfo(np.float32).min
"""Lower bound of the largest score: pixels whose scores are all -inf get weights of 0."""


@compiled(nogil=True, cache=True, fastmath={"contract"})
def attend_rows(query, key, value, out, logsum, bias, which, size, spacing, top):
    """Attend to windows, for `ROWS` rows of one image from `top` on: softmax-weighted means of the values.

    Samples outside the image do not count, nor do samples with a score of -inf.

    Args:
        query: features (d, h, w) of alpha, float32.
        key: features (d, h, w) of beta.
        value: values (dv, h, w) of beta.
        out: means (dv, h, w) to write; 0 where no sample counts.
        logsum: logs of the sums of exponentials (h, w) to write; inf where no sample counts.
        bias: score (size²) added to each sample.
        which: samples of the window to use, numbered row by row.
        size: samples per side of the window, an odd number.
        spacing: pixels between samples, a whole number.
        top: first row.
    """
    channels, height, width = query.shape
    scores = np.empty((len(which), -(-width // LANES) * LANES), np.float32)
    total, top_score = np.empty(scores.shape[1], np.float32), np.empty(scores.shape[1], np.float32)
    for y in range(top, min(top + ROWS, height)):
        scores[:] = -np.inf
        for i, t in enumerate(which):
            row, first, last, step = _sampled(t, y, size, spacing, height, width)
            score = scores[i, first:last]
            score[:] = bias[t]
            for c in range(channels):
                query_row, sampled_row = query[c, y, first:last], key[c, row, first + step : last + step]
                for x in range(last - first):
                    score[x] += query_row[x] * sampled_row[x]
        _exponentiate(pointers((scores, total, top_score)), scores.shape)
        for x in range(width):
            logsum[y, x] = top_score[x] + np.log(total[x]) if total[x] != 0 else np.inf
        for c in range(len(value)):
            mean = out[c, y]
            mean[:] = 0
            for i, t in enumerate(which):
                row, first, last, step = _sampled(t, y, size, spacing, height, width)
                weight, sampled_row = scores[i, first:last], value[c, row, first + step : last + step]
                inner = mean[first:last]
                for x in range(last - first):
                    inner[x] += weight[x] * sampled_row[x]
            for x in range(width):
                mean[x] /= total[x] if total[x] != 0 else np.float32(1)


@compiled
def _sampled(t, y, size, spacing, height, width):
    """Row of sample t for the pixels of row y, the first pixel for which it is in the image, the end of
    these, and the sample's distance to the right."""
    row, step = y + (t // size - size // 2) * spacing, (t % size - size // 2) * spacing
    first, last = max(0, -step), min(width, width - step)
    if row < 0 or row >= height or first >= last:
        return 0, 0, 0, 0
    return row, first, last, step


@compiled
def _exponentiate(rows, shape):
    """Replace scores (samples, pixels) by exp(score - the pixel's largest), in place; writes their sums and
    the largest."""
    scores, total, top_score = rows
    for x in range(0, shape[1], LANES):
        top, mass = splat(LOWEST), splat(np.float32(0))
        for t in range(shape[0]):
            top = maximum(load(of(scores, t), x), top)
        for t in range(shape[0]):
            weight = exponentials(sub(load(of(scores, t), x), top))
            store(of(scores, t), x, weight)
            mass = add(mass, weight)
        store(total, x, mass)
        store(top_score, x, top)


@compiled(nogil=True, cache=True, fastmath={"contract"})
def differentiate_rows(query, key, value, upstream, sums, gradients, wanted, bias, which, size, spacing, top):
    """Differentiate `attend_rows` by query, key and value, for up to `ROWS` rows.

    A pixel is a sample of as many pixels as it has samples: with the roles of the two exchanged, gradients
    of keys and values are gathered, too.

    Args:
        query: features (d, h, w) of alpha; `key`, `value`, `bias`, `which`, `size`, `spacing` and `top` as
            for `attend_rows`.
        upstream: gradient (dv, h, w) by the means.
        sums: planes (2, h, w): `logsum`, and the inner product of `upstream` with the means.
        gradients: gradients by query, key and value to add to.
        wanted: three flags, True for a gradient to compute.
    """
    (channels, height, width), (by_query, by_key, by_value) = query.shape, gradients
    weight, slope = np.zeros((2, -(-width // LANES) * LANES), np.float32)
    for y in range(top, min(top + ROWS, height)):
        for t in which:
            row, first, last, step = _sampled(t, y, size, spacing, height, width)
            if wanted[0] and last > first:
                here, there = (y, first, last), (row, first + step, last + step)
                _weigh(query, key, value, upstream, sums, bias[t], here, there, weight, slope)
                for c in range(channels):
                    _accumulate(by_query[c, y, first:last], slope, key[c, row, first + step : last + step])
            row, first, last, step = _sampled(size * size - 1 - t, y, size, spacing, height, width)
            if (wanted[1] or wanted[2]) and last > first:
                here, there = (row, first + step, last + step), (y, first, last)
                _weigh(query, key, value, upstream, sums, bias[t], here, there, weight, slope)
                for c in range(channels if wanted[1] else 0):
                    _accumulate(by_key[c, y, first:last], slope, query[c, row, first + step : last + step])
                for c in range(len(value) if wanted[2] else 0):
                    _accumulate(
                        by_value[c, y, first:last], weight, upstream[c, row, first + step : last + step]
                    )


@compiled
def _weigh(query, key, value, upstream, sums, bias, here, there, weight, slope):
    """Weights of the pixels `there` (row, first, last) for the pixels `here`, and the gradients by scores."""
    (y, first, last), (row, start, stop) = here, there
    count = last - first
    logsum, mean_slope = sums[0, y, first:last], sums[1, y, first:last]
    for x in range(count):
        weight[x] = bias - logsum[x]
        slope[x] = -mean_slope[x]
    for c in range(len(query)):
        _accumulate(weight[:count], query[c, y, first:last], key[c, row, start:stop])
    for c in range(len(value)):
        _accumulate(slope[:count], upstream[c, y, first:last], value[c, row, start:stop])
    (at,) = pointers((weight,))
    for x in range(0, count, LANES):
        store(at, x, exponentials(load(at, x)))
    for x in range(count):
        slope[x] *= weight[x]


@compiled
def _accumulate(total, factor, row):
    """Add the products of two rows."""
    for x in range(len(total)):
        total[x] += factor[x] * row[x]
