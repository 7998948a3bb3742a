"""Functions compiled by numba, and their cache."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from .atomic import alone
from .warned import warn

LONGEST = 300.0
"""Seconds that a process waits for another one that compiles the same function."""


def compiled(function=None, **options):
    """Compile a function by numba's njit, without the type checker that tests wrap around it.

    It is compiled at the first call with arguments of new types. With `cache=True` (for functions that are
    called from Python) machine code is stored in a folder, by one process at a time; if no folder can be
    written, each process compiles for itself, with a warning.

    Args:
        function: function to compile; None when used as a decorator with options.
        options: njit's options.

    Returns:
        The compiled function; without `function` a decorator.

    Raises:
        ImportError: without numba. numba's own errors pass, at the first call where the code causes them.
    """
    from numba import njit

    if function is None:
        return lambda function: compiled(function, **options)
    if options.get("cache"):
        options["no_cfunc_wrapper"] = True
    try:
        entry = njit(inspect.unwrap(function), **options)
    except RuntimeError as error:
        if not options.pop("cache", False) or "no locator" not in str(error):
            raise
        _warn_of_no_folder()
        return njit(inspect.unwrap(function), **options)
    if options.get("cache"):
        _one_process_at_a_time(entry)
    return entry


def _one_process_at_a_time(entry: Any) -> None:
    """Make processes wait for the one that compiles an entry point, and then load its result.

    numba counts its files: two processes that compile at once, each for other types, can choose the same
    number, and then load each other's code.
    """
    compile_entry, lock = entry.compile, Path(entry.stats.cache_path) / f"{entry.__name__}.lock"

    def compile_alone(signature: Any) -> Any:
        with alone(lock, LONGEST):
            return compile_entry(signature)

    entry.compile = compile_alone


@cache
def can_compile() -> bool:
    """Return True if numba is installed; without it, functions with a readable form use that."""
    return find_spec("numba") is not None


@cache
def _warn_of_no_folder() -> None:
    warn(
        "compiled kernels cannot be kept, and each process compiles them again: "
        "let NUMBA_CACHE_DIR name a folder that can be written"
    )


def cache_folder(entry: Any) -> str | None:
    """Return the folder of an entry point's cache; None if it has none."""
    return entry.stats.cache_path


def renew_with(entry: Any, sources: Iterable[Path]) -> None:
    """Make numba renew the cache of an entry point when any of these files changes, not only its own."""
    if cache_folder(entry) is not None:
        text = b"".join(path.read_bytes() for path in sorted(sources))
        entry._cache._cache_file._source_stamp = hashlib.sha256(text).hexdigest()
