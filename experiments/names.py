"""Names that are chosen among those that there are."""

from __future__ import annotations

from collections.abc import Iterable


def refuse_unknown(what: str, names: Iterable[str], available: Iterable[str]) -> None:
    """Raises ValueError for the first name that is not known; `what` is said before it: "no scene"."""
    available = list(available)
    for name in names:
        if name not in available:
            raise ValueError(f"{what} '{name}': there are {', '.join(available)}")
