"""Explorer of receptive fields: point at a pixel of alpha, see its segment, samples and match in every beta,
move the rig.

`explore(rig, images)` is a widget for a cell of a notebook (extra `explore`), `pat explore rig.yaml --image
...` the same in a page; neither needs a network connection. `inspect_pixel` does the computation.
"""

from __future__ import annotations

from typing import Any

from .page import Explorer, opened
from .pixel import FAMILIES, BetaReport, ExplorerScene, ExplorerState, PixelReport, inspect_pixel
from .serving import serve

__all__ = [
    "FAMILIES",
    "BetaReport",
    "Explorer",
    "ExplorerScene",
    "ExplorerState",
    "PixelReport",
    "explore",
    "inspect_pixel",
    "opened",
    "serve",
]


def __getattr__(name: str) -> Any:
    """Load `explore` and its library on first use."""
    if name != "explore":
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    from .widget import explore

    return explore
