"""The checker of types and shapes that the tests put around every function, by jaxtyping's import hook.

jaxtyping's own decorator checks arguments twice, binds each call by hand, and decorates inner functions anew
whenever their outer one runs: it doubled the time of the tests. This one checks the same once, and leaves
inner functions alone; axes that are numbers or names it compares itself, in a fifth of the time.
"""

from __future__ import annotations

import functools
import re
import threading
from collections.abc import Callable
from dataclasses import is_dataclass
from types import FunctionType
from typing import Any, get_args, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype

of_types = beartype(conf=BeartypeConf(is_pep484_tower=True, violation_type=TypeError))
"""beartype, taking an int for a float, as PEP 484 does; as jaxtyping's, its errors are TypeErrors."""
WITH_ARGUMENTS = jaxtyping.jaxtyped
"""jaxtyping's own, which also knows axes named after arguments, as "h*{factor}"."""
ARRAY = type(jaxtyping.Float[Any, ""])
"""The class of the types of arrays."""
AS_JAXTYPING = ARRAY.__instancecheck_str__
"""What is wrong with a value for a type, in words; empty if nothing. Axes as those of the call before."""
ORDINARY = re.compile(r"\*?[A-Za-z_]\w*|\d+|\.\.\.")
"""An axis that is a name, a number, or any number of axes."""


class Calls(threading.local):
    """For each call checked in a thread the sizes of its axes by name; None: jaxtyping knows them."""

    def __init__(self) -> None:
        self.sizes: list[dict[str, Any] | None] = []


CALLS = Calls()
MAKING = threading.Lock()
"""Checks are made by one thread at a time: a function's annotations are others for a moment."""


def install() -> None:
    """Check the packages' functions as they are imported."""
    jaxtyping.jaxtyped = jaxtyped
    ARRAY.__instancecheck_str__ = problem
    ARRAY.__instancecheck__ = is_of
    jaxtyping.install_import_hook(["arraygeom", "pat", "calib"], f"{__name__}.of_types")


def jaxtyped(fn: Any = None, *, typechecker: Any = None) -> Any:
    """In place of `jaxtyping.jaxtyped`, which the hook puts on every function and class."""
    if fn is None:
        return functools.partial(jaxtyped, typechecker=typechecker)
    if isinstance(fn, type):
        if is_dataclass(fn) and "__init__" in vars(fn):
            fn.__init__ = checked(fn.__init__)
        return fn
    return fn if "<locals>" in fn.__qualname__ else checked(fn)


def checked(fn: Callable) -> Callable:
    """The function, arguments and result checked: types, and the sizes of axes against each other.

    What checks it is made at its first call: most tests call few of all functions.
    """
    if any("{" in str(hint) for hint in fn.__annotations__.values()):
        ready = WITH_ARGUMENTS(fn, typechecker=of_types), False
    else:
        ready = None

    def checking(*args, **kwargs):
        nonlocal ready
        if ready is None:
            import torch  # here, as xdist's own process needs none

            if torch.compiler.is_compiling():  # which cannot follow how checks are made
                return fn(*args, **kwargs)
            ready = typed_and_ours(fn)
        typed, ours = ready
        if ours is None:
            return typed(*args, **kwargs)
        calls = CALLS.sizes
        calls.append({} if ours else None)
        try:
            return typed(*args, **kwargs)
        finally:
            calls.pop()

    of_module = FunctionType(checking.__code__, named(fn.__module__), fn.__name__, None, checking.__closure__)
    return functools.wraps(fn)(of_module)


@functools.cache
def named(module: str) -> dict[str, Any]:
    """Types that checks need, by the name of a module they are in: `warn` takes their lines for that
    module's."""
    return globals() | {"__name__": module}


def typed_and_ours(fn: Callable) -> tuple[Callable, bool | None]:
    """The function, its types checked, and whether axes are compared here or by jaxtyping (None: no axes)."""
    with MAKING:
        written = fn.__annotations__
        hints = {name: known(hint, fn.__globals__) for name, hint in written.items()}
        fn.__annotations__ = hints
        typed = of_types(fn)
        fn.__annotations__ = written  # the compiled kernels read theirs
    types = {one for hint in hints.values() for one in arrays_in(hint)}
    ours = all(map(axes_of, types)) if types else None
    return (in_context(typed) if ours is False else typed), ours


