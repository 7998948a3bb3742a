"""Modules that only some users need."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def needs(extra: str, purpose: str) -> Iterator[None]:
    """Around the import of an optional module: raises ImportError in one line that names the extra to install."""
    try:
        yield
    except ImportError as error:
        module = (error.name or str(error)).partition(".")[0]
        raise ImportError(f"{purpose} needs {module}: pip install 'arraygeom-pat[{extra}]'") from error
