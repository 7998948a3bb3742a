"""Instructions on eight numbers at a time, as numba intrinsics.

The body of an intrinsic is Python that runs at compile time: a loop in it is unrolled code.
"""

from __future__ import annotations

from collections.abc import Callable
from inspect import unwrap
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

LANES = 8
TAP_BLOCK = 4


def compiled(function=None, **options):
    """numba's njit, of the bare function: a checker of types that tests put around it cannot be compiled."""
    return njit(unwrap(function), **options) if function else lambda function: njit(unwrap(function), **options)


class Vector(types.Type):
    """`LANES` numbers of the accumulation type, or of int32, in one register (or two)."""

    def __init__(self, scalar):
        self.scalar = scalar
        super().__init__(name=f"Vector({scalar})")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(manager[kind.scalar].get_value_type(), LANES))


def accumulated(dtype):
    """The type in which stored numbers are accumulated."""
    return types.float64 if dtype == types.float64 else types.float32


def _constants(lanes) -> ir.Constant:
    return ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes)


def call_llvm(builder, name: str, result, args, **options):
    """Calls an intrinsic of LLVM by its full name."""
    function = ir.FunctionType(result, [value.type for value in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, function, name), args, **options)


def _suffix(element) -> str:
    return f"v{LANES}{'f64' if element == ir.DoubleType() else 'f32'}"


# ---- memory --------------------------------------------------------------------------------------


def widen(builder, stored, dtype, lanes):
    """A stored number, or a vector of them, in the accumulation type."""

    def shape(lane):
        return ir.VectorType(lane, lanes) if lanes > 1 else lane

    if dtype == types.uint16:
        sixteen = shape(ir.IntType(32))(([16] * lanes) if lanes > 1 else 16)
        return builder.bitcast(builder.shl(builder.zext(stored, shape(ir.IntType(32))), sixteen), shape(ir.FloatType()))
    if dtype == types.int16:
        return builder.fpext(builder.bitcast(stored, shape(ir.HalfType())), shape(ir.FloatType()))
    return stored


def offset(builder, index, k: int):
    """index + k."""
    return builder.add(index, ir.Constant(index.type, k))


