"""The explorer: click a pixel of alpha and see its segment, samples and match in every beta, and vary the rig.

`explorer(rig, images)` is for a cell of a notebook, `pat explore rig.yaml --image ...` for a page of its own. Both need
the extra `explore`; `inspect_pixel` does the computation and needs no extra.
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
    "explorer",
    "inspect_pixel",
    "serve",
]


def __getattr__(name: str) -> Any:
    """`explorer` and `serve`, which load the page's libraries on first use."""
    if name not in ("explorer", "serve"):
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    try:
        from . import page, serving
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"the explorer needs {error.name}: pip install 'arraygeom-pat[explore]'") from error
    return getattr(serving if name == "serve" else page, name)
