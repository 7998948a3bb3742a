"""Progress of long work: steps go to the log, each with the share of its stage that is done.

`pat.support.steps` shows them with the remaining time. Outside a stage a step is an ordinary line of the log.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from logging import Logger
from typing import Any, NamedTuple


class _Part(NamedTuple):
    """Part of a stage, from one share of it to another."""

    stage: str
    begin: float
    end: float


_CURRENT: ContextVar[_Part | None] = ContextVar("_CURRENT", default=None)


@contextmanager
def stage(name: str = "", *, new: bool = False) -> Iterator[None]:
    """Context manager of a stage; inside another one it is a part of that, unless it is `new`."""
    outer = _CURRENT.get()
    token = _CURRENT.set(_Part(name, 0.0, 1.0) if outer is None or new else outer)
    try:
        yield
    finally:
        _CURRENT.reset(token)


@contextmanager
def part(begin: float, end: float) -> Iterator[None]:
    """Context manager of a part of the current stage or part, from share `begin` of it to share `end`, 0..1.

    Does nothing outside a stage.
    """
    outer = _CURRENT.get()
    if outer is None:
        yield
        return
    length = outer.end - outer.begin
    token = _CURRENT.set(_Part(outer.stage, outer.begin + begin * length, outer.begin + end * length))
    try:
        yield
    finally:
        _CURRENT.reset(token)


def log_step(log: Logger, share: float, text: str, *values: Any) -> None:
    """Log a step that begins when a share (0..1) of the current part is done."""
    with part(share, 1):
        log.info(text, *values)


def progress() -> tuple[str, float] | None:
    """Return the current stage and its completed share; None outside any."""
    now = _CURRENT.get()
    return None if now is None else (now.stage, now.begin)
