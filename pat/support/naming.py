"""Names that were mistyped. Nothing of the project is imported: the command line needs this before torch."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def near(name: object, known: Iterable[object]) -> str:
    """The end of a message about an unknown name: the nearest known one, or all of them.

    >>> near("nois", ["noise", "clip"])
    "; did you mean 'noise'?"
    """
    names = [str(k) for k in known]
    close = difflib.get_close_matches(str(name), names, 1)
    return f"; did you mean '{close[0]}'?" if close else f"; known here: {', '.join(names)}"
