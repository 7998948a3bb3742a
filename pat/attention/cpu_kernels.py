"""The compiled loops of the CPU backend. All in one file: numba's cache watches only the file of the entry point.

The work on one alpha pixel is done on *taps*, the pixels of beta that its samples touch. Neighbouring samples share
them (a bilinear look-up has four, of which the next sample usually needs two again), so all work along the
channels is done once a tap: inner products of the query with its taps, sums of taps with weights, and in backward
the addition of the query to the taps' gradients. Everything else is scalar work on samples.

Pictures come channels-last and flat. The numbers in them are float64, float32, or 16-bit ones seen as integers:
uint16 is bfloat16, int16 is float16. Arithmetic is in float64 for the first and in float32 for the others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

LANES = 8
TAP_BLOCK = 4
EDGE_SLACK = np.float32(1e-3)
LEAST_SPREAD = np.float32(1e-4)
SUMS = {"reassoc", "contract", "nsz"}
"""What may be done to sums so that they are vectorised: another order of additions, a fixed one."""


# ---- eight numbers at a time ---------------------------------------------------------------------------------


class Vector(types.Type):
    """`LANES` numbers of the accumulation type in one register (or two)."""

    def __init__(self, scalar):
        self.scalar = scalar
        super().__init__(name=f"Vector({scalar})")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        lane = ir.DoubleType() if kind.scalar == types.float64 else ir.FloatType()
        super().__init__(manager, kind, ir.VectorType(lane, LANES))


def _accumulated(dtype):
    return types.float64 if dtype == types.float64 else types.float32


def _widen(builder, stored, dtype, lanes):
    """A stored number, or a vector of them, in the accumulation type."""

    def shape(lane):
        return ir.VectorType(lane, lanes) if lanes > 1 else lane

    if dtype == types.uint16:
        sixteen = shape(ir.IntType(32))(([16] * lanes) if lanes > 1 else 16)
        return builder.bitcast(
            builder.shl(builder.zext(stored, shape(ir.IntType(32))), sixteen), shape(ir.FloatType())
        )
    if dtype == types.int16:
        return builder.fpext(builder.bitcast(stored, shape(ir.HalfType())), shape(ir.FloatType()))
    return stored


def _pointer(context, builder, array, value, index, lane):
    data = context.make_array(array)(context, builder, value).data
    return builder.bitcast(builder.gep(data, [index]), lane.as_pointer())


@intrinsic
def load(typing, array, index):
    """The vector at an index of a flat array."""
    kind = Vector(_accumulated(array.dtype))

    def code(context, builder, signature, args):
        lane = ir.VectorType(context.get_data_type(array.dtype), LANES)
        place = _pointer(context, builder, array, args[0], args[1], lane)
        stored = builder.load(place, align=array.dtype.bitwidth // 8)
        return _widen(builder, stored, array.dtype, LANES)

    return kind(array, types.intp), code


@intrinsic
def store(typing, array, index, vector):
    """Puts a vector at an index of a flat array of the accumulation type."""

    def code(context, builder, signature, args):
        lane = ir.VectorType(context.get_data_type(array.dtype), LANES)
        place = _pointer(context, builder, array, args[0], args[1], lane)
        builder.store(args[2], place, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), code


@intrinsic
def load_one(typing, array, index):
    """The number at an index of a flat array, in the accumulation type."""

    def code(context, builder, signature, args):
        lane = context.get_data_type(array.dtype)
        stored = builder.load(_pointer(context, builder, array, args[0], args[1], lane))
        return _widen(builder, stored, array.dtype, 1)

    return _accumulated(array.dtype)(array, types.intp), code


@intrinsic
def splat(typing, number):
    """A vector of one number repeated."""

    def code(context, builder, signature, args):
        lane = ir.VectorType(context.get_data_type(number), LANES)
        first = builder.insert_element(ir.Constant(lane, ir.Undefined), args[0], ir.IntType(32)(0))
        return builder.shuffle_vector(first, first, _mask([0] * LANES))

    return Vector(number)(number), code


@intrinsic
def fma(typing, a, b, c):
    """a b + c, rounded once."""

    def code(context, builder, signature, args):
        vector = args[0].type
        name = f"llvm.fma.v{LANES}{'f64' if a.scalar == types.float64 else 'f32'}"
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector] * 3), name)
        return builder.call(function, args)

    return a(a, b, c), code


@intrinsic
def store_totals(typing, array, index, a, b, c, d):
    """Puts the sums of four vectors side by side."""

    def code(context, builder, signature, args):
        def pairs(p, q):
            halves = [[0, 2, 8, 10, 4, 6, 12, 14], [1, 3, 9, 11, 5, 7, 13, 15]]
            even, odd = (builder.shuffle_vector(p, q, _mask(half)) for half in halves)
            return builder.fadd(even, odd)

        v = pairs(pairs(args[2], args[3]), pairs(args[4], args[5]))
        low, high = (builder.shuffle_vector(v, v, _mask(half)) for half in ([0, 1, 2, 3], [4, 5, 6, 7]))
        lane = ir.VectorType(args[2].type.element, TAP_BLOCK)
        place = _pointer(context, builder, array, args[0], args[1], lane)
        builder.store(builder.fadd(low, high), place, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, a, b, c, d), code


def _mask(lanes):
    return ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes)


@intrinsic
def _half_bits(typing, number):
    """float32 to the bits of float16, to nearest even."""

    def code(context, builder, signature, args):
        return builder.bitcast(builder.fptrunc(args[0], ir.HalfType()), ir.IntType(16))

    return types.int16(types.float32), code


def narrow(array, number):
    """A number as the array stores it."""


@overload(narrow)
def _narrow(array, number):
    if array.dtype == types.uint16:
        return _brain_float_bits
    if array.dtype == types.int16:
        return lambda array, number: _half_bits(number)
    return lambda array, number: number


def _brain_float_bits(array, number):
    bits = np.float32(number).view(np.uint32)
    if math.isnan(number):
        return np.uint16(0x7FC0)
    return np.uint16((bits + np.uint32(0x7FFF) + ((bits >> np.uint32(16)) & np.uint32(1))) >> np.uint32(16))


def exponential(number):
    """exp of a number at most 0."""


@overload(exponential)
def _exponential(number):
    if number == types.float64:
        return lambda number: math.exp(number)
    return _exponential32


def _exponential32(number):
    """Cephes' expf, without calls so that loops over it are vectorised; 1 to 2 units in the last place."""
    x = max(number, np.float32(-87.0))
    n = (x * np.float32(1.44269504) + np.float32(12582912.0)) - np.float32(12582912.0)
    x = (x - n * np.float32(0.693359375)) - n * np.float32(-2.12194440e-4)
    p = np.float32(1.9875691500e-4)
    p = p * x + np.float32(1.3981999507e-3)
    p = p * x + np.float32(8.3334519073e-3)
    p = p * x + np.float32(4.1665795894e-2)
    p = p * x + np.float32(1.6666665459e-1)
    p = p * x + np.float32(5.0000001201e-1)
    p = (p * x * x + x) + np.float32(1.0)
    power = (np.int32(n) + np.int32(127)) << np.int32(23)
    return p * np.int32(power).view(np.float32) if number > np.float32(-87.0) else np.float32(0.0)


