"""Names that are chosen among those that there are."""

from __future__ import annotations

from collections.abc import Iterable


def refuse_unknown(what: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raises ValueError for the first name that is not known; `what` is said before it: "no scene"."""
    known = list(known)
    for name in names:
        if name not in known:
            raise ValueError(f"{what} '{name}': there are {', '.join(known)}")
