"""MAT-files of version 5, checked before scipy reads them: it trusts their lengths, and a damaged one can
crash it.

Layout: "MAT-File Format" (MathWorks). A header of 128 bytes, then elements of a tag (type, bytes) and data,
padded to 8 bytes; a matrix is an element whose data are elements again: flags, dimensions, name, contents.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Any, NamedTuple

from ..runtime.extras import needs
from .source import RigSource

LARGEST = 2**26
"""Largest size in bytes of a file, and of a variable that is unpacked."""
DEEPEST = 20
"""Largest depth of nested structs and cells."""
MATRIX, COMPRESSED = 14, 15
SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
"""Bytes per value, by type of data."""
CELL, STRUCT, TEXT, NUMBERS = 1, 2, 4, range(6, 16)
COMPLEX = 0x800


class _Element(NamedTuple):
    kind: int
    data: memoryview


def load_variables(source: RigSource) -> dict[str, Any]:
    """Load the variables of a .mat file made of structs, cells, text and numbers; others are left out.

    Returns:
        Values by name as scipy simplifies them: structs as mappings, cells and arrays of structs as lists or
        arrays, text as str, numbers as arrays without axes of length 1, or scalars.

    Raises:
        RigFileError: for a file that is missing, empty, too large, damaged, or not of version 5 to 7.
        ImportError: without scipy.
    """
    data = source.content()
    if not data:
        raise source.fail(None, "is empty")
    if data.startswith(b"MATLAB 7.3"):
        raise source.fail(None, "is a version 7.3 .mat file: save it with save(..., '-v7')")
    with needs("calibration", "reading .mat files"):
        from scipy.io import loadmat
    try:
        loaded = loadmat(BytesIO(data), simplify_cells=True, variable_names=readable_variables(data))
    except Exception as error:
        # Whatever the parser trips over in a damaged file, the cause is the file.
        raise source.fail(None, f"is not a .mat file that can be read ({error}); was it cut off?") from None
    return {name: value for name, value in loaded.items() if not name.startswith("__")}


def readable_variables(content: bytes) -> list[str]:
    """List the variables of a MAT-file's bytes that `load_variables` loads: of structs, cells, text, numbers.

    Returns:
        Their names, in the file's order.

    Raises:
        ValueError: for a file that is no MAT-file of version 5 to 7, too large, or damaged.
    """
    if len(content) > LARGEST:
        raise ValueError(f"it has {len(content)} bytes; at most {LARGEST} are read")
    if len(content) < 136 or content[124:128] not in (b"\0\1IM", b"\1\0MI"):
        raise ValueError("it is not of version 5 to 7")
    order = "<" if content[126:128] == b"IM" else ">"
    names = []
    for element in _elements(memoryview(content)[128:], order):
        if element.kind == COMPRESSED:
            element = next(_elements(_unpacked(element.data), order), element)
        if element.kind != MATRIX:
            raise ValueError("a variable is no matrix")
        name = _check_matrix(element.data, order, 0)
        if name is not None:
            names.append(name)
    if len(set(names)) < len(names):
        raise ValueError("two variables have one name")
    return names


def _unpacked(data: memoryview) -> memoryview:
    unpack = zlib.decompressobj()
    try:
        content = unpack.decompress(data, LARGEST)
    except zlib.error as error:
        raise ValueError(f"a variable cannot be unpacked: {error}") from None
    if unpack.unconsumed_tail or not unpack.eof:
        raise ValueError("a variable is too large, or cut off")
    return memoryview(content)


def _elements(data: memoryview, order: str) -> Iterator[_Element]:
    """Yield the elements one after the other; ValueError for one that is not whole."""
    offset = 0
    while offset < len(data):
        if offset + 8 > len(data):
            raise ValueError("it ends within a tag")
        kind, length = struct.unpack_from(order + "II", data, offset)
        small = kind >> 16
        if small:
            if small > 4:
                raise ValueError("a short element is too long")
            yield _Element(kind & 0xFFFF, data[offset + 4 : offset + 4 + small])
            offset += 8
            continue
        if offset + 8 + length > len(data):
            raise ValueError("it ends within an element")
        yield _Element(kind, data[offset + 8 : offset + 8 + length])
        offset += 8 + length + (0 if kind == COMPRESSED else -length % 8)


def _check_matrix(data: memoryview, order: str, depth: int) -> str | None:
    """Return the name of a matrix; None for one of a class that is not read; ValueError for a damaged one."""
    if depth > DEEPEST:
        raise ValueError(f"it is nested more than {DEEPEST} deep")
    parts = _elements(data, order)
    flags, dims, name = (next(parts, _Element(0, data[:0])) for _ in range(3))
    if flags.kind != 6 or len(flags.data) != 8:
        raise ValueError("a matrix has no flags")
    word = struct.unpack_from(order + "I", flags.data)[0]
    kind, is_complex = word & 0xFF, bool(word & COMPLEX)
    if kind not in (CELL, STRUCT, TEXT, *NUMBERS):
        return None
    if dims.kind != 5 or len(dims.data) % 4 or not 8 <= len(dims.data) <= 32 or name.kind != 1:
        raise ValueError("a matrix has no dimensions or no name")
    lengths = struct.unpack(f"{order}{len(dims.data) // 4}i", dims.data)
    if min(lengths) < 0:
        raise ValueError("a matrix has a negative dimension")
    readable = _check_contents(parts, order, depth, (kind, math.prod(lengths), is_complex))
    return bytes(name.data).decode("ascii") if readable else None


def _check_contents(parts: Iterator[_Element], order: str, depth: int, what: tuple[int, int, bool]) -> bool:
    """Return True if a matrix, and those in it, can be read; ValueError for other sizes than it states."""
    kind, count, is_complex = what
    if kind in (CELL, STRUCT):
        wanted = count * (_fields(parts, order) if kind == STRUCT else 1)
        inner = [
            _check_matrix(element.data, order, depth + 1) if len(element.data) else ""
            for element in _matrices(parts)
        ]
        if len(inner) != wanted:
            raise ValueError("a struct or cell has another number of entries than it states")
        return None not in inner
    rest = list(parts)
    if len(rest) != (2 if is_complex else 1):
        raise ValueError("a matrix has another number of parts than it states")
    for element in rest:
        size = SIZES.get(element.kind)
        # Text may be coded with a varying number of bytes.
        if size is None or (len(element.data) != count * size and not (kind == TEXT and element.kind == 16)):
            raise ValueError("a matrix has another number of values than it states")
    return True


def _fields(parts: Iterator[_Element], order: str) -> int:
    """Return the number of a struct's fields; ValueError if their names are damaged."""
    length, names = (next(parts, _Element(0, memoryview(b""))) for _ in range(2))
    if length.kind != 5 or len(length.data) != 4 or names.kind != 1:
        raise ValueError("a struct has no field names")
    each = struct.unpack_from(order + "i", length.data)[0]
    if not 1 <= each <= 64 or len(names.data) % each:
        raise ValueError("the field names of a struct are damaged")
    encoded = [bytes(names.data[i : i + each]) for i in range(0, len(names.data), each)]
    if len(set(encoded)) < len(encoded) or not all(0 in name for name in encoded):
        raise ValueError("the field names of a struct are damaged")
    return len(encoded)


def _matrices(parts: Iterator[_Element]) -> Iterator[_Element]:
    for element in parts:
        if element.kind != MATRIX:
            raise ValueError("an entry of a struct or cell is no matrix")
        yield element