# ---- along the channels ---------------------------------------------------------------------------------------


@njit(inline="never")
def inner_products(x, rows, n, picture, channels, out):
    """out[t] = x . picture[rows[t]], for t < n; rows is padded to a multiple of TAP_BLOCK."""
    whole = channels // LANES * LANES
    zero = splat(x.dtype.type(0))
    for t in range(0, n, TAP_BLOCK):
        r0, r1, r2, r3 = (
            rows[t] * channels,
            rows[t + 1] * channels,
            rows[t + 2] * channels,
            rows[t + 3] * channels,
        )
        a0 = a1 = a2 = a3 = zero
        for c in range(0, whole, LANES):
            q = load(x, c)
            a0 = fma(q, load(picture, r0 + c), a0)
            a1 = fma(q, load(picture, r1 + c), a1)
            a2 = fma(q, load(picture, r2 + c), a2)
            a3 = fma(q, load(picture, r3 + c), a3)
        store_totals(out, t, a0, a1, a2, a3)
        for c in range(whole, channels):
            out[t] += x[c] * load_one(picture, r0 + c)
            out[t + 1] += x[c] * load_one(picture, r1 + c)
            out[t + 2] += x[c] * load_one(picture, r2 + c)
            out[t + 3] += x[c] * load_one(picture, r3 + c)


