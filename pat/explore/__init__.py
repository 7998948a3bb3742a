"""The explorer: click a pixel of alpha and see its segment, samples and match in every beta, and vary the rig.

`explore(rig, images)` is a widget for a cell of a notebook that needs neither a server nor a network; `explorer(rig,
images)` and `pat explore rig.yaml --image ...` make the page with all controls. All need the extra `explore`;
`inspect_pixel` does the computation and needs no extra.
"""

from __future__ import annotations

from typing import Any

from .pixel import FAMILIES, BetaReport, ExplorerScene, ExplorerState, PixelReport, inspect_pixel

__all__ = [
    "FAMILIES",
    "BetaReport",
    "ExplorerScene",
    "ExplorerState",
    "PixelReport",
    "explore",
    "explorer",
    "inspect_pixel",
    "serve",
]


def __getattr__(name: str) -> Any:
    """`explore`, `explorer` and `serve`, which load their libraries on first use."""
    if name == "explore":
        from .widget import explore

        return explore
    if name not in ("explorer", "serve"):
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    try:
        from . import page, serving
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"the explorer needs {error.name}: pip install 'arraygeom-pat[explore]'") from error
    return getattr(serving if name == "serve" else page, name)
