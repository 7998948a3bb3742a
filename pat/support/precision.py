"""Computing in the precision of the tensors given."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def without_autocast() -> Iterator[None]:
    """Whatever autocast is in effect around: parts that may be less precise say so themselves."""
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        yield
