"""Rows: tuples of n vectors that lie side by side, n being a literal. They stay in registers, and the loops over them
are unrolled."""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .vectors import LANES, Vector, accumulated, fma_values, load_wide, offset, repeat, store_vector


@intrinsic(prefer_literal=True)
def load_row(typing, array, index, n):
    """n vectors from an index on."""
    kind = types.UniTuple(Vector(accumulated(array.dtype)), n.literal_value)

    def code(context, builder, signature, args):
        starts = [offset(builder, args[1], k * LANES) for k in range(kind.count)]
        row = [load_wide(context, builder, array.dtype, args[0], start) for start in starts]
        return context.make_tuple(builder, kind, row)

    return kind(array, types.intp, n), code


@intrinsic
def gather_row(typing, array, starts, index):
    """The vector at an index from each of some starts on."""
    kind = types.UniTuple(Vector(accumulated(array.dtype)), starts.count)

    def code(context, builder, signature, args):
        places = [builder.add(start, args[2]) for start in cgutils.unpack_tuple(builder, args[1])]
        row = [load_wide(context, builder, array.dtype, args[0], place) for place in places]
        return context.make_tuple(builder, kind, row)

    return kind(array, starts, types.intp), code


@intrinsic
def store_row(typing, array, index, row):
    """Stores a row from an index on."""

    def code(context, builder, signature, args):
        for k, vector in enumerate(cgutils.unpack_tuple(builder, args[2])):
            store_vector(builder, array.dtype, args[0], offset(builder, args[1], k * LANES), vector)
        return context.get_dummy_value()

    return types.void(array, types.intp, row), code


@intrinsic(prefer_literal=True)
def extend_row(typing, row, n):
    """A row with zeros added: n vectors."""
    kind = types.UniTuple(row.dtype, n.literal_value)

    def code(context, builder, signature, args):
        vectors = cgutils.unpack_tuple(builder, args[0])
        nothing = ir.Constant(vectors[0].type, None)
        return context.make_tuple(builder, kind, vectors + [nothing] * (kind.count - len(vectors)))

    return kind(row, n), code


@intrinsic
def fma_row(typing, vector, row, total):
    """total + vector row, each rounded once."""

    def code(context, builder, signature, args):
        pairs = zip(*(cgutils.unpack_tuple(builder, values) for values in args[1:]))
        return context.make_tuple(builder, total, [fma_values(builder, args[0], a, b) for a, b in pairs])

    return total(vector, row, total), code


@intrinsic
def dot_row(typing, row, array, index):
    """The products of a row with the one at an index, summed lane by lane."""

    def code(context, builder, signature, args):
        total = None
        for k, a in enumerate(cgutils.unpack_tuple(builder, args[0])):
            b = load_wide(context, builder, array.dtype, args[1], offset(builder, args[2], k * LANES))
            total = builder.fmul(a, b) if total is None else fma_values(builder, a, b, total)
        return total

    return row.dtype(row, array, types.intp), code


@intrinsic(prefer_literal=True)
def fma_taps(typing, weights, rows, t, array, channels, c, totals, n):
    """Adds, for each group k of n vectors of `totals`, weights[t + k] times the row at array[rows[t + k], c]."""

    def code(context, builder, signature, args):
        weights_, rows_, t_, array_, channels_, c_, totals_, _ = args
        vectors = cgutils.unpack_tuple(builder, totals_)
        for k in range(len(vectors) // n.literal_value):
            tap = offset(builder, t_, k)
            weight = repeat(builder, builder.load(builder.gep(weights_, [tap])))
            row = builder.sext(builder.load(builder.gep(rows_, [tap])), channels_.type)
            start = builder.add(builder.mul(row, channels_), c_)
            for i in range(n.literal_value):
                at = offset(builder, start, i * LANES)
                vector = load_wide(context, builder, array.dtype, array_, at)
                which = k * n.literal_value + i
                vectors[which] = fma_values(builder, weight, vector, vectors[which])
        return context.make_tuple(builder, totals, vectors)

    return totals(weights, rows, types.intp, array, types.intp, types.intp, totals, n), code


@intrinsic(prefer_literal=True)
def fold_row(typing, row, n):
    """The sum, pair by pair, of the groups of n vectors of a row."""
    kind = types.UniTuple(row.dtype, n.literal_value)

    def code(context, builder, signature, args):
        vectors = cgutils.unpack_tuple(builder, args[0])
        groups = [vectors[k : k + kind.count] for k in range(0, len(vectors), kind.count)]
        while len(groups) > 1:
            pairs = zip(groups[::2], groups[1::2])
            groups = [[builder.fadd(a, b) for a, b in zip(*pair)] for pair in pairs]
        return context.make_tuple(builder, kind, groups[0])

    return kind(row, n), code