@njit(inline="never")
def weighted_sum(weights, rows, n, picture, channels, out):
    """out = sum over t < n of weights[t] picture[rows[t]]; both are padded to a multiple of TAP_BLOCK."""
    c = 0
    while c + 8 * LANES <= channels:
        _weighted_sum_64(weights, rows, n, picture, channels, c, out)
        c += 8 * LANES
    while c + 2 * LANES <= channels:
        _weighted_sum_16(weights, rows, n, picture, channels, c, out)
        c += 2 * LANES
    while c + LANES <= channels:
        _weighted_sum_8(weights, rows, n, picture, channels, c, out)
        c += LANES
    for c in range(c, channels):
        s = weights.dtype.type(0)
        for t in range(n):
            s += weights[t] * load_one(picture, rows[t] * channels + c)
        out[c] = s


@njit
def _weighted_sum_64(weights, rows, n, picture, channels, c, out):
    a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = splat(weights.dtype.type(0))
    for t in range(n):
        w = splat(weights[t])
        r = rows[t] * channels + c
        a0 = fma(w, load(picture, r), a0)
        a1 = fma(w, load(picture, r + 8), a1)
        a2 = fma(w, load(picture, r + 16), a2)
        a3 = fma(w, load(picture, r + 24), a3)
        a4 = fma(w, load(picture, r + 32), a4)
        a5 = fma(w, load(picture, r + 40), a5)
        a6 = fma(w, load(picture, r + 48), a6)
        a7 = fma(w, load(picture, r + 56), a7)
    store(out, c, a0)
    store(out, c + 8, a1)
    store(out, c + 16, a2)
    store(out, c + 24, a3)
    store(out, c + 32, a4)
    store(out, c + 40, a5)
    store(out, c + 48, a6)
    store(out, c + 56, a7)


@njit
def _weighted_sum_16(weights, rows, n, picture, channels, c, out):
    one = splat(weights.dtype.type(1))
    a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = splat(weights.dtype.type(0))
    for t in range(0, n, TAP_BLOCK):
        w0, r0 = splat(weights[t]), rows[t] * channels + c
        w1, r1 = splat(weights[t + 1]), rows[t + 1] * channels + c
        w2, r2 = splat(weights[t + 2]), rows[t + 2] * channels + c
        w3, r3 = splat(weights[t + 3]), rows[t + 3] * channels + c
        a0, b0 = fma(w0, load(picture, r0), a0), fma(w0, load(picture, r0 + 8), b0)
        a1, b1 = fma(w1, load(picture, r1), a1), fma(w1, load(picture, r1 + 8), b1)
        a2, b2 = fma(w2, load(picture, r2), a2), fma(w2, load(picture, r2 + 8), b2)
        a3, b3 = fma(w3, load(picture, r3), a3), fma(w3, load(picture, r3 + 8), b3)
    store(out, c, fma(one, fma(one, a0, a1), fma(one, a2, a3)))
    store(out, c + 8, fma(one, fma(one, b0, b1), fma(one, b2, b3)))


@njit
def _weighted_sum_8(weights, rows, n, picture, channels, c, out):
    one = splat(weights.dtype.type(1))
    a0 = a1 = a2 = a3 = splat(weights.dtype.type(0))
    for t in range(0, n, TAP_BLOCK):
        a0 = fma(splat(weights[t]), load(picture, rows[t] * channels + c), a0)
        a1 = fma(splat(weights[t + 1]), load(picture, rows[t + 1] * channels + c), a1)
        a2 = fma(splat(weights[t + 2]), load(picture, rows[t + 2] * channels + c), a2)
        a3 = fma(splat(weights[t + 3]), load(picture, rows[t + 3] * channels + c), a3)
    store(out, c, fma(one, fma(one, a0, a1), fma(one, a2, a3)))


