"""Functions compiled by numba, and where it keeps what it compiled."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from uuid import uuid4

from .atomic import alone
from .warned import warn

COMPILED = "arraygeom:compiled"
LONGEST = 60.0
"""Seconds for which a process waits for another that compiles what it needs, before it does so, too."""


def compiled(function=None, **options):
    """numba's njit, of the bare function: a checker of types that tests put around it cannot be compiled.

    With `cache` it is called from Python; without, mostly by compiled functions. Where there is no folder
    that can be written, what `cache` asks to keep is compiled by each process.
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
        separate_cache(entry)
        _one_process_at_a_time(entry)
    return entry


def _one_process_at_a_time(entry: Any) -> None:
    """Let other processes wait for the one that compiles an entry point, and then load what it kept.

    What is not kept yet is an event of the kind `COMPILED`, for numba's listeners.
    """
    from numba.core.event import trigger_event

    compile_entry, lock = entry.compile, Path(cache_file(entry)._index_path).with_suffix(".lock")

    def compile_alone(signature: Any) -> Any:
        if is_kept(entry, signature):
            return compile_entry(signature)
        with trigger_event(COMPILED), alone(lock, LONGEST):
            return compile_entry(signature)

    entry.compile = compile_alone


@cache
def can_compile() -> bool:
    """Whether numba is installed: without it, what has a readable form takes that."""
    return find_spec("numba") is not None


@cache
def _warn_of_no_folder() -> None:
    warn(
        "compiled kernels cannot be kept, and each process compiles them again: "
        "let NUMBA_CACHE_DIR name a folder that can be written"
    )


def cache_file(entry: Any) -> Any:
    """numba's description of the files in which an entry point is kept; None where it is not."""
    return getattr(entry._cache, "_cache_file", None)


def cache_folder(entry: Any) -> str | None:
    """The folder in which an entry point is kept; None where it is not."""
    return None if cache_file(entry) is None else entry._cache._cache_path


def is_kept(entry: Any, signature: Any) -> bool:
    """Whether an entry point's code for such arguments is in the cache."""
    return entry._cache._index_key(signature, entry.targetctx.codegen()) in cache_file(entry)._load_index()


def renew_with(entry: Any, sources: Iterable[Path]) -> None:
    """Let numba's cache of an entry point be renewed when any of these files changes, not its own alone."""
    if (file := cache_file(entry)) is not None:
        text = b"".join(path.read_bytes() for path in sorted(sources))
        file._source_stamp = hashlib.sha256(text).hexdigest()


def separate_cache(entry: Any) -> None:
    """Let this process name the files of its compiled code in numba's cache by itself.

    numba counts them. Two processes that compile at once, each for other types, can choose the same number:
    then the index of one names the code of the other, which is loaded, and computes something else.
    """
    file = cache_file(entry)
    if file is not None:
        file._data_name_pattern = file._data_name_pattern.replace(".nbc", f"-{uuid4().hex}.nbc")
