"""Instructions on `LANES` numbers at a time, and on rows of vectors.

A *row* is a tuple of n vectors that lie side by side, n being known at compile time; it stays in registers.
"""

from __future__ import annotations

from llvmlite import ir
from numba import types

from .emit import LANES, NARROW, Vector, instruction, row_of

TAP_BLOCK = 4


def _nothing(*_):
    return types.void


def _first(kind, *_):
    return kind


# ---- memory --------------------------------------------------------------------------------------


@instruction(lambda counter: counter.dtype)
def take(code, counter):
    """Increment the number at a pointer atomically; returns its former value."""
    return code.atomic_rmw("add", counter, ir.Constant(counter.type.pointee, 1), "monotonic")


@instruction(_first)
def from_index(code, array, i: index):
    """Return the pointer to an index."""
    return code.gep(array, [i])


@instruction(lambda array: array.dtype)
def zero(code, array):
    """Return 0 in the type of the numbers at a pointer."""
    return code.context.get_constant(code.result, 0)


@instruction(lambda array, i: Vector(array.dtype))
def load(code, array, i: index):
    """Load the vector at an index."""
    return code.get(code.kinds[0], array, i)


@instruction(_nothing)
def store(code, array, i: index, vector):
    """Store a vector at an index."""
    code.put(code.kinds[0], array, i, vector)


# ---- rows ----------------------------------------------------------------------------------------


@instruction(lambda array, i, n, lanes: row_of(Vector(array.dtype, lanes.literal_value), n))
def load_row(code, array, i: index, n: literal, lanes: literal):
    """Load n vectors of `lanes` lanes from an index on."""
    return code.pack([code.get(code.kinds[0], array, code.offset(i, k * lanes), lanes) for k in range(n)])


@instruction(lambda array, starts, i: row_of(Vector(array.dtype, NARROW), starts.count))
def gather_row(code, array, starts, i: index):
    """Load the narrow vector at an index relative to each of some starts."""
    return code.pack(
        [code.get(code.kinds[0], array, code.add(start, i), NARROW) for start in code.parts(starts)]
    )


@instruction(_nothing)
def store_row(code, array, i: index, row):
    """Store a row from an index on."""
    for k, vector in enumerate(code.parts(row)):
        code.put(code.kinds[0], array, code.offset(i, k * vector.type.count), vector)


@instruction(lambda row, n: row_of(row.dtype, n))
def extend_row(code, row, n: literal):
    """Extend a row by zeros to n vectors."""
    vectors = code.parts(row)
    return code.pack(vectors + [ir.Constant(vectors[0].type, None)] * (n - len(vectors)))


@instruction(lambda array: Vector(array.dtype, NARROW))
def nothing_narrow(code, array):
    """Return a narrow vector of 0."""
    return ir.Constant(code.context.get_value_type(code.result), None)


@instruction(lambda vector, row, totals: totals)
def fma_row(code, vector, row, totals):
    """Compute totals + vector row, each rounded once; a number may replace the vector."""
    rows = list(zip(code.parts(row), code.parts(totals)))
    if not isinstance(vector.type, ir.VectorType):
        vector = code.repeat(vector, rows[0][0].type.count)
    return code.pack([code.fused(vector, a, b) for a, b in rows])


@instruction(lambda row, array, i: row.dtype)
def dot_row(code, row, array, i: index):
    """Multiply a row with the one at an index, and sum the products lane by lane."""
    total = None
    for k, a in enumerate(code.parts(row)):
        b = code.get(code.kinds[1], array, code.offset(i, k * a.type.count), a.type.count)
        total = code.fmul(a, b) if total is None else code.fused(a, b, total)
    return total


