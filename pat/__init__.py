"""The physics-aware transformer: one image from an array of unlike cameras.

The front door: `fuse`, its settings `FuseSettings` and its result `Frame`; `align` and its result `Aligned`;
`load_weights` and `read_image`. These names are promised; modules and what is in them may change.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .app.front import align, fuse
    from .fusion.align import Aligned
    from .fusion.frame import Frame
    from .fusion.fuse import FuseSettings
    from .media.images import read_image
    from .networks.weights import load_weights

__all__ = ["Aligned", "Frame", "FuseSettings", "align", "fuse", "load_weights", "read_image"]

_MODULES = {
    "Aligned": "pat.fusion.align",
    "Frame": "pat.fusion.frame",
    "FuseSettings": "pat.fusion.fuse",
    "align": "pat.app.front",
    "fuse": "pat.app.front",
    "load_weights": "pat.networks.weights",
    "read_image": "pat.media.images",
}


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """The front door; nothing is imported before it is used."""
        if name not in _MODULES:
            raise AttributeError(f"module 'pat' has no attribute '{name}'")
        return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
