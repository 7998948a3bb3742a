"""Warnings that point at the caller's line outside this software, however deep their cause is."""

from __future__ import annotations

import sys
import warnings
from types import FrameType

OWN, WRAPPERS = {"arraygeom", "calib", "pat"}, {"contextlib", "torch"}
"""Packages whose lines are not the caller's, and packages whose decorators may stand around them."""


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Issue a warning that points to the line outside arraygeom, calib and pat from which they were called.

    It points to the outermost line if there is none.
    """
    roots: list[str] = []
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        roots.append(str(frame.f_globals.get("__name__")).partition(".")[0])
        frame = frame.f_back
    entered = max((i for i, root in enumerate(roots) if root in OWN), default=-1)
    callers = (i for i, root in enumerate(roots) if i > entered and root not in WRAPPERS)
    warnings.warn(text, category, stacklevel=next(callers, len(roots) - 1) + 2)