@instruction(lambda weights, rows, t, image, channels, c, totals, n: totals)
def fma_taps(code, weights, rows, t: index, image, channels: index, c: index, totals, n: literal):
    """Add a weighted pixel to each group of n vectors of `totals`.

    Group k gets weights[t + k] times the n vectors of image[rows[t + k]] from channel c on, where `image` has
    `channels` numbers a pixel.

    Returns:
        The row of new totals.
    """
    vectors = code.parts(totals)
    lanes = vectors[0].type.count
    for k in range(0, len(vectors), n):
        tap = code.offset(t, k // n)
        weight = code.repeat(code.at(weights, tap), lanes)
        start = code.add(code.mul(code.sext(code.at(rows, tap), channels.type), channels), c)
        for i in range(n):
            vector = code.get(code.kinds[3], image, code.offset(start, i * lanes), lanes)
            vectors[k + i] = code.fused(weight, vector, vectors[k + i])
    return code.pack(vectors)


@instruction(lambda row, n: row_of(row.dtype, n))
def fold_row(code, row, n: literal):
    """Sum the groups of n vectors of a row, pair by pair."""
    vectors = code.parts(row)
    groups = [vectors[k : k + n] for k in range(0, len(vectors), n)]
    while len(groups) > 1:
        groups = [[code.fadd(a, b) for a, b in zip(*pair)] for pair in zip(groups[::2], groups[1::2])]
    return code.pack(groups[0])


# ---- arithmetic ----------------------------------------------------------------------------------


def _elementwise(emit):
    """Make an intrinsic from vectors of one kind to another of the same kind."""
    return instruction(_first)(emit)


add = _elementwise(lambda code, a, b: code.fadd(a, b))
sub = _elementwise(lambda code, a, b: code.fsub(a, b))
mul = _elementwise(lambda code, a, b: code.fmul(a, b))
add_int = _elementwise(lambda code, a, b: code.add(a, b))
mul_int = _elementwise(lambda code, a, b: code.mul(a, b))
minimum_int = _elementwise(lambda code, a, b: code.select(code.icmp_signed("<", a, b), a, b))
minimum = _elementwise(lambda code, a, b: code.select(code.fcmp_ordered("<", a, b), a, b))
maximum = _elementwise(lambda code, a, b: code.select(code.fcmp_ordered(">", a, b), a, b))
"""Minimum and maximum both return b where either number is NaN."""
fma = _elementwise(lambda code, a, b, c: code.fused(a, b, c))
"""a b + c, rounded once."""
exponentials64 = _elementwise(lambda code, a: code.intrinsic("llvm.exp.%", a.type, [a]))


@_elementwise
def keep_above(code, a, limit, b):
    """Keep the numbers of b where those of a are at least the limit; 0 elsewhere."""
    return code.select(code.fcmp_ordered("<", a, limit), ir.Constant(b.type, None), b)


@_elementwise
def two_to(code, a):
    """Compute 2 to the power of whole numbers in float32."""
    whole = ir.VectorType(ir.IntType(32), LANES)
    exponent = code.add(code.fptosi(a, whole), ir.Constant(whole, [127] * LANES))
    return code.bitcast(code.shl(exponent, ir.Constant(whole, [23] * LANES)), a.type)


@instruction(Vector)
def splat(code, number):
    """Make a vector of one repeated number."""
    return code.repeat(number)


@instruction(lambda a: Vector(types.int32))
def truncated(code, a):
    """Truncate a vector's numbers towards 0, to int32."""
    return code.fptosi(a, ir.VectorType(ir.IntType(32), LANES))


@instruction(lambda whole, like: like)
def converted(code, whole, like):
    """Convert a vector of int32 to the type of another."""
    return code.sitofp(whole, like.type)


@instruction(lambda a: a.scalar)
def total(code, a):
    """Sum a vector's numbers."""
    nothing = ir.Constant(a.type.element, 0.0)
    return code.intrinsic("llvm.vector.reduce.fadd.%", a.type.element, [nothing, a], fastmath=["reassoc"])


@instruction(lambda a: a.scalar)
def largest(code, a):
    """Return the largest of a vector's numbers."""
    return code.intrinsic("llvm.vector.reduce.fmax.%", a.type.element, [a], fastmath=["reassoc"])


@instruction(_nothing)
def add_totals(code, array, i: index, a, b, c, d):
    """Add the sums of four vectors to four adjacent numbers."""
    if a.type.count > NARROW:
        sums = _wide_totals(code, a, b, c, d)
    else:
        v = _neighbours(code, _neighbours(code, a, b), _neighbours(code, c, d))
        sums = code.fadd(code.shuffle(v, None, [0, 1, 2, 3]), code.shuffle(v, None, [4, 5, 6, 7]))
    code.put(code.kinds[0], array, i, code.fadd(code.get(code.kinds[0], array, i, TAP_BLOCK), sums))


def _neighbours(code, p, q):
    """Sums of neighbours in two vectors; each four hold two of p's, then two of q's."""
    n = p.type.count
    even = [lane for k in range(0, n, 4) for lane in (k, k + 2, n + k, n + k + 2)]
    return code.fadd(code.shuffle(p, q, even), code.shuffle(p, q, [lane + 1 for lane in even]))


def _wide_totals(code, a, b, c, d):
    """Totals of wide vectors: halves are added first, then neighbours twice."""

    def folded(p, q):
        low = [*range(8), *range(16, 24)]
        return code.fadd(code.shuffle(p, q, low), code.shuffle(p, q, [lane + 8 for lane in low]))

    v = _neighbours(code, folded(a, b), folded(c, d))
    v = code.fadd(*(code.shuffle(v, None, [k + n for n in (0, 1, 2, 3, 8, 9, 10, 11)]) for k in (0, 4)))
    return code.fadd(code.shuffle(v, None, [0, 4, 2, 6]), code.shuffle(v, None, [1, 5, 3, 7]))


# ---- four numbers of each of some places ---------------------------------------------------------

FOURS, PAIRS = (
    [[lane + n for k in range(0, LANES, 4) for lane, n in zip((k + first,) * 4, steps)] for first in (0, 2)]
    for steps in ((0, LANES, 1, LANES + 1), (0, 1, LANES, LANES + 1))
)
"""Shuffles that transpose the 4 by 4 blocks side by side in four vectors."""


def _transpose(code, a, b, c, d):
    (ab_low, ab_high), (cd_low, cd_high) = (
        [code.shuffle(p, q, how) for how in FOURS] for p, q in ((a, b), (c, d))
    )
    return [code.shuffle(p, q, how) for p, q in ((ab_low, cd_low), (ab_high, cd_high)) for how in PAIRS]


@instruction(lambda array, starts, i: row_of(Vector(array.dtype), 4))
def load_fours(code, array, starts, i: index):
    """Load four vectors, the k-th of array[start + k] for the `LANES` starts at an index."""

    def four(k):
        return code.get(code.kinds[0], array, code.at(starts, code.offset(i, k)), 4)

    rows = [_side_by_side(code, [four(lane) for lane in range(k, LANES, 4)]) for k in range(4)]
    return code.pack(_transpose(code, *rows))


def _side_by_side(code, parts):
    """Join vectors into one."""
    while len(parts) > 1:
        parts = [code.shuffle(a, b, [*range(2 * a.type.count)]) for a, b in zip(parts[::2], parts[1::2])]
    return parts[0]


@instruction(_nothing)
def add_fours(code, array, starts, i: index, a, b, c, d):
    """Add the numbers of four vectors to an array, at the four places from each of `LANES` starts on.

    Lane j of `a`, `b`, `c` and `d` is added to array[start], [start + 1], [start + 2] and [start + 3] of the
    j-th start, where the starts are starts[i], starts[i + 1], ... They are taken in order, two numbers at a
    time, as the next start may touch the second two of this one.
    """
    fours = _transpose(code, a, b, c, d)
    for k in range(LANES):
        start = code.at(starts, code.offset(i, k))
        for half in range(2):
            lane = 2 * half + k // 4 * 4
            number = code.shuffle(fours[k % 4], None, [lane, lane + 1])
            place = code.offset(start, 2 * half)
            code.put(code.kinds[0], array, place, code.fadd(code.get(code.kinds[0], array, place, 2), number))


@instruction(_nothing)
def store_four(code, array, i: index, number, offsets):
    """Store array[i + k] = number + offsets[k], k from 0 to 3."""
    numbers = shifts = ir.Constant(ir.VectorType(number.type, 4), ir.Undefined)
    for k, shift in enumerate(code.parts(offsets)):
        shift = code.context.cast(code.builder, shift, code.kinds[3].dtype, code.kinds[0].dtype)
        numbers = code.insert_element(numbers, number, ir.IntType(32)(k))
        shifts = code.insert_element(shifts, shift, ir.IntType(32)(k))
    code.put(code.kinds[0], array, i, code.builder.add(numbers, shifts))