@njit(nogil=True, cache=True)
def scatter(counts, rows, weights, stride, x, channels, first, last, first_channel, last_channel, out):
    """out[row, c] += weight x[pixel, c] for all taps of the alpha pixels first .. last, in their order.

    `counts` says how many taps each of the pixels has; theirs start at multiples of `stride`. One caller owns
    the channels first_channel .. last_channel, so the order of additions, and with it every bit, is the same however
    many callers share the work.
    """
    for p in range(first, last):
        begin = (p - first) * stride
        end = begin + counts[p - first]
        c = first_channel
        while c + 4 * LANES <= last_channel:
            _scatter_32(rows, weights, begin, end, x, p * channels + c, channels, c, out)
            c += 4 * LANES
        while c + LANES <= last_channel:
            q = load(x, p * channels + c)
            for t in range(begin, end):
                r = rows[t] * channels + c
                store(out, r, fma(splat(weights[t]), q, load(out, r)))
            c += LANES
        for c in range(c, last_channel):
            one = load_one(x, p * channels + c)
            for t in range(begin, end):
                out[rows[t] * channels + c] += weights[t] * one


@njit
def _scatter_32(rows, weights, begin, end, x, at, channels, c, out):
    q0, q1, q2, q3 = load(x, at), load(x, at + 8), load(x, at + 16), load(x, at + 24)
    for t in range(begin, end):
        w = splat(weights[t])
        r = rows[t] * channels + c
        store(out, r, fma(w, q0, load(out, r)))
        store(out, r + 8, fma(w, q1, load(out, r + 8)))
        store(out, r + 16, fma(w, q2, load(out, r + 16)))
        store(out, r + 24, fma(w, q3, load(out, r + 24)))


# ---- where one alpha pixel looks -------------------------------------------------------------------------------


class Look(NamedTuple):
    """The geometry of a call: flat points and mask, fractions along a segment, beta's size."""

    points: np.ndarray
    mask: np.ndarray
    fractions: np.ndarray
    straight: bool
    nearest: bool
    alpha_pixels: int
    shared: bool
    height: int
    width: int


class Samples(NamedTuple):
    """Room for the samples of one pixel that count: which they are, where, in which cell, with what weight."""

    index: np.ndarray
    x: np.ndarray
    y: np.ndarray
    right: np.ndarray
    down: np.ndarray
    score: np.ndarray
    weight: np.ndarray
    slope: np.ndarray
    tap: np.ndarray


class Taps(NamedTuple):
    """Room for the taps of one pixel: their pixels in beta, and numbers for each."""

    row: np.ndarray
    by_key: np.ndarray
    by_value: np.ndarray
    weight: np.ndarray
    slope: np.ndarray


@njit
def _room(n, nearest, like):
    """Scratch for n samples."""
    m = (n if nearest else 4 * n) + TAP_BLOCK
    samples = Samples(
        np.empty(n, np.int64),
        np.empty(n, like.dtype),
        np.empty(n, like.dtype),
        np.empty(n, like.dtype),
        np.empty(n, like.dtype),
        np.empty(n, like.dtype),
        np.empty(n, like.dtype),
        np.empty(n, like.dtype),
        np.empty(4 * n, np.int64),
    )
    taps = Taps(
        np.empty(m, np.int64),
        np.empty(m, like.dtype),
        np.empty(m, like.dtype),
        np.empty(m, like.dtype),
        np.empty(m, like.dtype),
    )
    return samples, taps


@njit
def _surely_inside(x, y, look):
    """Whether a point is so well on beta's area that no rounding of the samples between two such leads off it."""
    half = look.fractions.dtype.type(0.5)
    return (x >= -half) & (y >= -half) & (x <= look.width - half) & (y <= look.height - half)


