"""The explorer: click a pixel of alpha and see where every beta looks, what it finds, and what moves.

`explorer(rig, images)` is for a cell of a notebook, `pat explore rig.yaml --image ...` for a page of its own. Both need
the extra `explore`; `look_at` works it all out and needs none.
"""

from __future__ import annotations

from typing import Any

from .seen import FAMILIES, Scene, Seen, SeenInBeta, State, look_at

__all__ = ["FAMILIES", "Scene", "Seen", "SeenInBeta", "State", "explorer", "look_at", "serve"]


def __getattr__(name: str) -> Any:
    """`explorer` and `serve`, which load the page's libraries when first asked for."""
    if name not in ("explorer", "serve"):
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    try:
        from . import page
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"the explorer needs {error.name}: pip install 'arraygeom-pat[explore]'") from error
    return getattr(page, name)
