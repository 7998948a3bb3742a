"""Numba intrinsics made of functions that emit LLVM's instructions.

The body of such a function is Python that runs at compile time: a loop in it is unrolled code.
"""

from __future__ import annotations

import inspect
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

LANES = 16
NARROW = 8
"""Lanes of a vector where there may be few channels."""


class Vector(types.Type):
    """Numba type of a vector of `lanes` numbers in one or two registers."""

    def __init__(self, scalar, lanes=LANES):
        self.scalar, self.lanes = scalar, lanes
        super().__init__(name=f"Vector({scalar}, {lanes})")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(manager[kind.scalar].get_value_type(), kind.lanes))


def row_of(vector, n):
    """Return the numba type of a row: a tuple of n vectors."""
    return types.UniTuple(vector, getattr(n, "literal_value", n))


class Code:
    """Emitter of LLVM instructions in the body of one intrinsic.

    Other attributes are looked up in `builder`, LLVM's own emitter.

    Attributes:
        context: numba's target context.
        builder: llvmlite's builder.
        kinds: numba's types of the intrinsic's arguments.
        result: numba's type of the intrinsic's value.
    """

    def __init__(self, context, builder, kinds, result):
        self.context, self.builder, self.kinds, self.result = context, builder, kinds, result

    def __getattr__(self, name: str) -> Any:
        """Return LLVM's instruction of this name."""
        return getattr(self.builder, name)

    def offset(self, index, k: int):
        """index + k."""
        return self.builder.add(index, ir.Constant(index.type, k))

    def at(self, address, index):
        """Load the number at an index."""
        return self.builder.load(self.builder.gep(address, [index]))

    def get(self, array, address, index, lanes=LANES):
        """Load the vector at an index; `array` is the type of the pointer."""
        lane = ir.VectorType(self.context.get_data_type(array.dtype), lanes)
        place = self.builder.bitcast(self.builder.gep(address, [index]), lane.as_pointer())
        return self.builder.load(place, align=array.dtype.bitwidth // 8)

    def put(self, array, address, index, vector):
        """Store a vector at an index."""
        place = self.builder.bitcast(self.builder.gep(address, [index]), vector.type.as_pointer())
        self.builder.store(vector, place, align=array.dtype.bitwidth // 8)

    def repeat(self, number, lanes=LANES):
        """Make a vector of one repeated number."""
        undefined = ir.Constant(ir.VectorType(number.type, lanes), ir.Undefined)
        return self.shuffle(self.insert_element(undefined, number, ir.IntType(32)(0)), None, [0] * lanes)

    def shuffle(self, a, b, lanes):
        """Select lanes of two vectors, or of one (`b` None)."""
        return self.shuffle_vector(a, a if b is None else b, _constants(lanes))

    def intrinsic(self, name: str, result, args, **options):
        """Call one of LLVM's intrinsics by its name; `%` stands for the kind of vector."""
        vector = args[-1].type
        full = name.replace("%", f"v{vector.count}{'f64' if vector.element == ir.DoubleType() else 'f32'}")
        function = ir.FunctionType(result, [value.type for value in args])
        return self.call(cgutils.get_or_insert_function(self.module, function, full), args, **options)

    def fused(self, a, b, c):
        """a b + c, rounded once."""
        return self.intrinsic("llvm.fma.%", a.type, [a, b, c])

    def parts(self, value):
        """Unpack the values of a tuple."""
        return cgutils.unpack_tuple(self.builder, value)

    def pack(self, parts):
        """Pack values into a tuple of the result's type."""
        return self.context.make_tuple(self.builder, self.result, parts)


def _constants(lanes):
    return ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes)


def instruction(result):
    """Make a decorator that turns a function into a numba intrinsic.

    The function takes a `Code` and LLVM values, emits instructions, and returns LLVM's value, or None for
    void. Arguments annotated `index` are 64-bit; those annotated `literal` are Python's numbers.

    Args:
        result: function from the arguments' numba types to the result's type.
    """

    def decorate(emit):
        """Make numba's intrinsic of the function `emit`, with its name. Parameters annotated "index" are
        whole numbers, "literal" ones constants, others of any type."""
        _, *parameters = inspect.signature(inspect.unwrap(emit)).parameters.values()
        notes = [str(parameter.annotation) for parameter in parameters]

        def typed(typing, *kinds):
            numba_type = result(*kinds)
            taken = [types.intp if note == "index" else kind for note, kind in zip(notes, kinds)]

            def code(context, builder, signature, args):
                values = [
                    kind.literal_value if note == "literal" else a
                    for note, kind, a in zip(notes, kinds, args)
                ]
                out = inspect.unwrap(emit)(Code(context, builder, kinds, numba_type), *values)
                return context.get_dummy_value() if out is None else out

            return numba_type(*taken), code

        first = inspect.Parameter("typing", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        typed.__signature__ = inspect.Signature([first, *parameters])  # type: ignore[attr-defined]
        typed.__name__, typed.__doc__ = emit.__name__, emit.__doc__
        return intrinsic(prefer_literal="literal" in notes)(typed)

    return decorate