@njit
def _collect(p, look, samples):
    """Positions of the samples of pixel p that count; how many."""
    dtype = look.fractions.dtype.type
    low = -dtype(0.5) - dtype(EDGE_SLACK)
    right = dtype(look.width) - dtype(0.5) + dtype(EDGE_SLACK)
    bottom = dtype(look.height) - dtype(0.5) + dtype(EDGE_SLACK)
    place = p % look.alpha_pixels if look.shared else p
    length = len(look.fractions)
    n = 0
    if look.straight:
        if not look.mask[place]:
            return 0
        x0, y0 = look.points[4 * place], look.points[4 * place + 1]
        dx, dy = look.points[4 * place + 2] - x0, look.points[4 * place + 3] - y0
        if _surely_inside(x0, y0, look) and _surely_inside(x0 + dx, y0 + dy, look):
            for i in range(length):
                samples.index[i] = i
                samples.x[i] = x0 + look.fractions[i] * dx
                samples.y[i] = y0 + look.fractions[i] * dy
            return length
        for i in range(length):
            x = x0 + look.fractions[i] * dx
            y = y0 + look.fractions[i] * dy
            samples.index[n], samples.x[n], samples.y[n] = i, x, y
            n += (x >= low) & (y >= low) & (x <= right) & (y <= bottom)
        return n
    for i in range(length):
        x = look.points[2 * (place * length + i)]
        y = look.points[2 * (place * length + i) + 1]
        samples.index[n], samples.x[n], samples.y[n] = i, x, y
        n += look.mask[place * length + i] & (x >= low) & (y >= low) & (x <= right) & (y <= bottom)
    return n


@njit
def _tap(n, first, look, samples, taps):
    """Finds the taps of n samples; how many. `first` is the index of the first pixel of this beta."""
    m = _tap_nearest(n, first, look, samples, taps) if look.nearest else _tap_cells(n, first, look, samples, taps)
    for t in range(m, m + TAP_BLOCK):
        taps.row[t] = taps.row[m - 1]
    return m


@njit
def _tap_nearest(n, first, look, samples, taps):
    half = look.fractions.dtype.type(0.5)
    last_x, last_y = np.int64(look.width - 1), np.int64(look.height - 1)
    m = np.int64(0)
    row = np.int64(-1)
    for j in range(n):
        x = min(np.int64(samples.x[j] + half), last_x)
        y = min(np.int64(samples.y[j] + half), last_y)
        here = first + y * look.width + x
        m += here != row
        row = here
        taps.row[m - 1] = row
        samples.tap[j] = m - 1
    return m


@njit
def _tap_cells(n, first, look, samples, taps):
    """Each cell has four taps, of which those that the cell before had, too, are taken from there."""
    dtype = look.fractions.dtype.type
    zero, far_x, far_y = dtype(0), dtype(look.width - 1), dtype(look.height - 1)
    cell_x, cell_y = np.int64(max(look.width - 2, 0)), np.int64(max(look.height - 2, 0))
    step_x, step_y = np.int64(min(1, look.width - 1)), np.int64(min(1, look.height - 1)) * look.width
    x, y = np.int64(-2), np.int64(-2)
    t00 = t10 = t01 = t11 = np.int64(0)
    m = np.int64(0)
    for j in range(n):
        right = min(max(samples.x[j], zero), far_x)
        down = min(max(samples.y[j], zero), far_y)
        new_x, new_y = min(np.int64(right), cell_x), min(np.int64(down), cell_y)
        if new_x != x or new_y != y:
            row = first + new_y * look.width + new_x
            if new_y == y and new_x == x + 1:
                t00, t01 = t10, t11
                t10, t11, m = _fresh(row + step_x, row + step_x + step_y, m, taps)
            elif new_y == y and new_x == x - 1:
                t10, t11 = t00, t01
                t00, t01, m = _fresh(row, row + step_y, m, taps)
            elif new_x == x and new_y == y + 1:
                t00, t10 = t01, t11
                t01, t11, m = _fresh(row + step_y, row + step_x + step_y, m, taps)
            elif new_x == x and new_y == y - 1:
                t01, t11 = t00, t10
                t00, t10, m = _fresh(row, row + step_x, m, taps)
            else:
                t00, t10, m = _fresh(row, row + step_x, m, taps)
                t01, t11, m = _fresh(row + step_y, row + step_x + step_y, m, taps)
            x, y = new_x, new_y
        samples.right[j] = right - dtype(x)
        samples.down[j] = down - dtype(y)
        samples.tap[4 * j], samples.tap[4 * j + 1] = t00, t10
        samples.tap[4 * j + 2], samples.tap[4 * j + 3] = t01, t11
    return m


