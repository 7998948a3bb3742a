"""The physics-aware transformer: one image from an array of unlike cameras.

The front door: `fuse`, its result `Frame`, `align`, its result `Aligned`, `load_weights` and `read_image`.
Nothing is imported before it is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .fusion.align import Aligned, align
    from .fusion.fuse import fuse
    from .fusion.results import Frame
    from .media.images import read_image
    from .networks.weights import load_weights

__all__ = ["Aligned", "Frame", "align", "fuse", "load_weights", "read_image"]

_MODULES = {
    "Aligned": "pat.fusion.align",
    "align": "pat.fusion.align",
    "Frame": "pat.fusion.results",
    "fuse": "pat.fusion.fuse",
    "load_weights": "pat.networks.weights",
    "read_image": "pat.media.images",
}


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """The front door, and modules that were imported as `pat.name`."""
        if name not in _MODULES:
            raise AttributeError(f"module 'pat' has no attribute '{name}'")
        return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *_MODULES]
