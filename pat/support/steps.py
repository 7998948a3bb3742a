"""The steps of long work, shown as they begin.

Modules say them to their loggers, at level INFO: `logging.basicConfig(level=logging.INFO)` shows them in a script.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import get_ident

PACKAGES = ("arraygeom", "calib", "pat")


class _Shown(logging.Handler):
    def __init__(self, show: Callable[[str], None]) -> None:
        super().__init__(logging.INFO)
        self.show, self.thread = show, get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.INFO and record.thread == self.thread:
            self.show(record.getMessage())


@contextmanager
def steps_shown(show: Callable[[str], None]) -> Iterator[None]:
    """A block in which `show` is called with the line of every step that begins in this thread.

    Of the innermost block alone.
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