@njit
def _fresh(row, other, m, taps):
    taps.row[m], taps.row[m + 1] = row, other
    return m, m + 1, m + 2


@njit
def _interpolate(n, m, look, samples, by_tap, out):
    """From numbers on taps to numbers on samples."""
    if look.nearest:
        if m == n:
            out[:n] = by_tap[:n]
        else:
            for j in range(n):
                out[j] = by_tap[samples.tap[j]]
        return
    for j in range(n):
        u, v = samples.right[j], samples.down[j]
        a, b = by_tap[samples.tap[4 * j]], by_tap[samples.tap[4 * j + 1]]
        c, d = by_tap[samples.tap[4 * j + 2]], by_tap[samples.tap[4 * j + 3]]
        upper, lower = a + u * (b - a), c + u * (d - c)
        out[j] = upper + v * (lower - upper)


@njit
def _distribute(n, m, look, samples, numbers, by_tap):
    """From numbers on samples to numbers on taps: the transpose of `_interpolate`."""
    if look.nearest and m == n:
        by_tap[:n] = numbers[:n]
        by_tap[n : n + TAP_BLOCK] = 0
        return
    by_tap[: m + TAP_BLOCK] = 0
    if look.nearest:
        for j in range(n):
            by_tap[samples.tap[j]] += numbers[j]
        return
    for j in range(n):
        u, v = samples.right[j], samples.down[j]
        lower = v * numbers[j]
        upper = numbers[j] - lower
        by_tap[samples.tap[4 * j]] += upper - u * upper
        by_tap[samples.tap[4 * j + 1]] += u * upper
        by_tap[samples.tap[4 * j + 2]] += lower - u * lower
        by_tap[samples.tap[4 * j + 3]] += u * lower


@njit
def _slopes(j, samples, by_tap):
    """How the interpolated number changes with x and with y, at sample j."""
    u, v = samples.right[j], samples.down[j]
    a, b = by_tap[samples.tap[4 * j]], by_tap[samples.tap[4 * j + 1]]
    c, d = by_tap[samples.tap[4 * j + 2]], by_tap[samples.tap[4 * j + 3]]
    return (1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)


# ---- forward and backward ----------------------------------------------------------------------------------------


@njit
def _unpack(array, at, n, out):
    for c in range(n):
        out[c] = load_one(array, at + c)


