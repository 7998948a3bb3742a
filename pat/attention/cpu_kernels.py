"""The compiled loops of the CPU backend. All in one file: numba's cache watches only the file of the entry
point.

The work on one alpha pixel is done on *taps*, the pixels of beta that its samples touch. Neighbouring
samples share them (a bilinear look-up has four, of which the next sample usually needs two again), so all
work along the channels is done once a tap: inner products of the query with its taps, sums of taps with
weights, and in backward the addition of the query to the taps' gradients. Some neighbouring alpha pixels do so
in turn, a few taps at a time, since they share most of them. Everything else is work on samples, eight at a
time.

Images come channels-last and flat. The numbers in them are float64, float32, or 16-bit ones seen as
integers: uint16 is bfloat16, int16 is float16. Arithmetic is in float64 for the first and in float32 for the
others.
"""

from __future__ import annotations

import math
from inspect import unwrap
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

LANES = 8
WIDE = 8 * LANES
"""Channels that are worked off at once."""
TAP_BLOCK = 4
BLOCK = 16
"""Alpha pixels that are worked off together, step by step."""
CHUNK = 48
"""Taps that the pixels of a block have in turn, while these lie in the first cache: 16 KiB."""
LEAST_SPREAD = np.float32(1e-4)
ONE, HALF = np.float32(1), np.float32(0.5)
"""In float32, so that they make a float64 of nothing that is not."""


def compiled(function=None, **options):
    """numba's njit, of the bare function: a checker of types that tests put around it cannot be compiled."""
    return njit(unwrap(function), **options) if function else lambda function: njit(unwrap(function), **options)


# ---- eight numbers at a time ---------------------------------------------------------------------


class Vector(types.Type):
    """`LANES` numbers of the accumulation type, or of int32, in one register (or two)."""

    def __init__(self, scalar):
        self.scalar = scalar
        super().__init__(name=f"Vector({scalar})")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(manager[kind.scalar].get_value_type(), LANES))


def _accumulated(dtype):
    return types.float64 if dtype == types.float64 else types.float32


def _widen(builder, stored, dtype, lanes):
    """A stored number, or a vector of them, in the accumulation type."""

    def shape(lane):
        return ir.VectorType(lane, lanes) if lanes > 1 else lane

    if dtype == types.uint16:
        sixteen = shape(ir.IntType(32))(([16] * lanes) if lanes > 1 else 16)
        return builder.bitcast(builder.shl(builder.zext(stored, shape(ir.IntType(32))), sixteen), shape(ir.FloatType()))
    if dtype == types.int16:
        return builder.fpext(builder.bitcast(stored, shape(ir.HalfType())), shape(ir.FloatType()))
    return stored


@intrinsic
def pointer(typing, array):
    """Where the numbers of a flat array begin. What works on pointers counts no references (a fifth of the
    time otherwise); the caller keeps the array."""

    def code(context, builder, signature, args):
        return context.make_array(array)(context, builder, args[0]).data

    return types.CPointer(array.dtype)(array), code


@intrinsic
def take(typing, counter):
    """The number at a pointer, which is one more for whoever asks next."""

    def code(context, builder, signature, args):
        return builder.atomic_rmw("add", args[0], ir.Constant(args[0].type.pointee, 1), "monotonic")

    return counter.dtype(counter), code


@intrinsic
def from_index(typing, place, index):
    """The pointer to an index."""

    def code(context, builder, signature, args):
        return builder.gep(args[0], [args[1]])

    return place(place, types.intp), code


@intrinsic
def zero(typing, place):
    """Nothing, in the accumulation type of the numbers at a pointer."""
    kind = _accumulated(place.dtype)

    def code(context, builder, signature, args):
        return context.get_constant(kind, 0)

    return kind(place), code


def _at(builder, place, index, lane):
    return builder.bitcast(builder.gep(place, [index]), lane.as_pointer())


