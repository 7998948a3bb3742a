"""Progress of long work: each step is shown when it begins.

Modules log their steps at level INFO: `logging.basicConfig(level=logging.INFO)` shows them in a script.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import get_ident

from arraygeom.runtime.progress import progress

PACKAGES = ("arraygeom", "calib", "pat")
EARLIEST = 0.1
"""Share of a stage that must be done before the remaining time is estimated."""
LEAST = 1.5
"""Remaining seconds below which none are shown."""


class _Shown(logging.Handler):
    def __init__(self, show: Callable[[str], None]) -> None:
        super().__init__(logging.INFO)
        self.show, self.thread = show, get_ident()
        self.stage: str | None = None
        self.begin, self.share = 0.0, 0.0

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.INFO and record.thread == self.thread:
            self.show(record.getMessage() + self._left())

    def _left(self) -> str:
        """The current stage with its remaining time, if known."""
        if (now := progress()) is None:
            return ""
        stage, share = now
        if stage != self.stage:
            self.stage, self.begin, self.share = stage, time.monotonic(), 0.0
        self.share = max(share, self.share)
        named = f" ({stage})" * bool(stage)
        if self.share < EARLIEST:
            return named
        left = (time.monotonic() - self.begin) * (1 - self.share) / self.share
        return f"{named}, {about(left)}" if left > LEAST else named


def about(seconds: float) -> str:
    """Format a remaining time in seconds as rounded text, such as "about 12 s left"."""
    return f"about {seconds:.0f} s left" if seconds < 100 else f"about {seconds / 60:.0f} min left"


@contextmanager
def steps_shown(show: Callable[[str], None]) -> Iterator[None]:
    """Context manager that calls `show` with a line of text for every step that `PACKAGES` log (at INFO).

    The line ends with the stage and the remaining time where they are known. Steps of other threads are not
    shown, and of nested blocks only the innermost shows.
    """
    loggers = [logging.getLogger(name) for name in PACKAGES]
    before = [(logger.level, logger.handlers[:]) for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.INFO)
        logger.handlers[:] = [*(h for h in logger.handlers if not isinstance(h, _Shown)), _Shown(show)]
    try:
        yield
    finally:
        for logger, (level, handlers) in zip(loggers, before):
            logger.setLevel(level)
            logger.handlers[:] = handlers