@njit
def _score(p, q, key, channels, look, bias, samples, taps):
    """Collects pixel p's samples and scores them: how many samples, how many taps."""
    n = _collect(p, look, samples)
    if n == 0:
        return 0, 0
    m = _tap(n, p // look.alpha_pixels * (look.height * look.width), look, samples, taps)
    inner_products(q, taps.row, m, key, channels, taps.by_key)
    _interpolate(n, m, look, samples, taps.by_key, samples.score)
    if len(bias) > 0:
        for j in range(n):
            samples.score[j] += bias[p * len(look.fractions) + samples.index[j]]
    return n, m


@njit(fastmath={"nnan", "nsz"})
def _largest(numbers, n):
    top = numbers[0]
    for j in range(1, n):
        top = max(top, numbers[j])
    return top


@njit(fastmath=SUMS)
def _sum(numbers, n):
    s = numbers.dtype.type(0)
    for j in range(n):
        s += numbers[j]
    return s


@njit
def _softmax(n, samples):
    """Weights of n scores, and the logarithm of the sum of exponentials (-inf if there is none)."""
    top = _largest(samples.score, n)
    if top == -np.inf:
        return top
    for j in range(n):
        samples.weight[j] = exponential(samples.score[j] - top)
    mass = _sum(samples.weight, n)
    scale = 1 / mass
    for j in range(n):
        samples.weight[j] *= scale
    return top + math.log(mass)


@njit(fastmath=SUMS)
def _expected(n, samples):
    x = y = samples.weight.dtype.type(0)
    for j in range(n):
        x += samples.weight[j] * samples.x[j]
        y += samples.weight[j] * samples.y[j]
    return x, y


@njit(fastmath=SUMS)
def _spread(n, samples, x, y):
    squared = samples.weight.dtype.type(0)
    for j in range(n):
        squared += samples.weight[j] * ((samples.x[j] - x) ** 2 + (samples.y[j] - y) ** 2)
    spread = math.sqrt(squared)
    return spread if spread > LEAST_SPREAD else samples.weight.dtype.type(0)


@njit(nogil=True, cache=True)
def forward(query, key, value, look, bias, channels, value_channels, first, last, out, statistics, logsum):
    """The alpha pixels first .. last: values out, statistics (pixel, 4) and log of the sum of exponentials."""
    samples, taps = _room(len(look.fractions), look.nearest, look.fractions)
    q = np.empty(channels, look.fractions.dtype)
    seen = np.empty(value_channels, look.fractions.dtype)
    for p in range(first, last):
        _unpack(query, p * channels, channels, q)
        n, m = _score(p, q, key, channels, look, bias, samples, taps)
        logsum[p] = _softmax(n, samples) if n > 0 else -np.inf
        if logsum[p] == -np.inf:
            seen[:] = 0
            statistics[4 * p : 4 * p + 4] = 0
        else:
            _distribute(n, m, look, samples, samples.weight, taps.weight)
            weighted_sum(taps.weight, taps.row, m, value, value_channels, seen)
            x, y = _expected(n, samples)
            statistics[4 * p], statistics[4 * p + 1] = x, y
            statistics[4 * p + 2] = _spread(n, samples, x, y)
            statistics[4 * p + 3] = _largest(samples.weight, n)
        for c in range(value_channels):
            out[p * value_channels + c] = narrow(out, seen[c])


class Gradients(NamedTuple):
    """Cotangents of the outputs, flat: of values, and of statistics (pixel, 4)."""

    value: np.ndarray
    statistics: np.ndarray


class Scratch(NamedTuple):
    """What backward leaves for `scatter`: for each pixel of a piece of alpha its taps and their weights."""

    counts: np.ndarray
    rows: np.ndarray
    by_key: np.ndarray
    by_value: np.ndarray


@njit
def _blame(n, p, samples, statistics, gradients, score_slopes):
    """From gradients by weights (in samples.slope, from the values alone) to gradients by scores."""
    gx, gy = gradients.statistics[4 * p], gradients.statistics[4 * p + 1]
    spread, peak = statistics[4 * p + 2], statistics[4 * p + 3]
    pull = gradients.statistics[4 * p + 2] / (2 * spread) if spread > 0 else spread
    x, y = statistics[4 * p], statistics[4 * p + 1]
    if gx != 0 or gy != 0 or pull != 0:
        for j in range(n):
            away = (samples.x[j] - x) ** 2 + (samples.y[j] - y) ** 2
            samples.slope[j] += gx * samples.x[j] + gy * samples.y[j] + pull * away
    if gradients.statistics[4 * p + 3] != 0:
        best = 0
        for j in range(1, n):
            if samples.weight[j] > samples.weight[best]:
                best = j
        samples.slope[best] += gradients.statistics[4 * p + 3]
    mean = _inner(samples.weight, samples.slope, n)
    for j in range(n):
        score_slopes[j] = samples.weight[j] * (samples.slope[j] - mean)


@njit(fastmath=SUMS)
def _inner(a, b, n):
    s = a.dtype.type(0)
    for j in range(n):
        s += a[j] * b[j]
    return s


@njit
def _move(n, p, look, samples, taps, statistics, gradients, score_slopes, out):
    """Gradients by the positions of the samples, and by the points that made them."""
    place_x, place_y, spread = statistics[4 * p], statistics[4 * p + 1], statistics[4 * p + 2]
    gx, gy = gradients.statistics[4 * p], gradients.statistics[4 * p + 1]
    pull = gradients.statistics[4 * p + 2] / spread if spread > 0 else spread
    length = len(look.fractions)
    dtype = look.fractions.dtype.type
    far_x, far_y = dtype(look.width - 1), dtype(look.height - 1)
    for j in range(n):
        x, y, w = samples.x[j], samples.y[j], samples.weight[j]
        dx, dy = w * (gx + pull * (x - place_x)), w * (gy + pull * (y - place_y))
        if not look.nearest:
            kx, ky = _slopes(j, samples, taps.by_key)
            vx, vy = _slopes(j, samples, taps.slope)
            dx += (score_slopes[j] * kx + w * vx) if (x >= 0) & (x <= far_x) else dtype(0)
            dy += (score_slopes[j] * ky + w * vy) if (y >= 0) & (y <= far_y) else dtype(0)
        i = samples.index[j]
        if look.straight:
            u = look.fractions[i]
            out[4 * p] += (1 - u) * dx
            out[4 * p + 1] += (1 - u) * dy
            out[4 * p + 2] += u * dx
            out[4 * p + 3] += u * dy
        else:
            out[2 * (p * length + i)] = dx
            out[2 * (p * length + i) + 1] = dy


@njit(nogil=True, cache=True)
def backward(
    query,
    key,
    value,
    look,
    bias,
    channels,
    value_channels,
    logsum,
    statistics,
    gradients,
    first,
    last,
    scratch_first,
    stride,
    scratch,
    query_out,
    points_out,
    bias_out,
):
    """The alpha pixels first .. last: gradients by query, points and bias, and what `scatter` needs for the rest.

    Outputs that are not wanted have length 0; points_out and bias_out come zeroed.
    """
    samples, taps = _room(len(look.fractions), look.nearest, look.fractions)
    q = np.empty(channels, look.fractions.dtype)
    seen = np.empty(value_channels, look.fractions.dtype)
    score_slopes = np.empty(len(look.fractions), look.fractions.dtype)
    for p in range(first, last):
        slot = p - scratch_first
        scratch.counts[slot] = 0
        _unpack(query, p * channels, channels, q)
        n, m = _score(p, q, key, channels, look, bias, samples, taps) if logsum[p] > -np.inf else (0, 0)
        if n == 0:
            query_out[p * channels : (p + 1) * channels] = 0
            continue
        for j in range(n):
            samples.weight[j] = exponential(min(samples.score[j] - logsum[p], logsum[p] - logsum[p]))
        _unpack(gradients.value, p * value_channels, value_channels, seen)
        inner_products(seen, taps.row, m, value, value_channels, taps.slope)
        _interpolate(n, m, look, samples, taps.slope, samples.slope)
        _blame(n, p, samples, statistics, gradients, score_slopes)
        if len(points_out) > 0:
            _move(n, p, look, samples, taps, statistics, gradients, score_slopes, points_out)
        if len(bias_out) > 0:
            for j in range(n):
                bias_out[p * len(look.fractions) + samples.index[j]] = score_slopes[j]
        _distribute(n, m, look, samples, samples.weight, taps.weight)
        begin = slot * stride
        scratch.counts[slot] = m
        scratch.rows[begin : begin + m] = taps.row[:m]
        scratch.by_value[begin : begin + m] = taps.weight[:m]
        _distribute(n, m, look, samples, score_slopes, taps.weight)
        scratch.by_key[begin : begin + m] = taps.weight[:m]
        if len(query_out) > 0:
            weighted_sum(taps.weight, taps.row, m, key, channels, q)
            for c in range(channels):
                query_out[p * channels + c] = narrow(query_out, q[c])