@intrinsic
def load(typing, array, index):
    """The vector at an index, in the accumulation type."""
    kind = Vector(_accumulated(array.dtype))

    def code(context, builder, signature, args):
        lane = ir.VectorType(context.get_data_type(array.dtype), LANES)
        place = _at(builder, args[0], args[1], lane)
        stored = builder.load(place, align=array.dtype.bitwidth // 8)
        return _widen(builder, stored, array.dtype, LANES)

    return kind(array, types.intp), code


@intrinsic
def store(typing, array, index, vector):
    """Puts a vector at an index."""

    def code(context, builder, signature, args):
        lane = ir.VectorType(context.get_data_type(array.dtype), LANES)
        place = _at(builder, args[0], args[1], lane)
        builder.store(args[2], place, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), code


@intrinsic
def load_one(typing, array, index):
    """The number at an index, in the accumulation type."""

    def code(context, builder, signature, args):
        lane = context.get_data_type(array.dtype)
        stored = builder.load(_at(builder, args[0], args[1], lane))
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


def _arithmetic(instruction):
    """The intrinsic of one instruction on two vectors."""

    @intrinsic
    def operation(typing, a, b):
        def code(context, builder, signature, args):
            return getattr(builder, instruction)(*args)

        return a(a, b), code

    return operation


add, sub, mul = _arithmetic("fadd"), _arithmetic("fsub"), _arithmetic("fmul")
add_whole, mul_whole = _arithmetic("add"), _arithmetic("mul")


@intrinsic
def truncated(typing, a):
    """A vector's numbers towards 0, as int32."""
    whole = Vector(types.int32)

    def code(context, builder, signature, args):
        return builder.fptosi(args[0], context.get_value_type(whole))

    return whole(a), code


@intrinsic
def numbers_of(typing, whole, like):
    """A vector of int32 in the type of another."""

    def code(context, builder, signature, args):
        return builder.sitofp(args[0], args[1].type)

    return like(whole, like), code


@intrinsic
def lesser_whole(typing, a, b):
    """The smaller of the numbers of two vectors of int32."""

    def code(context, builder, signature, args):
        return builder.select(builder.icmp_signed("<", *args), *args)

    return a(a, b), code


@intrinsic
def larger(typing, a, b):
    """The larger of the numbers of two vectors; that of b if either is NaN."""

    def code(context, builder, signature, args):
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return a(a, b), code


@intrinsic
def lesser(typing, a, b):
    """The smaller of the numbers of two vectors; that of b if either is NaN."""

    def code(context, builder, signature, args):
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return a(a, b), code


@intrinsic
def keep_above(typing, a, limit, b):
    """The numbers of b; 0 where those of a are below the limit."""

    def code(context, builder, signature, args):
        return builder.select(builder.fcmp_ordered("<", *args[:2]), ir.Constant(args[2].type, None), args[2])

    return a(a, limit, b), code


@intrinsic
def two_to(typing, a):
    """2 to the power of whole numbers in float32."""

    def code(context, builder, signature, args):
        def repeat(number):
            return ir.Constant(whole, [number] * LANES)

        whole = ir.VectorType(ir.IntType(32), LANES)
        exponent = builder.add(builder.fptosi(args[0], whole), repeat(127))
        return builder.bitcast(builder.shl(exponent, repeat(23)), args[0].type)

    return a(a), code


@intrinsic
def total(typing, a):
    """The sum of a vector's numbers."""
    return a.scalar(a), _reduction("fadd", 0.0)


@intrinsic
def largest(typing, a):
    """The largest of a vector's numbers."""
    return a.scalar(a), _reduction("fmax", None)


def _reduction(name, start):
    def code(context, builder, signature, args):
        vector = args[0].type
        first = [] if start is None else [ir.Constant(vector.element, start)]
        kind = ir.FunctionType(vector.element, [vector.element] * len(first) + [vector])
        full = f"llvm.vector.reduce.{name}.v{LANES}{'f64' if vector.element == ir.DoubleType() else 'f32'}"
        function = cgutils.get_or_insert_function(builder.module, kind, full)
        return builder.call(function, [*first, args[0]], fastmath=["reassoc"])

    return code


@intrinsic
def add_totals(typing, array, index, a, b, c, d):
    """Adds the sums of four vectors to four numbers side by side."""

    def code(context, builder, signature, args):
        def pairs(p, q):
            halves = [[0, 2, 8, 10, 4, 6, 12, 14], [1, 3, 9, 11, 5, 7, 13, 15]]
            even, odd = (builder.shuffle_vector(p, q, _mask(half)) for half in halves)
            return builder.fadd(even, odd)

        v = pairs(pairs(args[2], args[3]), pairs(args[4], args[5]))
        low, high = (builder.shuffle_vector(v, v, _mask(half)) for half in ([0, 1, 2, 3], [4, 5, 6, 7]))
        lane = ir.VectorType(args[2].type.element, TAP_BLOCK)
        place = _at(builder, args[0], args[1], lane)
        stored = builder.load(place, align=array.dtype.bitwidth // 8)
        builder.store(builder.fadd(stored, builder.fadd(low, high)), place, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, a, b, c, d), code


def _mask(lanes):
    return ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes)


FOURS = [[0, 8, 1, 9, 4, 12, 5, 13], [2, 10, 3, 11, 6, 14, 7, 15]]
PAIRS = [[0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15]]
"""Shuffles that transpose a 4 by 4 block in each half of four vectors."""


def _transpose(builder, a, b, c, d):
    def shuffle(p, q, how):
        return [builder.shuffle_vector(p, q, _mask(lanes)) for lanes in how]

    (ab_low, ab_high), (cd_low, cd_high) = shuffle(a, b, FOURS), shuffle(c, d, FOURS)
    return *shuffle(ab_low, cd_low, PAIRS), *shuffle(ab_high, cd_high, PAIRS)


@intrinsic
def load_fours(typing, array, starts, index):
    """Four vectors, the k-th of array[start + k] for the `LANES` starts at an index."""
    kind = types.UniTuple(Vector(array.dtype), 4)

    def code(context, builder, signature, args):
        lane = ir.VectorType(context.get_data_type(array.dtype), 4)

        def four(k):
            start = builder.load(builder.gep(args[1], [builder.add(args[2], ir.Constant(args[2].type, k))]))
            return builder.load(_at(builder, args[0], start, lane), align=array.dtype.bitwidth // 8)

        halves = [builder.shuffle_vector(four(k), four(k + 4), _mask([*range(LANES)])) for k in range(4)]
        return context.make_tuple(builder, kind, _transpose(builder, *halves))

    return kind(array, starts, types.intp), code


@intrinsic
def add_fours(typing, array, starts, index, a, b, c, d):
    """Adds the numbers of four vectors to array[start + k], k from 0 to 3, for the `LANES` starts at an index,
    in their order. By twos: what the next start touches is the second two of this one."""

    def code(context, builder, signature, args):
        two = ir.VectorType(context.get_data_type(array.dtype), 2)
        fours = _transpose(builder, *args[3:])
        for k in range(LANES):
            start = builder.load(builder.gep(args[1], [builder.add(args[2], ir.Constant(args[2].type, k))]))
            for half in range(2):
                lanes = [2 * half + k // 4 * 4, 2 * half + k // 4 * 4 + 1]
                number = builder.shuffle_vector(fours[k % 4], fours[k % 4], _mask(lanes))
                place = _at(builder, args[0], builder.add(start, ir.Constant(start.type, 2 * half)), two)
                stored = builder.load(place, align=array.dtype.bitwidth // 8)
                builder.store(builder.fadd(stored, number), place, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, starts, types.intp, a, b, c, d), code


@intrinsic
def store_four(typing, array, index, number, offsets):
    """array[index + k] = number + offsets[k], k from 0 to 3."""

    def code(context, builder, signature, args):
        lane = context.get_data_type(array.dtype)
        numbers = shifts = ir.Constant(ir.VectorType(lane, 4), ir.Undefined)
        for k in range(4):
            shift = context.cast(builder, builder.extract_value(args[3], k), offsets.dtype, array.dtype)
            numbers = builder.insert_element(numbers, args[2], ir.IntType(32)(k))
            shifts = builder.insert_element(shifts, shift, ir.IntType(32)(k))
        place = _at(builder, args[0], args[1], numbers.type)
        builder.store(builder.add(numbers, shifts), place, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, array.dtype, offsets), code


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


@unwrap
def _brain_float_bits(array, number):
    bits = np.float32(number).view(np.uint32)
    if math.isnan(number):
        return np.uint16(0x7FC0)
    return np.uint16((bits + np.uint32(0x7FFF) + ((bits >> np.uint32(16)) & np.uint32(1))) >> np.uint32(16))


def exponentials(x):
    """exp of a vector of numbers at most 0; 0 below exp(-87), a hair above the least of float32."""


@overload(exponentials)
def _exponentials(x):
    return (lambda x: _exponentials64(x)) if x.scalar == types.float64 else _exponentials32


@intrinsic
def _exponentials64(typing, x):
    def code(context, builder, signature, args):
        vector = args[0].type
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector]), "llvm.exp.v8f64")
        return builder.call(function, args)

    return x(x), code


@unwrap
def _exponentials32(x):
    """Cephes' expf; 1 to 2 units in the last place."""
    low = splat(np.float32(-87.0))
    shift = splat(np.float32(12582912.0))
    y = larger(low, x)
    n = sub(fma(y, splat(np.float32(1.44269504)), shift), shift)
    y = fma(n, splat(np.float32(-0.693359375)), y)
    y = fma(n, splat(np.float32(2.12194440e-4)), y)
    p = fma(splat(np.float32(1.9875691500e-4)), y, splat(np.float32(1.3981999507e-3)))
    p = fma(p, y, splat(np.float32(8.3334519073e-3)))
    p = fma(p, y, splat(np.float32(4.1665795894e-2)))
    p = fma(p, y, splat(np.float32(1.6666665459e-1)))
    p = fma(p, y, splat(np.float32(5.0000001201e-1)))
    p = add(fma(mul(p, y), y, y), splat(np.float32(1.0)))
    return keep_above(x, low, mul(p, two_to(n)))


# ---- along the channels --------------------------------------------------------------------------


@compiled
def inner_products(x, rows, first, last, image, channels, out):
    """out[t] = x . image[rows[t]], for first <= t < last; rows is padded to a multiple of TAP_BLOCK."""
    c = 0
    for t in range(first, last, LANES):
        store(out, t, splat(zero(x)))
    while c + WIDE <= channels:
        _inner_products_64(x, rows, first, last, image, channels, c, out)
        c += WIDE
    if c < channels:
        _inner_products_of_rest(x, rows, first, last, image, channels, c, out)


@compiled
def _inner_products_64(x, rows, first, last, image, channels, c, out):
    """The 64 channels from c on, with x in registers."""
    x0, x1, x2, x3 = load(x, c), load(x, c + 8), load(x, c + 16), load(x, c + 24)
    x4, x5, x6, x7 = load(x, c + 32), load(x, c + 40), load(x, c + 48), load(x, c + 56)
    for t in range(first, last, TAP_BLOCK):
        add_totals(
            out,
            t,
            _inner_product_64(image, rows[t] * channels + c, x0, x1, x2, x3, x4, x5, x6, x7),
            _inner_product_64(image, rows[t + 1] * channels + c, x0, x1, x2, x3, x4, x5, x6, x7),
            _inner_product_64(image, rows[t + 2] * channels + c, x0, x1, x2, x3, x4, x5, x6, x7),
            _inner_product_64(image, rows[t + 3] * channels + c, x0, x1, x2, x3, x4, x5, x6, x7),
        )


@compiled
def _inner_product_64(image, at, x0, x1, x2, x3, x4, x5, x6, x7):
    a = mul(x0, load(image, at))
    a = fma(x1, load(image, at + 8), a)
    a = fma(x2, load(image, at + 16), a)
    a = fma(x3, load(image, at + 24), a)
    a = fma(x4, load(image, at + 32), a)
    a = fma(x5, load(image, at + 40), a)
    a = fma(x6, load(image, at + 48), a)
    return fma(x7, load(image, at + 56), a)


@compiled
def _inner_products_of_rest(x, rows, first, last, image, channels, first_channel, out):
    whole = first_channel + (channels - first_channel) // LANES * LANES
    for t in range(first, last, TAP_BLOCK):
        r0, r1, r2, r3 = (
            rows[t] * channels,
            rows[t + 1] * channels,
            rows[t + 2] * channels,
            rows[t + 3] * channels,
        )
        a0 = a1 = a2 = a3 = splat(zero(x))
        for c in range(first_channel, whole, LANES):
            q = load(x, c)
            a0 = fma(q, load(image, r0 + c), a0)
            a1 = fma(q, load(image, r1 + c), a1)
            a2 = fma(q, load(image, r2 + c), a2)
            a3 = fma(q, load(image, r3 + c), a3)
        add_totals(out, t, a0, a1, a2, a3)
        for c in range(whole, channels):
            out[t] += x[c] * load_one(image, r0 + c)
            out[t + 1] += x[c] * load_one(image, r1 + c)
            out[t + 2] += x[c] * load_one(image, r2 + c)
            out[t + 3] += x[c] * load_one(image, r3 + c)


@compiled
def weighted_sum(weights, rows, first, last, image, channels, begin, end, out):
    """out[c] += weights[t] image[rows[t], c] for first <= t < last and the channels begin <= c < end.

    Weights and rows are padded to a multiple of TAP_BLOCK.
    """
    c = begin
    while c + WIDE <= end:
        _weighted_sum_64(weights, rows, first, last, image, channels, c, out)
        c += WIDE
    while c + 4 * LANES <= end:
        _weighted_sum_32(weights, rows, first, last, image, channels, c, out)
        c += 4 * LANES
    while c + LANES <= end:
        _weighted_sum_8(weights, rows, first, last, image, channels, c, out)
        c += LANES
    for tail in range(c, end):
        for t in range(first, last):
            out[tail] += weights[t] * load_one(image, rows[t] * channels + tail)


@compiled
def _weighted_sum_64(weights, rows, first, last, image, channels, c, out):
    a0, a1, a2, a3 = load(out, c), load(out, c + 8), load(out, c + 16), load(out, c + 24)
    a4, a5, a6, a7 = load(out, c + 32), load(out, c + 40), load(out, c + 48), load(out, c + 56)
    for t in range(first, last):
        w, r = splat(weights[t]), rows[t] * channels + c
        a0 = fma(w, load(image, r), a0)
        a1 = fma(w, load(image, r + 8), a1)
        a2 = fma(w, load(image, r + 16), a2)
        a3 = fma(w, load(image, r + 24), a3)
        a4 = fma(w, load(image, r + 32), a4)
        a5 = fma(w, load(image, r + 40), a5)
        a6 = fma(w, load(image, r + 48), a6)
        a7 = fma(w, load(image, r + 56), a7)
    _store_32(out, c, a0, a1, a2, a3)
    _store_32(out, c + 32, a4, a5, a6, a7)


@compiled
def _weighted_sum_32(weights, rows, first, last, image, channels, c, out):
    a0, a1, a2, a3 = load(out, c), load(out, c + 8), load(out, c + 16), load(out, c + 24)
    b0 = b1 = b2 = b3 = splat(zero(weights))
    for t in range(first, last, 2):
        w, r = splat(weights[t]), rows[t] * channels + c
        a0 = fma(w, load(image, r), a0)
        a1 = fma(w, load(image, r + 8), a1)
        a2 = fma(w, load(image, r + 16), a2)
        a3 = fma(w, load(image, r + 24), a3)
        w, r = splat(weights[t + 1]), rows[t + 1] * channels + c
        b0 = fma(w, load(image, r), b0)
        b1 = fma(w, load(image, r + 8), b1)
        b2 = fma(w, load(image, r + 16), b2)
        b3 = fma(w, load(image, r + 24), b3)
    _store_32(out, c, add(a0, b0), add(a1, b1), add(a2, b2), add(a3, b3))


@compiled
def _store_32(out, c, a, b, d, e):
    store(out, c, a)
    store(out, c + 8, b)
    store(out, c + 16, d)
    store(out, c + 24, e)


@compiled
def _weighted_sum_8(weights, rows, first, last, image, channels, c, out):
    a0, a1 = load(out, c), splat(zero(weights))
    a2 = a3 = a1
    for t in range(first, last, TAP_BLOCK):
        a0 = fma(splat(weights[t]), load(image, rows[t] * channels + c), a0)
        a1 = fma(splat(weights[t + 1]), load(image, rows[t + 1] * channels + c), a1)
        a2 = fma(splat(weights[t + 2]), load(image, rows[t + 2] * channels + c), a2)
        a3 = fma(splat(weights[t + 3]), load(image, rows[t + 3] * channels + c), a3)
    store(out, c, add(add(a0, a1), add(a2, a3)))


@compiled
def _block_products(pixels, counts, x, rows, image, channels, out):
    """`inner_products` for the pixels of a block. Neighbours look at much the same pixels of beta: at a few of
    those in turn, which then lie in the first cache."""
    for t in range(0, _most(counts, pixels), CHUNK):
        for i in range(pixels):
            inner_products(_of(x, i), _of(rows, i), t, min(t + CHUNK, counts[i]), image, channels, _of(out, i))


@compiled
def _block_sums(pixels, counts, weights, rows, image, channels, out):
    """`weighted_sum` likewise, from 0."""
    for i in range(pixels):
        _fill(_of(out, i), 0, channels, zero(out.first))
    for c in range(0, channels, WIDE):
        end = min(c + WIDE, channels)
        for t in range(0, _most(counts, pixels), CHUNK):
            for i in range(pixels):
                last = min(t + CHUNK, counts[i])
                weighted_sum(_of(weights, i), _of(rows, i), t, last, image, channels, c, end, _of(out, i))


@compiled
def _most(counts, n):
    most = 0
    for i in range(n):
        most = max(most, counts[i])
    return most


@compiled(nogil=True, cache=True)
def scatter(scratch, weights, last, x, channels, first_channel, last_channel, out):
    """out[row, c] += weight x[pixel, c] for all taps of the alpha pixels scratch.first .. last: those of a block
    in turn, as in `_block_products`.

    `weights` is one of scratch's. One caller owns the channels first_channel .. last_channel, so the order of
    additions, and with it every bit, is the same however many callers share the work.
    """
    counts, rows = pointer(scratch.counts), pointer(scratch.rows)
    weights, x, out = pointer(weights), pointer(x), pointer(out)
    for first in range(0, last - scratch.first, BLOCK):
        end = min(first + BLOCK, last - scratch.first)
        for t in range(0, _most(from_index(counts, first), end - first), CHUNK):
            for i in range(first, end):
                at = i * scratch.stride
                taps = at + t, at + min(t + CHUNK, counts[i])
                pixel = from_index(x, (scratch.first + i) * channels)
                _scatter(rows, weights, taps, pixel, channels, first_channel, last_channel, out)


@compiled
def _scatter(rows, weights, taps, x, channels, first_channel, last_channel, out):
    c = first_channel
    while c + 4 * LANES <= last_channel:
        _scatter_32(rows, weights, taps, x, channels, c, out)
        c += 4 * LANES
    while c + LANES <= last_channel:
        q = load(x, c)
        for t in range(taps[0], taps[1]):
            r = rows[t] * channels + c
            store(out, r, fma(splat(weights[t]), q, load(out, r)))
        c += LANES
    for tail in range(c, last_channel):
        one = load_one(x, tail)
        for t in range(taps[0], taps[1]):
            out[rows[t] * channels + tail] += weights[t] * one


@compiled
def _scatter_32(rows, weights, taps, x, channels, c, out):
    q0, q1, q2, q3 = load(x, c), load(x, c + 8), load(x, c + 16), load(x, c + 24)
    for t in range(taps[0], taps[1]):
        w = splat(weights[t])
        r = rows[t] * channels + c
        store(out, r, fma(w, q0, load(out, r)))
        store(out, r + 8, fma(w, q1, load(out, r + 8)))
        store(out, r + 16, fma(w, q2, load(out, r + 16)))
        store(out, r + 24, fma(w, q3, load(out, r + 24)))


# ---- where one alpha pixel looks -----------------------------------------------------------------


class Look(NamedTuple):
    """The geometry of a call. The numbers are arrays outside and pointers inside."""

    points: Any
    mask: Any
    fractions: Any
    samples: int
    straight: bool
    nearest: bool
    alpha_pixels: int
    shared: bool
    height: int
    width: int
    last_x: Any
    last_y: Any
    slack: Any


class Call(NamedTuple):
    """The inputs of a call: images, where to look, bias (of no length if there is none), and the numbers of
    channels of the query and the value."""

    query: Any
    key: Any
    value: Any
    look: Look
    bias: Any
    channels: int
    value_channels: int


class Share(NamedTuple):
    """What one of several callers works on, and with: pieces of `size` of the alpha pixels first .. last, for
    which all of them ask one counter, and scratch of its own."""

    first: int
    last: int
    size: int
    counter: Any
    integers: Any
    numbers: Any


class Saved(NamedTuple):
    """What forward found, and the gradients by what it gave. Statistics may be of one pixel, for all."""

    statistics: Any
    logsum: Any
    value_upstream: Any
    statistics_upstream: Any


class Gradients(NamedTuple):
    """Those that belong to alpha's pixels; of no length where not wanted. points and bias come zeroed."""

    query: Any
    points: Any
    bias: Any


class Scratch(NamedTuple):
    """What backward leaves for `scatter`: for each of the alpha pixels from `first` on how many taps it has;
    their rows and weights, which start at multiples of `stride`."""

    first: int
    stride: int
    counts: Any
    rows: Any
    by_key: Any
    by_value: Any


class Samples(NamedTuple):
    """Room for the samples of one pixel that count: which they are, where, in which cell, where in that
    cell, and numbers for each."""

    index: Any
    cell: Any
    tap: Any
    x: Any
    y: Any
    ahead: Any
    aside: Any
    score: Any
    weight: Any
    slope: Any
    score_slope: Any


class Column(NamedTuple):
    """A list for each pixel of a block: where the first one's begins, and how far it is to the next."""

    first: Any
    step: Any


class Block(NamedTuple):
    """Room for some neighbouring alpha pixels: for each the number of its samples and taps, its samples, its
    taps' rows (pixels in beta), numbers for each tap, and for each channel."""

    sample_counts: Any
    tap_counts: Any
    integers: Column
    numbers: Column
    rows: Column
    by_key: Column
    by_value: Column
    query: Column
    upstream: Column


@compiled
def _look(look):
    return Look(
        pointer(look.points),
        pointer(look.mask),
        pointer(look.fractions),
        look.samples,
        look.straight,
        look.nearest,
        look.alpha_pixels,
        look.shared,
        look.height,
        look.width,
        look.last_x,
        look.last_y,
        look.slack,
    )


@compiled
def _call(call):
    """With pointers for arrays."""
    return Call(
        pointer(call.query),
        pointer(call.key),
        pointer(call.value),
        _look(call.look),
        pointer(call.bias),
        call.channels,
        call.value_channels,
    )


@compiled
def _lengths(samples):
    """Room for a pixel's samples and for its taps."""
    return samples + LANES, 4 * samples + 2 * LANES


def room(samples, channels):
    """How many integers and how many numbers of scratch a task needs."""
    n, m = _lengths.py_func(samples)
    return BLOCK * (3 * n + m + 2), BLOCK * (8 * n + 2 * m + 2 * channels)


@compiled
def _block(call, share):
    """Scratch, cut up."""
    n, m = _lengths(call.look.samples)
    i, f = from_index(pointer(share.integers), 2 * BLOCK), pointer(share.numbers)
    channels = max(call.channels, call.value_channels)
    i_step, f_step = 3 * n + m, 8 * n + 2 * m + 2 * channels
    return Block(
        pointer(share.integers),
        from_index(pointer(share.integers), BLOCK),
        Column(i, i_step),
        Column(f, f_step),
        Column(from_index(i, 3 * n), i_step),
        Column(from_index(f, 8 * n), f_step),
        Column(from_index(f, 8 * n + m), f_step),
        Column(from_index(f, 8 * n + 2 * m), f_step),
        Column(from_index(f, 8 * n + 2 * m + channels), f_step),
    )


@compiled
def _of(column, slot):
    """The list of one pixel of a block."""
    return from_index(column.first, slot * column.step)


@compiled
def _samples(block, slot, n):
    """The samples of one pixel of a block."""
    n, _ = _lengths(n)
    i, f = _of(block.integers, slot), _of(block.numbers, slot)
    return Samples(
        i,
        from_index(i, n),
        from_index(i, 2 * n),
        f,
        from_index(f, n),
        from_index(f, 2 * n),
        from_index(f, 3 * n),
        from_index(f, 4 * n),
        from_index(f, 5 * n),
        from_index(f, 6 * n),
        from_index(f, 7 * n),
    )


@compiled
def _on_image(x, y, look, slack):
    low = -HALF - slack
    return (x >= low) & (y >= low) & (x <= look.last_x - low) & (y <= look.last_y - low)


@compiled
def _walk(start, along, look, out):
    """start + fraction along, rounded as torch rounds it (no fused multiply-add)."""
    for i in range(0, look.samples, LANES):
        store(out, i, add(start, mul(load(look.fractions, i), along)))


@compiled
def _collect(p, look, samples):
    """Positions of the samples of pixel p that count, padded with 0; how many."""
    place = p % look.alpha_pixels if look.shared else p
    if look.straight:
        n = _collect_segment(place, look, samples) if look.mask[place] else 0
    else:
        n = _collect_positions(place, look, samples)
    store(samples.x, n, splat(zero(samples.x)))
    store(samples.y, n, splat(zero(samples.y)))
    return n


@compiled
def _collect_positions(place, look, samples):
    points, mask = (
        from_index(look.points, 2 * place * look.samples),
        from_index(look.mask, place * look.samples),
    )
    n = 0
    for i in range(look.samples):
        x, y = points[2 * i], points[2 * i + 1]
        samples.index[n], samples.x[n], samples.y[n] = i, x, y
        n += (mask[i] != 0) & _on_image(x, y, look, look.slack)
    return n


@compiled
def _collect_segment(place, look, samples):
    x0, y0 = look.points[4 * place], look.points[4 * place + 1]
    dx, dy = look.points[4 * place + 2] - x0, look.points[4 * place + 3] - y0
    _walk(splat(x0), splat(dx), look, samples.x)
    _walk(splat(y0), splat(dy), look, samples.y)
    sure = look.slack - look.slack
    if _on_image(x0, y0, look, sure) & _on_image(x0 + dx, y0 + dy, look, sure):
        for i in range(look.samples):
            samples.index[i] = i
        return look.samples
    n = 0
    for i in range(look.samples):
        x, y = samples.x[i], samples.y[i]
        samples.index[n], samples.x[n], samples.y[n] = i, x, y
        n += _on_image(x, y, look, look.slack)
    return n


@compiled
def _tap(n, first, look, samples, rows):
    """Finds the taps of n samples; how many. `first` is the index of the first pixel of this beta."""
    if look.nearest:
        m = _tap_nearest(n, np.int32(first), look, samples, rows)
    else:
        m = _tap_cells(n, np.int32(first), look, samples, rows)
    for t in range(m, m + TAP_BLOCK):
        rows[t] = rows[m - 1]
    return m


@compiled
def _tap_nearest(n, first, look, samples, rows):
    """The pixels that samples lie on, those of neighbours once. As many as samples: each has its own."""
    half, width, first = splat(HALF + zero(samples.x)), splat(np.int32(look.width)), splat(first)
    last_x, last_y = splat(np.int32(look.width - 1)), splat(np.int32(look.height - 1))
    for j in range(0, n, LANES):
        x = lesser_whole(truncated(add(load(samples.x, j), half)), last_x)
        y = lesser_whole(truncated(add(load(samples.y, j), half)), last_y)
        store(rows, j, add_whole(add_whole(mul_whole(y, width), x), first))
    if look.straight and n > 1 and max(abs(samples.x[1] - samples.x[0]), abs(samples.y[1] - samples.y[0])) >= ONE:
        return n
    m = 0
    row = np.int32(-1)
    for j in range(n):
        here = rows[j]
        m += here != row
        row = here
        rows[m - 1] = row
        samples.tap[j] = m - 1
    return m


class Course(NamedTuple):
    """Which way the samples of a pixel run on the whole: along y or x, backward or forward."""

    steep: Any
    backward: Any


@compiled
def _course(n, samples):
    along_x, along_y = samples.x[n - 1] - samples.x[0], samples.y[n - 1] - samples.y[0]
    steep = abs(along_y) > abs(along_x)
    return Course(steep, along_y < 0 if steep else along_x < 0)


@compiled
def _tap_cells(n, first, look, samples, rows):
    """A cell's taps are four in a row: two behind, then the two ahead, as the samples run. A sample one cell
    further has for its first two the last two of the sample before."""
    course = _course(n, samples)
    width = np.int32(look.width)
    right, down = np.int32(min(1, look.width - 1)), np.int32(min(1, look.height - 1)) * width
    ahead, aside = (down, right) if course.steep else (right, down)
    _find_cells(n, first, look, samples, course)
    if course.backward:
        first_tap, ahead = ahead, -ahead
    else:
        first_tap = np.int32(0)
    offsets = first_tap, first_tap + aside, first_tap + ahead, first_tap + ahead + aside
    tap, before = np.int32(0), samples.cell[0]
    for j in range(n):
        cell = samples.cell[j]
        tap += np.int32(0) if cell == before else np.int32(2) if cell - before == ahead else np.int32(4)
        before = cell
        store_four(rows, tap, cell, offsets)
        samples.tap[j] = tap
    for j in range(n, n + LANES):
        samples.tap[j] = tap
    return np.int64(tap) + 4


@compiled
def _find_cells(n, first, look, samples, course):
    """The cell of each sample, as the index of its upper left pixel, and how far ahead and aside in it."""
    nothing, one = splat(zero(samples.x)), splat(ONE + zero(samples.x))
    last_x, last_y = splat(look.last_x), splat(look.last_y)
    cell_x, cell_y = splat(np.int32(max(look.width - 2, 0))), splat(np.int32(max(look.height - 2, 0)))
    width, first = splat(np.int32(look.width)), splat(first)
    across, down = (samples.aside, samples.ahead) if course.steep else (samples.ahead, samples.aside)
    for j in range(0, n, LANES):
        x = lesser(larger(load(samples.x, j), nothing), last_x)
        y = lesser(larger(load(samples.y, j), nothing), last_y)
        cx, cy = lesser_whole(truncated(x), cell_x), lesser_whole(truncated(y), cell_y)
        store(across, j, sub(x, numbers_of(cx, x)))
        store(down, j, sub(y, numbers_of(cy, y)))
        store(samples.cell, j, add_whole(add_whole(mul_whole(cy, width), cx), first))
    if course.backward:
        for j in range(0, n, LANES):
            store(samples.ahead, j, sub(one, load(samples.ahead, j)))


@compiled
def _interpolate(n, m, look, samples, by_tap, out):
    """From numbers on taps to numbers on samples."""
    if look.nearest:
        if m == n:
            for j in range(0, n, LANES):
                store(out, j, load(by_tap, j))
        else:
            for j in range(n):
                out[j] = by_tap[samples.tap[j]]
        return
    for j in range(0, n, LANES):
        ahead, aside = load(samples.ahead, j), load(samples.aside, j)
        a, b, c, d = load_fours(by_tap, samples.tap, j)
        behind, before = fma(aside, sub(b, a), a), fma(aside, sub(d, c), c)
        store(out, j, fma(ahead, sub(before, behind), behind))


@compiled
def _distribute(n, m, look, samples, numbers, by_tap):
    """From numbers on samples, padded with 0, to numbers on taps: the transpose of `_interpolate`."""
    if look.nearest and m == n:
        for j in range(0, n, LANES):
            store(by_tap, j, load(numbers, j))
        _fill(by_tap, n, n + TAP_BLOCK, zero(by_tap))
        return
    for t in range(0, m + TAP_BLOCK, LANES):
        store(by_tap, t, splat(zero(by_tap)))
    if look.nearest:
        for j in range(n):
            by_tap[samples.tap[j]] += numbers[j]
        return
    for j in range(0, n, LANES):
        number, ahead, aside = load(numbers, j), load(samples.ahead, j), load(samples.aside, j)
        before = mul(ahead, number)
        behind = sub(number, before)
        b, d = mul(aside, behind), mul(aside, before)
        add_fours(by_tap, samples.tap, j, sub(behind, b), b, sub(before, d), d)


@compiled
def _fill(numbers, first, last, filler):
    for j in range(first, last):
        numbers[j] = filler


@compiled
def _slopes(j, course, samples, by_tap):
    """How the interpolated number changes with x and with y, at sample j."""
    u, v, t = samples.ahead[j], samples.aside[j], samples.tap[j]
    a, b, c, d = by_tap[t], by_tap[t + 1], by_tap[t + 2], by_tap[t + 3]
    ahead, aside = (ONE - v) * (c - a) + v * (d - b), (ONE - u) * (b - a) + u * (d - c)
    ahead = -ahead if course.backward else ahead
    return (aside, ahead) if course.steep else (ahead, aside)


# ---- forward and backward ------------------------------------------------------------------------


@compiled
def _unpack(array, at, n, out):
    whole = n // LANES * LANES
    for c in range(0, whole, LANES):
        store(out, c, load(array, at + c))
    for c in range(whole, n):
        out[c] = load_one(array, at + c)


def pack(numbers, n, array, at):
    """array[at + c] = numbers[c], narrowed."""


@overload(pack)
def _pack(numbers, n, array, at):
    return _pack_same if array.dtype == numbers.dtype else _pack_narrower


@unwrap
def _pack_same(numbers, n, array, at):
    _unpack(numbers, 0, n, from_index(array, at))


@unwrap
def _pack_narrower(numbers, n, array, at):
    for c in range(n):
        array[at + c] = narrow(array, numbers[c])


@compiled
def _find(p, slot, look, block):
    """The samples and taps of pixel p."""
    samples = _samples(block, slot, look.samples)
    block.sample_counts[slot] = n = _collect(p, look, samples)
    first = p // look.alpha_pixels * (look.height * look.width)
    block.tap_counts[slot] = _tap(n, first, look, samples, _of(block.rows, slot)) if n > 0 else 0


@compiled
def _score(p, slot, call, biased, block):
    """The scores of pixel p's samples."""
    look, bias = call.look, call.bias
    samples, n = _samples(block, slot, look.samples), block.sample_counts[slot]
    _interpolate(n, block.tap_counts[slot], look, samples, _of(block.by_key, slot), samples.score)
    if biased:
        for j in range(n):
            samples.score[j] += bias[p * look.samples + samples.index[j]]
    _fill(samples.score, n, n + LANES, zero(samples.score) - np.float32(np.inf))


@compiled
def _plain_sum(numbers, n):
    s = zero(numbers)
    for j in range(n):
        s += numbers[j]
    return s


@compiled
def _softmax(n, score, weight):
    """Weights of n scores, and the logarithm of the sum of exponentials (-inf if there is none)."""
    best = load(score, 0)
    for j in range(LANES, n, LANES):
        best = larger(load(score, j), best)
    top = largest(best)
    if top == -np.inf and not math.isnan(_plain_sum(score, n)):
        return top
    mass = _exponentiate(n, score, weight, top)
    scale = splat(ONE / mass)
    for j in range(0, n, LANES):
        store(weight, j, mul(load(weight, j), scale))
    return top + math.log(mass)


@compiled
def _exponentiate(n, score, weight, top):
    """weight = exp(score - top), and the sum; scores are padded with -inf."""
    minus_top = splat(-top)
    mass = splat(zero(score))
    for j in range(0, n, LANES):
        e = exponentials(add(load(score, j), minus_top))
        store(weight, j, e)
        mass = add(mass, e)
    return total(mass)


@compiled
def _measure(slot, look, block, statistics):
    """Expected position, spread and largest of the weights, which are padded with 0; all 0 without taps."""
    samples, n = _samples(block, slot, look.samples), block.sample_counts[slot]
    nothing = zero(samples.x)
    if block.tap_counts[slot] == 0:
        _fill(statistics, 0, 4, nothing)
        return
    x = y = squared = peak = splat(nothing)
    for j in range(0, n, LANES):
        w = load(samples.weight, j)
        x = fma(w, load(samples.x, j), x)
        y = fma(w, load(samples.y, j), y)
    statistics[0], statistics[1] = total(x), total(y)
    x, y = splat(statistics[0]), splat(statistics[1])
    for j in range(0, n, LANES):
        w = load(samples.weight, j)
        dx, dy = sub(load(samples.x, j), x), sub(load(samples.y, j), y)
        squared = fma(w, fma(dx, dx, mul(dy, dy)), squared)
        peak = larger(w, peak)
    spread = math.sqrt(total(squared))
    statistics[2] = spread if spread > LEAST_SPREAD else nothing
    statistics[3] = largest(peak)


@compiled(nogil=True, cache=True)
def forward(call, share, out, statistics, logsum):
    """Values, statistics (pixel, 4; if it has a length) and logarithm of the sum of exponentials of a share of
    alpha's pixels."""
    measured = len(statistics) > 0
    biased = len(call.bias) > 0
    block, counter, call = _block(call, share), pointer(share.counter), _call(call)
    out, statistics, logsum = pointer(out), pointer(statistics), pointer(logsum)
    begin = share.first + take(counter) * share.size
    while begin < share.last:
        end = min(begin + share.size, share.last)
        for first in range(begin, end, BLOCK):
            _forward(first, min(BLOCK, end - first), call, biased, measured, block, out, statistics, logsum)
        begin = share.first + take(counter) * share.size


@compiled
def _forward(first, pixels, call, biased, measured, block, out, statistics, logsum):
    """A block of alpha's pixels."""
    d, dv, counts = call.channels, call.value_channels, block.tap_counts
    for i in range(pixels):
        _unpack(call.query, (first + i) * d, d, _of(block.query, i))
        _find(first + i, i, call.look, block)
    _block_products(pixels, counts, block.query, block.rows, call.key, d, block.by_key)
    for i in range(pixels):
        p = first + i
        logsum[p] = _weigh(p, i, call, biased, measured, block)
        if measured:
            _measure(i, call.look, block, from_index(statistics, 4 * p))
    _block_sums(pixels, counts, block.by_key, block.rows, call.value, dv, block.query)
    for i in range(pixels):
        pack(_of(block.query, i), dv, out, (first + i) * dv)


@compiled
def _weigh(p, slot, call, biased, measured, block):
    """From the inner products of pixel p's taps to their weights, in the same place; gives the logarithm of
    the sum of exponentials."""
    look, by_tap = call.look, _of(block.by_key, slot)
    samples, n = _samples(block, slot, look.samples), block.sample_counts[slot]
    logsum = zero(by_tap) - np.float32(np.inf)
    if look.nearest and n == block.tap_counts[slot] and n > 0:
        return _weigh_taps(p, slot, n, call, biased, measured, block)
    if n > 0:
        _score(p, slot, call, biased, block)
        logsum = _softmax(n, samples.score, samples.weight)
    if logsum == -np.inf:
        block.tap_counts[slot] = 0
    else:
        _distribute(n, block.tap_counts[slot], look, samples, samples.weight, by_tap)
    return logsum


@compiled
def _weigh_taps(p, slot, n, call, biased, measured, block):
    """`_weigh` where each sample has a tap of its own: no need to go from taps to samples and back."""
    samples, by_tap = _samples(block, slot, call.look.samples), _of(block.by_key, slot)
    if biased:
        for j in range(n):
            by_tap[j] += call.bias[p * call.look.samples + samples.index[j]]
    _fill(by_tap, n, n + LANES, zero(by_tap) - np.float32(np.inf))
    logsum = _softmax(n, by_tap, by_tap)
    if logsum == -np.inf:
        block.tap_counts[slot] = 0
    elif measured:
        _unpack(by_tap, 0, n + LANES, samples.weight)
    return logsum


@compiled
def _blame(n, samples, statistics, upstream):
    """From gradients by the weights to gradients by the scores. Samples' slopes hold those of the values."""
    nothing = zero(upstream)
    x, y, spread, gx, gy, gspread = _six(statistics, upstream)
    pull = HALF * gspread / spread if spread > 0 else nothing
    if gx != 0 or gy != 0 or pull != 0:
        for j in range(n):
            away = (samples.x[j] - x) ** 2 + (samples.y[j] - y) ** 2
            samples.slope[j] += gx * samples.x[j] + gy * samples.y[j] + pull * away
    if upstream[3] != 0:
        best = 0
        for j in range(1, n):
            best = j if samples.weight[j] > samples.weight[best] else best
        samples.slope[best] += upstream[3]
    _fill(samples.slope, n, n + LANES, nothing)
    mean = splat(nothing)
    for j in range(0, n, LANES):
        mean = fma(load(samples.weight, j), load(samples.slope, j), mean)
    mean = splat(total(mean))
    for j in range(0, n, LANES):
        store(samples.score_slope, j, mul(load(samples.weight, j), sub(load(samples.slope, j), mean)))


@compiled
def _six(statistics, upstream):
    return statistics[0], statistics[1], statistics[2], upstream[0], upstream[1], upstream[2]


@compiled
def _move(p, slot, look, block, statistics, upstream, out):
    """Gradients by the positions of the samples, and by the points that made them."""
    samples, n = _samples(block, slot, look.samples), block.sample_counts[slot]
    by_key, by_value = _of(block.by_key, slot), _of(block.by_value, slot)
    nothing = zero(upstream)
    centre_x, centre_y, spread, gx, gy, gspread = _six(statistics, upstream)
    pull = gspread / spread if spread > 0 else nothing
    x0 = y0 = x1 = y1 = nothing
    course = _course(n, samples)
    for j in range(n):
        x, y, w = samples.x[j], samples.y[j], samples.weight[j]
        dx, dy = w * (gx + pull * (x - centre_x)), w * (gy + pull * (y - centre_y))
        if not look.nearest:
            kx, ky = _slopes(j, course, samples, by_key)
            vx, vy = _slopes(j, course, samples, by_value)
            dx += samples.score_slope[j] * kx + w * vx if (x >= nothing) & (x <= look.last_x) else nothing
            dy += samples.score_slope[j] * ky + w * vy if (y >= nothing) & (y <= look.last_y) else nothing
        i = samples.index[j]
        if look.straight:
            u = look.fractions[i]
            x1, y1 = x1 + u * dx, y1 + u * dy
            x0, y0 = x0 + dx - u * dx, y0 + dy - u * dy
        else:
            out[2 * (p * look.samples + i)], out[2 * (p * look.samples + i) + 1] = dx, dy
    if look.straight:
        out[4 * p], out[4 * p + 1], out[4 * p + 2], out[4 * p + 3] = x0, y0, x1, y1


@compiled(nogil=True, cache=True)
def backward(call, saved, share, scratch, gradients):
    """Gradients of a share of alpha's pixels, and what `scatter` needs for those of beta's."""
    biased = len(call.bias) > 0
    block, counter, call = _block(call, share), pointer(share.counter), _call(call)
    step = 4 if len(saved.statistics) > 4 else 0
    saved = Saved(
        pointer(saved.statistics),
        pointer(saved.logsum),
        pointer(saved.value_upstream),
        pointer(saved.statistics_upstream),
    )
    begin = share.first + take(counter) * share.size
    while begin < share.last:
        end = min(begin + share.size, share.last)
        for first in range(begin, end, BLOCK):
            _backward(first, min(BLOCK, end - first), call, biased, saved, step, block, scratch, gradients)
        begin = share.first + take(counter) * share.size


@compiled
def _backward(first, pixels, call, biased, saved, step, block, scratch, gradients):
    """A block of alpha's pixels."""
    d, dv = call.channels, call.value_channels
    block, by_key, by_value = _left(first, block, scratch)
    for i in range(pixels):
        p = first + i
        _unpack(call.query, p * d, d, _of(block.query, i))
        _unpack(saved.value_upstream, p * dv, dv, _of(block.upstream, i))
        block.tap_counts[i] = 0
        if saved.logsum[p] > -np.inf:
            _find(p, i, call.look, block)
    _block_products(pixels, block.tap_counts, block.query, block.rows, call.key, d, block.by_key)
    _block_products(pixels, block.tap_counts, block.upstream, block.rows, call.value, dv, block.by_value)
    for i in range(pixels):
        if block.tap_counts[i] > 0:
            _blame_pixel(first + i, i, call, biased, saved, step, block, gradients)
            _leave(i, call.look, block, _of(by_key, i), _of(by_value, i))
    if len(gradients.query) > 0:
        _block_sums(pixels, block.tap_counts, by_key, block.rows, call.key, d, block.query)
        for i in range(pixels):
            pack(_of(block.query, i), d, pointer(gradients.query), (first + i) * d)


@compiled
def _left(first, block, scratch):
    """A block whose taps are put where `scatter` finds them, and where their weights go."""
    i, stride = first - scratch.first, scratch.stride
    block = Block(
        block.sample_counts,
        from_index(pointer(scratch.counts), i),
        block.integers,
        block.numbers,
        Column(from_index(pointer(scratch.rows), i * stride), stride),
        block.by_key,
        block.by_value,
        block.query,
        block.upstream,
    )
    by_key = Column(from_index(pointer(scratch.by_key), i * stride), stride)
    return block, by_key, Column(from_index(pointer(scratch.by_value), i * stride), stride)


@compiled
def _blame_pixel(p, slot, call, biased, saved, step, block, gradients):
    """Pixel p's weights again, and the gradients by them, by the scores, by points and bias."""
    samples, n = _samples(block, slot, call.look.samples), block.sample_counts[slot]
    statistics, upstream = from_index(saved.statistics, step * p), from_index(saved.statistics_upstream, step * p)
    _score(p, slot, call, biased, block)
    _exponentiate(n, samples.score, samples.weight, saved.logsum[p])
    _interpolate(n, block.tap_counts[slot], call.look, samples, _of(block.by_value, slot), samples.slope)
    _blame(n, samples, statistics, upstream)
    if len(gradients.points) > 0:
        _move(p, slot, call.look, block, statistics, upstream, pointer(gradients.points))
    if len(gradients.bias) > 0:
        for j in range(n):
            gradients.bias[p * call.look.samples + samples.index[j]] = samples.score_slope[j]


@compiled
def _leave(slot, look, block, by_key, by_value):
    """What `scatter` needs of a pixel."""
    samples, n, m = _samples(block, slot, look.samples), block.sample_counts[slot], block.tap_counts[slot]
    _distribute(n, m, look, samples, samples.weight, by_value)
    _distribute(n, m, look, samples, samples.score_slope, by_key)
