"""Rigs and ordinary images: diagnosis, refinement, and uncalibrated rigs, by points matched between cameras.

`matches`, `patch_matching` (matched points) -> `residuals` -> `remedies`, `doctor` (the usual mistakes) and
`parameters`, `lenses`, `photometric`, `refinement` (a better rig) -> `from_images` (a rig from images alone).
"""

from importlib import import_module
from typing import Any

__all__ = ["diagnose", "match_cameras", "refine", "rig_from_images"]

_MODULES = {
    "diagnose": "doctor",
    "match_cameras": "matches",
    "refine": "refinement",
    "rig_from_images": "from_images",
}


def __getattr__(name: str) -> Any:
    """The public functions, imported when first used: OpenCV is slow to load."""
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
