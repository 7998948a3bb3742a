"""Samples of an alpha pixel, the pixels of beta that they touch (*taps*), and conversion between both."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from arraygeom.runtime.compiled import compiled

from .channels import fill
from .emit import LANES
from .vectors import (
    TAP_BLOCK,
    add,
    add_fours,
    add_int,
    converted,
    fma,
    from_index,
    load,
    load_fours,
    maximum,
    minimum,
    minimum_int,
    mul,
    mul_int,
    splat,
    store,
    store_four,
    sub,
    truncated,
    zero,
)

ONE, HALF = np.float32(1), np.float32(0.5)
"""Constants in float32, so that no float32 result becomes float64."""


@compiled
def find_samples(p, geometry, here):
    """Find the samples and taps of pixel p; written in place."""
    here.sample_count[0] = n = _collect(p, geometry, here)
    first = p // geometry.alpha_pixels * (geometry.height * geometry.width)
    here.tap_count[0] = _find_taps(n, first, geometry, here) if n > 0 else 0


# ---- samples -------------------------------------------------------------------------------------


@compiled
def _on_image(x, y, geometry, slack):
    low = -HALF - slack
    return (x >= low) & (y >= low) & (x <= geometry.last_x - low) & (y <= geometry.last_y - low)


@compiled
def _collect(p, geometry, here):
    """Positions of the samples of pixel p that count, padded with 0. Returns their number."""
    pixel = p % geometry.alpha_pixels if geometry.shared else p
    if geometry.straight:
        n = _collect_segment(pixel, geometry, here) if geometry.mask[pixel] else 0
    else:
        n = _collect_positions(pixel, geometry, here)
    store(here.x, n, splat(zero(here.x)))
    store(here.y, n, splat(zero(here.y)))
    return n


@compiled
def _collect_positions(pixel, geometry, here):
    points = from_index(geometry.points, 2 * pixel * geometry.samples)
    mask = from_index(geometry.mask, pixel * geometry.samples)
    n = 0
    for i in range(geometry.samples):
        x, y = points[2 * i], points[2 * i + 1]
        here.index[n], here.x[n], here.y[n] = i, x, y
        n += (mask[i] != 0) & _on_image(x, y, geometry, geometry.slack)
    return n


@compiled
def _collect_segment(pixel, geometry, here):
    x0, y0 = geometry.points[4 * pixel], geometry.points[4 * pixel + 1]
    dx, dy = geometry.points[4 * pixel + 2] - x0, geometry.points[4 * pixel + 3] - y0
    _divide(x0, dx, geometry, here.x)
    _divide(y0, dy, geometry, here.y)
    exactly = geometry.slack - geometry.slack
    if _on_image(x0, y0, geometry, exactly) & _on_image(x0 + dx, y0 + dy, geometry, exactly):
        for i in range(geometry.samples):
            here.index[i] = i
        return geometry.samples
    n = 0
    for i in range(geometry.samples):
        x, y = here.x[i], here.y[i]
        here.index[n], here.x[n], here.y[n] = i, x, y
        n += _on_image(x, y, geometry, geometry.slack)
    return n


@compiled
def _divide(start, along, geometry, out):
    """start + fraction · along, rounded as torch rounds it (no fused multiply-add)."""
    for i in range(0, geometry.samples, LANES):
        store(out, i, add(splat(start), mul(load(geometry.fractions, i), splat(along))))


# ---- taps ----------------------------------------------------------------------------------------


@compiled
def _find_taps(n, first, geometry, here):
    """Find the taps of n samples.

    Returns their number. `first` is the index of the first pixel of this beta.
    """
    if geometry.nearest:
        m = _find_pixels(n, np.int32(first), geometry, here)
    else:
        m = _find_corners(n, np.int32(first), geometry, here)
    for t in range(m, m + TAP_BLOCK):
        here.rows[t] = here.rows[m - 1]
    return m


@compiled
def _find_pixels(n, first, geometry, here):
    """Pixels that samples lie on, equal neighbours once. If as many as samples, each has its own."""
    half, width, first = splat(HALF + zero(here.x)), splat(np.int32(geometry.width)), splat(first)
    last_x, last_y = splat(np.int32(geometry.width - 1)), splat(np.int32(geometry.height - 1))
    for j in range(0, n, LANES):
        x = minimum_int(truncated(add(load(here.x, j), half)), last_x)
        y = minimum_int(truncated(add(load(here.y, j), half)), last_y)
        store(here.rows, j, add_int(add_int(mul_int(y, width), x), first))
    if geometry.straight and n > 1 and max(abs(here.x[1] - here.x[0]), abs(here.y[1] - here.y[0])) >= ONE:
        return n
    m = 0
    before = np.int32(-1)
    for j in range(n):
        row = here.rows[j]
        m += row != before
        before = row
        here.rows[m - 1] = row
        here.tap[j] = m - 1
    return m


class Course(NamedTuple):
    """Main direction in beta of a pixel's samples, from the first to the last.

    Attributes:
        steep: True along y, False along x.
        backward: True if the coordinate falls.
    """

    steep: Any
    backward: Any


@compiled
def course_of(n, here):
    """Return the course of n samples."""
    along_x, along_y = here.x[n - 1] - here.x[0], here.y[n - 1] - here.y[0]
    steep = abs(along_y) > abs(along_x)
    return Course(steep, along_y < 0 if steep else along_x < 0)


@compiled
def _find_corners(n, first, geometry, here):
    """Find a cell's four taps in a row: two behind, then two ahead, as the samples run.

    A sample one cell further shares its first two with the last two of the sample before.
    """
    course = course_of(n, here)
    width = np.int32(geometry.width)
    right, down = np.int32(min(1, geometry.width - 1)), np.int32(min(1, geometry.height - 1)) * width
    ahead, aside = (down, right) if course.steep else (right, down)
    _find_cells(n, first, geometry, here, course)
    if course.backward:
        first_tap, ahead = ahead, -ahead
    else:
        first_tap = np.int32(0)
    offsets = first_tap, first_tap + aside, first_tap + ahead, first_tap + ahead + aside
    tap, before = np.int32(0), here.cell[0]
    for j in range(n):
        cell = here.cell[j]
        tap += np.int32(0) if cell == before else np.int32(2) if cell - before == ahead else np.int32(4)
        before = cell
        store_four(here.rows, tap, cell, offsets)
        here.tap[j] = tap
    fill(here.tap, n, n + LANES, tap)
    return np.int64(tap) + 4


@compiled
def _find_cells(n, first, geometry, here, course):
    """Cell of each sample, as the index of its upper left pixel, and the position ahead and aside in it."""
    nothing, one = splat(zero(here.x)), splat(ONE + zero(here.x))
    last_x, last_y = splat(geometry.last_x), splat(geometry.last_y)
    cell_x, cell_y = splat(np.int32(max(geometry.width - 2, 0))), splat(np.int32(max(geometry.height - 2, 0)))
    width, first = splat(np.int32(geometry.width)), splat(first)
    across, down = (here.aside, here.ahead) if course.steep else (here.ahead, here.aside)
    for j in range(0, n, LANES):
        x = minimum(maximum(load(here.x, j), nothing), last_x)
        y = minimum(maximum(load(here.y, j), nothing), last_y)
        cx, cy = minimum_int(truncated(x), cell_x), minimum_int(truncated(y), cell_y)
        store(across, j, sub(x, converted(cx, x)))
        store(down, j, sub(y, converted(cy, y)))
        store(here.cell, j, add_int(add_int(mul_int(cy, width), cx), first))
    if course.backward:
        for j in range(0, n, LANES):
            store(here.ahead, j, sub(one, load(here.ahead, j)))


# ---- between taps and samples --------------------------------------------------------------------


@compiled
def interpolate(by_tap, geometry, here, out):
    """Interpolate numbers on taps (pixels of beta) at a pixel's samples.

    Args:
        by_tap: number of each tap.
        geometry: `Geometry` of the call: nearest look-up or bilinear.
        here: the pixel's part of the `Block`, after `find_samples`.
        out: number of each sample to write, with room up to a multiple of LANES.
    """
    n, m = here.sample_count[0], here.tap_count[0]
    if geometry.nearest:
        if m == n:
            for j in range(0, n, LANES):
                store(out, j, load(by_tap, j))
        else:
            for j in range(n):
                out[j] = by_tap[here.tap[j]]
        return
    for j in range(0, n, LANES):
        ahead, aside = load(here.ahead, j), load(here.aside, j)
        a, b, c, d = load_fours(by_tap, here.tap, j)
        behind, before = fma(aside, sub(b, a), a), fma(aside, sub(d, c), c)
        store(out, j, fma(ahead, sub(before, behind), behind))


@compiled
def distribute(numbers, geometry, here, by_tap):
    """Distribute numbers on a pixel's samples to its taps: the transpose of `interpolate`.

    Args:
        numbers: number of each sample, padded with 0 to a multiple of LANES.
        geometry: `Geometry` of the call.
        here: the pixel's part of the `Block`, after `find_samples`.
        by_tap: number of each tap to write, padded with 0; with room for `TAP_BLOCK` more, up to a multiple
            of LANES.
    """
    n, m = here.sample_count[0], here.tap_count[0]
    if geometry.nearest and m == n:
        for j in range(0, n, LANES):
            store(by_tap, j, load(numbers, j))
        fill(by_tap, n, n + TAP_BLOCK, zero(by_tap))
        return
    for t in range(0, m + TAP_BLOCK, LANES):
        store(by_tap, t, splat(zero(by_tap)))
    if geometry.nearest:
        for j in range(n):
            by_tap[here.tap[j]] += numbers[j]
        return
    for j in range(0, n, LANES):
        number, ahead, aside = load(numbers, j), load(here.ahead, j), load(here.aside, j)
        before = mul(ahead, number)
        behind = sub(number, before)
        b, d = mul(aside, behind), mul(aside, before)
        add_fours(by_tap, here.tap, j, sub(behind, b), b, sub(before, d), d)


@compiled
def interpolation_slopes(j, course, here, by_tap):
    """Return the derivatives of the interpolated number by x and y, at sample j."""
    u, v, t = here.ahead[j], here.aside[j], here.tap[j]
    a, b, c, d = by_tap[t], by_tap[t + 1], by_tap[t + 2], by_tap[t + 3]
    ahead, aside = (ONE - v) * (c - a) + v * (d - b), (ONE - u) * (b - a) + u * (d - c)
    ahead = -ahead if course.backward else ahead
    return (aside, ahead) if course.steep else (ahead, aside)
