"""Calibration from images of a board: from its specification to a rig with covariance and report.

`target` (boards) -> `photos`, `detect`, `corners`, `collect` (detections) -> `intrinsics` (one camera) -> `poses`
(initial rig) -> `bundle`, `observability` (adjustment) -> `rig` (calibration) -> `coverage`, `covariance`, `report`.
`run` does all of it from files to files, `simulation` renders the images that a planned rig would take.
"""

from importlib import import_module
from typing import Any

__all__ = ["calibrate", "calibrate_photos", "collect_folder", "parse_board", "simulate_photos", "write_board"]

_MODULES = {
    "calibrate": "rig",
    "calibrate_photos": "run",
    "collect_folder": "collect",
    "parse_board": "target",
    "simulate_photos": "simulation",
    "write_board": "run",
}


def __getattr__(name: str) -> Any:
    """The public functions, imported when first used: OpenCV and matplotlib are slow to load."""
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