def in_context(typed: Callable) -> Callable:
    """A checked function some of whose axes are for jaxtyping alone, as "*#b" and "d+1"."""

    @functools.wraps(typed)
    def with_context(*args, **kwargs):
        with WITH_ARGUMENTS("context"):
            return typed(*args, **kwargs)

    return with_context


def arrays_in(hint: Any) -> list[Any]:
    """The types of arrays in a type."""
    inner = [one for part in get_args(hint) for one in arrays_in(part)] if not isinstance(hint, list) else []
    inner += [one for part in hint for one in arrays_in(part)] if isinstance(hint, list | tuple) else []
    return [hint, *inner] if isinstance(hint, ARRAY) else inner


@functools.cache
def axes_of(array: Any) -> tuple[list[str | int | None], int, Any] | None:
    """The names (None: any size) and sizes of axes, the place of the one that stands for any number of them
    (-1: none), and the same type with any axes. None for axes that are not `ORDINARY`."""
    words = array.dim_str.split()
    if not all(ORDINARY.fullmatch(word) for word in words):
        return None
    several = [i for i, word in enumerate(words) if word == "..." or word.startswith("*")]
    axes = [
        int(w) if w.isdigit() else None if w == "..." or w.lstrip("*").startswith("_") else w for w in words
    ]
    return axes, several[0] if several else -1, array.dtype[array.array_type, "..."]


def is_of(array: Any, value: Any) -> bool:
    """Return True if a value is of a type of arrays: `problem`, quicker for values like one seen before."""
    calls = CALLS.sizes
    if not calls or (sizes := calls[-1]) is None:
        return not problem(array, value)
    try:
        named = NAMED[array, type(value), value.dtype, value.shape]
    except (AttributeError, KeyError):
        return not problem(array, value)
    if type(named) is str:
        return False
    for axis, size in named.items():
        if sizes.get(axis, size) != size:
            return False
    sizes.update(named)
    return True


def problem(array: Any, value: Any) -> str:
    """Return the fault of a value for a type of arrays; empty if there is none. As jaxtyping, but quickly."""
    calls = CALLS.sizes
    sizes = calls[-1] if calls else None
    if sizes is None or axes_of(array) is None:
        return AS_JAXTYPING(array, value)
    kind = (array, type(value), getattr(value, "dtype", None), getattr(value, "shape", None))
    named = NAMED.get(kind)
    if named is None:
        named = NAMED[kind] = sizes_in(array, value)
    if type(named) is str:
        return named
    for axis, size in named.items():
        if sizes.get(axis, size) != size:
            return f"axis {axis} is {size}, not {sizes[axis]}"
    sizes.update(named)
    return ""


def sizes_in(array: Any, value: Any) -> dict[str, int] | str:
    """The sizes of a value's axes by name, or what is wrong with it whatever the sizes of others."""
    axes, several, any_axes = axes_of(array)
    wrong = AS_JAXTYPING(any_axes, value)
    if wrong:
        return wrong
    shape = tuple(value.shape)
    if several >= 0:
        end = several + 1 + len(shape) - len(axes)
        if end < several:
            return f"it has {len(shape)} axes, fewer than {len(axes) - 1}"
        shape = (*shape[:several], shape[several:end], *shape[end:])
    elif len(shape) != len(axes):
        return f"it has {len(shape)} axes, not {len(axes)}"
    found: dict[str, Any] = {}
    for axis, size in zip(axes, shape):
        if axis is not None and size != (axis if type(axis) is int else found.setdefault(axis, size)):
            return f"axis {axis} is {size}, not {found.get(axis, axis)}"
    return found


NAMED: dict[tuple[Any, type, Any, Any], dict[str, int] | str] = {}
"""What `sizes_in` says of values of a class, a dtype and a shape for a type of arrays."""


def known(hint: Any, names: dict[str, Any]) -> Any:
    """The type that a text names; Any for one that is not defined yet, or only for type checkers."""

    def holder(value): ...

    holder.__annotations__["value"] = hint
    try:
        return get_type_hints(holder, names, include_extras=True)["value"]
    except Exception:
        return Any
