"""Data of the kernels: inputs of a call, and scratch, as tuples of arrays outside and of pointers inside.

Pointers count no references (a fifth of the time otherwise); the caller keeps the arrays alive.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np
from numba import types

from arraygeom.runtime.compiled import compiled

from .emit import LANES, instruction
from .vectors import from_index

BLOCK = 16
"""Alpha pixels that are processed together, step by step."""

LAYOUT = (
    ("sample_count", "integer", "pixel"),
    ("index", "integer", "sample"),  # which of the samples this is, of those that count
    ("cell", "integer", "sample"),  # the upper left pixel of the four around it
    ("tap", "integer", "sample"),  # its first tap
    ("x", "number", "sample"),
    ("y", "number", "sample"),
    ("ahead", "number", "sample"),  # where it lies in the cell, along the way that the samples run
    ("aside", "number", "sample"),  # and across
    ("score", "number", "sample"),
    ("weight", "number", "sample"),
    ("slope", "number", "sample"),  # gradient by the weight
    ("score_slope", "number", "sample"),
    ("tap_count", "integer", "pixel"),
    ("rows", "integer", "tap"),  # the taps' pixels in beta
    ("by_key", "number", "tap"),  # inner products with the query; in forward then the weights
    ("by_value", "number", "tap"),  # inner products with the gradient by the output
    ("query", "number", "channel"),
    ("upstream", "number", "channel"),
)
"""Scratch of a block: name, kind, and the part of an alpha pixel that has one entry."""

Block = namedtuple("Block", [name for name, _, _ in LAYOUT])  # type: ignore[misc]


def block_scratch(samples: int, channels: int, number: np.dtype) -> Block:
    """Allocate the scratch memory in which a block of BLOCK alpha pixels is computed.

    Args:
        samples: samples of a pixel.
        channels: channels of query or value, the larger number.
        number: type of computation, float32 or float64.

    Returns:
        `Block` of an array (BLOCK, length) for each line of `LAYOUT`, the values of a pixel side by side,
        int32 or of type `number`; not initialised.
    """
    lengths = {"pixel": 1, "sample": samples + LANES, "tap": 4 * samples + 2 * LANES, "channel": channels}
    ends = {"integer": 0, "number": 0}
    slices = []
    for _, kind, each in LAYOUT:
        slices.append(slice(ends[kind], ends[kind] + lengths[each]))
        ends[kind] = slices[-1].stop
    rooms = {
        kind: np.empty((BLOCK, ends[kind]), dtype)
        for kind, dtype in (("integer", np.int32), ("number", number))
    }
    return Block(*(rooms[kind][:, columns] for (_, kind, _), columns in zip(LAYOUT, slices)))


class Geometry(NamedTuple):
    """Positions of a call's samples; arrays are flat.

    Attributes:
        points: x and y of each pixel's two ends, or of its explicit positions, in turn.
        mask: bytes, 1 for each valid segment (one a pixel) or position (`samples` a pixel), otherwise 0.
        fractions: fractions of a segment at its `samples`, padded by `LANES` numbers.
        samples: number of samples per pixel.
        straight: True for segments, False for explicit positions.
        nearest: True for nearest pixels in place of bilinear interpolation.
        alpha_pixels: number of alpha's pixels in an image.
        shared: True if all images of the batch have the same points.
        height: beta's height.
        width: beta's width.
        last_x: number of beta's last column, in the type of computation.
        last_y: number of beta's last row.
        slack: pixels beyond the edge at which a sample still counts.
    """

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
    """Inputs of a call.

    Attributes:
        query: alpha's features, flat, channels last.
        key: beta's features, flat, channels last.
        value: beta's values, flat, channels last.
        geometry: positions of the samples.
        bias: numbers added to the scores, `samples` a pixel; not read unless `biased`.
        biased: True if there is a bias.
        channels: number of channels of query and key.
        value_channels: number of channels of value.
    """

    query: Any
    key: Any
    value: Any
    geometry: Geometry
    bias: Any
    biased: bool
    channels: int
    value_channels: int


class Share(NamedTuple):
    """Work of one of several callers.

    Attributes:
        first: first alpha pixel of all callers.
        last: end of the alpha pixels.
        size: number of pixels of a piece, drawn from the counter.
        counter: common counter (1) of the callers: the number of the next piece.
        block: the caller's own scratch (`Block`).
    """

    first: int
    last: int
    size: int
    counter: Any
    block: Any


class Outputs(NamedTuple):
    """Outputs of forward, to write: flat arrays, alpha's pixels image by image and row by row.

    Attributes:
        value: weighted values, channels last.
        statistics: x, y, spread and peak of each pixel; empty unless `measured`.
        logsum: logarithm of each pixel's sum of exponentials; -inf where no sample counts.
        measured: True if statistics are wanted.
    """

    value: Any
    statistics: Any
    logsum: Any
    measured: bool


class Saved(NamedTuple):
    """Results of forward, and gradients by its outputs: flat arrays in the order of `Outputs`.

    Attributes:
        statistics: statistics of forward; pixel p's start at `step` p.
        logsum: logarithms of the sums of exponentials.
        value_upstream: gradients by the values.
        statistics_upstream: gradients by the statistics, at the same places.
        step: 4; 0 if there are no statistics, with four zeros in either array for all pixels.
    """

    statistics: Any
    logsum: Any
    value_upstream: Any
    statistics_upstream: Any
    step: int


class Gradients(NamedTuple):
    """Flat arrays for the gradients of alpha's pixels, with flags for the wanted ones.

    `points` and `bias` are written only where samples count, so they must be zero before.

    Attributes:
        query: gradients by the query, `channels` a pixel.
        points: gradients by the points, in their order in `Geometry`, for each image even if `shared`.
        bias: gradients by the bias, `samples` a pixel.
        wants_query: True if `query` is wanted.
        wants_points: True if `points` is wanted.
        wants_bias: True if `bias` is wanted.
    """

    query: Any
    points: Any
    bias: Any
    wants_query: bool
    wants_points: bool
    wants_bias: bool


class TapList(NamedTuple):
    """Input of `scatter`: a row for each alpha pixel from `first` on, whose first `tap_count` entries count.

    Attributes:
        first: first alpha pixel.
        tap_count: number of its taps (n, 1).
        rows: flat numbers of beta's pixels of the taps (n, most), counted through all images.
        key_weight: weights of the taps in the gradient by the key (n, most).
        value_weight: weights of the taps in the gradient by the value (n, most).
    """

    first: int
    tap_count: Any
    rows: Any
    key_weight: Any
    value_weight: Any


class Taps(NamedTuple):
    """Fields of a block that backward stores in a `TapList`.

    Attributes:
        tap_count: number of each pixel's taps.
        rows: flat numbers of beta's pixels, one for each tap, as in `TapList`.
    """

    tap_count: Any
    rows: Any


class Column(NamedTuple):
    """Pointer form of an array of two axes: one list for each pixel.

    Attributes:
        first: pointer to the first list.
        step: distance to the next list, in numbers.
    """

    first: Any
    step: Any


# ---- from arrays to pointers ---------------------------------------------------------------------


def _pointed(kind):
    """Type of the result of `pointers` for a type."""
    if isinstance(kind, types.Array):
        first = types.CPointer(kind.dtype)
        return first if kind.ndim == 1 else types.NamedTuple([first, types.intp], Column)
    if isinstance(kind, types.BaseTuple):
        parts = [_pointed(member) for member in kind.types]
        return types.BaseTuple.from_types(parts, getattr(kind, "instance_class", None))
    return kind


def _point(code, kind, value):
    if isinstance(kind, types.Array):
        array = code.context.make_array(kind)(code.context, code.builder, value)
        if kind.ndim == 1:
            return array.data
        size = code.context.get_constant(types.intp, kind.dtype.bitwidth // 8)
        return _tuple(code, kind, [array.data, code.sdiv(code.parts(array.strides)[0], size)])
    if isinstance(kind, types.BaseTuple):
        return _tuple(code, kind, [_point(code, *member) for member in zip(kind.types, code.parts(value))])
    return value


def _tuple(code, kind, parts):
    return code.context.make_tuple(code.builder, _pointed(kind), parts)


@instruction(_pointed)
def pointers(code, arrays):
    """Convert a tuple of arrays, nested ones too, to pointers for flat arrays and a `Column` for arrays of
    two axes."""
    return _point(code, code.kinds[0], arrays)


def _first_of_each(block, *_):
    return types.BaseTuple.from_types([column.types[0] for column in block.types], block.instance_class)


@instruction(_first_of_each)
def pixel_of(code, block, slot: index):
    """Return the pointers of one pixel of a block."""
    columns = [code.parts(column) for column in code.parts(block)]
    return code.pack([code.gep(first, [code.mul(slot, step)]) for first, step in columns])


@instruction(lambda block, other: block)
def replaced(code, block, other):
    """Replace the columns of a block that another tuple has by the same name."""
    names, others = (kind.instance_class._fields for kind in code.kinds)
    changed = dict(zip(others, code.parts(other)))
    return code.pack([changed.get(name, column) for name, column in zip(names, code.parts(block))])


@compiled
def of(column, slot):
    """Return the list of one pixel."""
    return from_index(column.first, slot * column.step)


@compiled
def from_pixel(column, slot):
    """Return the column from one pixel on."""
    return Column(of(column, slot), column.step)
