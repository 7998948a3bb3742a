"""The checker of types and shapes that the tests put around every function, by jaxtyping's import hook.

jaxtyping's own decorator checks arguments twice, binds each call by hand, and decorates inner functions anew whenever
their outer one runs: it doubled the time of the tests. This one checks the same once, and leaves inner functions alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import is_dataclass
from typing import Any, get_type_hints

import jaxtyping
from beartype import BeartypeConf, beartype

of_types = beartype(conf=BeartypeConf(is_pep484_tower=True, violation_type=TypeError))
"""beartype, taking an int where a float is asked for, as PEP 484 does; as jaxtyping's, its errors are TypeErrors."""
WITH_ARGUMENTS = jaxtyping.jaxtyped
"""jaxtyping's own, which also knows axes named after arguments, as "h*{factor}"."""


def install() -> None:
    """Check the packages' functions as they are imported."""
    jaxtyping.jaxtyped = jaxtyped
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
    """The function with its arguments and its result checked: types, and the sizes of axes against each other."""
    if any("{" in str(hint) for hint in fn.__annotations__.values()):
        return WITH_ARGUMENTS(fn, typechecker=of_types)
    written = fn.__annotations__
    hints = {name: known(hint, fn.__globals__) for name, hint in written.items()}
    fn.__annotations__ = hints
    typed = of_types(fn)
    fn.__annotations__ = written  # the compiled kernels read theirs
    if all(is_plain(hint) for hint in hints.values()):
        return typed

    @functools.wraps(fn)
    def with_axes(*args, **kwargs):
        with WITH_ARGUMENTS("context"):
            return typed(*args, **kwargs)

    return with_axes


def is_plain(hint: Any) -> bool:
    """Whether a type is a class that says nothing of axes."""
    return isinstance(hint, type) and not issubclass(hint, jaxtyping.AbstractArray)


def known(hint: Any, names: dict[str, Any]) -> Any:
    """The type that a text names; Any for one that is not defined yet, or only for type checkers."""

    def holder(value): ...

    holder.__annotations__["value"] = hint
    try:
        return get_type_hints(holder, names, include_extras=True)["value"]
    except Exception:
        return Any