def load_vector(context, builder, dtype, address, index, lanes=LANES):
    """`lanes` stored numbers, not widened."""
    lane = ir.VectorType(context.get_data_type(dtype), lanes)
    place = builder.bitcast(builder.gep(address, [index]), lane.as_pointer())
    return builder.load(place, align=dtype.bitwidth // 8)


def load_wide(context, builder, dtype, address, index):
    """The stored vector at an index, in the accumulation type."""
    return widen(builder, load_vector(context, builder, dtype, address, index), dtype, LANES)


def store_vector(builder, dtype, address, index, vector):
    """Stores a vector at an index."""
    place = builder.bitcast(builder.gep(address, [index]), vector.type.as_pointer())
    builder.store(vector, place, align=dtype.bitwidth // 8)


@intrinsic
def take(typing, counter):
    """Increments the number at a pointer atomically; gives what it was."""

    def code(context, builder, signature, args):
        return builder.atomic_rmw("add", args[0], ir.Constant(args[0].type.pointee, 1), "monotonic")

    return counter.dtype(counter), code


@intrinsic
def from_index(typing, array, index):
    """The pointer to an index."""

    def code(context, builder, signature, args):
        return builder.gep(args[0], [args[1]])

    return array(array, types.intp), code


@intrinsic
def zero(typing, array):
    """0 in the accumulation type of the numbers at a pointer."""
    kind = accumulated(array.dtype)

    def code(context, builder, signature, args):
        return context.get_constant(kind, 0)

    return kind(array), code


@intrinsic
def load(typing, array, index):
    """The vector at an index, in the accumulation type."""

    def code(context, builder, signature, args):
        return load_wide(context, builder, array.dtype, *args)

    return Vector(accumulated(array.dtype))(array, types.intp), code


@intrinsic
def store(typing, array, index, vector):
    """Stores a vector at an index."""

    def code(context, builder, signature, args):
        store_vector(builder, array.dtype, *args)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), code


@intrinsic
def load_one(typing, array, index):
    """The number at an index, in the accumulation type."""

    def code(context, builder, signature, args):
        return widen(builder, builder.load(builder.gep(args[0], [args[1]])), array.dtype, 1)

    return accumulated(array.dtype)(array, types.intp), code


# ---- arithmetic ----------------------------------------------------------------------------------


def repeat(builder, number):
    """A vector of one number repeated."""
    first = builder.insert_element(
        ir.Constant(ir.VectorType(number.type, LANES), ir.Undefined), number, ir.IntType(32)(0)
    )
    return builder.shuffle_vector(first, first, _constants([0] * LANES))


def fma_values(builder, a, b, c):
    """a b + c, rounded once."""
    return call_llvm(builder, f"llvm.fma.{_suffix(a.type.element)}", a.type, [a, b, c])


def unary(build: Callable[..., Any]):
    """The intrinsic of a vector that `build(builder, a)` computes, of the same kind."""

    @intrinsic
    def operation(typing, a):
        def code(context, builder, signature, args):
            return build(builder, *args)

        return a(a), code

    return operation


def binary(build: Callable[..., Any]):
    """Likewise of two vectors."""

    @intrinsic
    def operation(typing, a, b):
        def code(context, builder, signature, args):
            return build(builder, *args)

        return a(a, b), code

    return operation


def ternary(build: Callable[..., Any]):
    """Likewise of three vectors."""

    @intrinsic
    def operation(typing, a, b, c):
        def code(context, builder, signature, args):
            return build(builder, *args)

        return a(a, b, c), code

    return operation


add = binary(lambda builder, a, b: builder.fadd(a, b))
sub = binary(lambda builder, a, b: builder.fsub(a, b))
mul = binary(lambda builder, a, b: builder.fmul(a, b))
add_int = binary(lambda builder, a, b: builder.add(a, b))
mul_int = binary(lambda builder, a, b: builder.mul(a, b))
minimum_int = binary(lambda builder, a, b: builder.select(builder.icmp_signed("<", a, b), a, b))
minimum = binary(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b))
maximum = binary(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
"""Where either number is NaN, minimum and maximum are that of b."""
fma = ternary(fma_values)
"""a b + c, rounded once."""


@ternary
def keep_above(builder, a, limit, b):
    """The numbers of b; 0 where those of a are below the limit."""
    return builder.select(builder.fcmp_ordered("<", a, limit), ir.Constant(b.type, None), b)


@intrinsic
def splat(typing, number):
    """A vector of one number repeated."""

    def code(context, builder, signature, args):
        return repeat(builder, args[0])

    return Vector(number)(number), code


@intrinsic
def truncated(typing, a):
    """A vector's numbers towards 0, as int32."""
    whole = Vector(types.int32)

    def code(context, builder, signature, args):
        return builder.fptosi(args[0], context.get_value_type(whole))

    return whole(a), code


@intrinsic
def converted(typing, whole, like):
    """A vector of int32 in the type of another."""

    def code(context, builder, signature, args):
        return builder.sitofp(args[0], args[1].type)

    return like(whole, like), code


def _reduction(name: str, start: float | None):
    """The intrinsic that reduces a vector to one number."""

    @intrinsic
    def operation(typing, a):
        def code(context, builder, signature, args):
            element = args[0].type.element
            first = [] if start is None else [ir.Constant(element, start)]
            full = f"llvm.vector.reduce.{name}.{_suffix(element)}"
            return call_llvm(builder, full, element, [*first, args[0]], fastmath=["reassoc"])

        return a.scalar(a), code

    return operation


total = _reduction("fadd", 0.0)
largest = _reduction("fmax", None)


@intrinsic
def add_totals(typing, array, index, a, b, c, d):
    """Adds the sums of four vectors to four numbers side by side."""

    def code(context, builder, signature, args):
        def pairs(p, q):
            halves = [[0, 2, 8, 10, 4, 6, 12, 14], [1, 3, 9, 11, 5, 7, 13, 15]]
            even, odd = (builder.shuffle_vector(p, q, _constants(half)) for half in halves)
            return builder.fadd(even, odd)

        v = pairs(pairs(args[2], args[3]), pairs(args[4], args[5]))
        low, high = (builder.shuffle_vector(v, v, _constants(half)) for half in ([0, 1, 2, 3], [4, 5, 6, 7]))
        stored = load_vector(context, builder, array.dtype, args[0], args[1], TAP_BLOCK)
        store_vector(builder, array.dtype, args[0], args[1], builder.fadd(stored, builder.fadd(low, high)))
        return context.get_dummy_value()

    return types.void(array, types.intp, a, b, c, d), code


# ---- four numbers of each of eight places --------------------------------------------------------

FOURS = [[0, 8, 1, 9, 4, 12, 5, 13], [2, 10, 3, 11, 6, 14, 7, 15]]
PAIRS = [[0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15]]
"""Shuffles that transpose a 4 by 4 block in each half of four vectors."""


def _transpose(builder, a, b, c, d):
    def shuffle(p, q, how):
        return [builder.shuffle_vector(p, q, _constants(lanes)) for lanes in how]

    (ab_low, ab_high), (cd_low, cd_high) = shuffle(a, b, FOURS), shuffle(c, d, FOURS)
    return *shuffle(ab_low, cd_low, PAIRS), *shuffle(ab_high, cd_high, PAIRS)


@intrinsic
def load_fours(typing, array, starts, index):
    """Four vectors, the k-th of array[start + k] for the `LANES` starts at an index."""
    kind = types.UniTuple(Vector(array.dtype), 4)

    def code(context, builder, signature, args):
        def four(k):
            start = builder.load(builder.gep(args[1], [offset(builder, args[2], k)]))
            return load_vector(context, builder, array.dtype, args[0], start, 4)

        halves = [builder.shuffle_vector(four(k), four(k + 4), _constants([*range(LANES)])) for k in range(4)]
        return context.make_tuple(builder, kind, _transpose(builder, *halves))

    return kind(array, starts, types.intp), code


@intrinsic
def add_fours(typing, array, starts, index, a, b, c, d):
    """Adds the numbers of four vectors to array[start + k], k from 0 to 3, for the `LANES` starts at an index,
    in their order. By twos: what the next start touches is the second two of this one."""

    def code(context, builder, signature, args):
        fours = _transpose(builder, *args[3:])
        for k in range(LANES):
            start = builder.load(builder.gep(args[1], [offset(builder, args[2], k)]))
            for half in range(2):
                lanes = [2 * half + k // 4 * 4, 2 * half + k // 4 * 4 + 1]
                number = builder.shuffle_vector(fours[k % 4], fours[k % 4], _constants(lanes))
                at = offset(builder, start, 2 * half)
                stored = load_vector(context, builder, array.dtype, args[0], at, 2)
                store_vector(builder, array.dtype, args[0], at, builder.fadd(stored, number))
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
        store_vector(builder, array.dtype, args[0], args[1], builder.add(numbers, shifts))
        return context.get_dummy_value()

    return types.void(array, types.intp, array.dtype, offsets), code
