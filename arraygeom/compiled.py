"""Functions compiled by numba, and where it keeps what it compiled. Importing this imports numba."""

from __future__ import annotations

import inspect
from typing import Any
from uuid import uuid4

from numba import njit


def compiled(function=None, **options):
    """numba's njit, of the bare function: a checker of types that tests put around it cannot be compiled."""
    return njit(inspect.unwrap(function), **options) if function else lambda function: compiled(function, **options)


def separate_cache(entry: Any) -> None:
    """Let this process name the files of its compiled code in numba's cache by itself.

    numba counts them. Two processes that compile at once, each for other types, can choose the same number: then the
    index of one names the code of the other, which is loaded, and computes something else.
    """
    file = entry._cache._cache_file
    file._data_name_pattern = file._data_name_pattern.replace(".nbc", f"-{uuid4().hex}.nbc")
