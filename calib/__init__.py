"""Calibration of camera rigs.

`calib.boards` calibrates a rig from images of a calibration board; `calib.images` finds mistakes in a rig, refines it,
or makes an uncalibrated one, from ordinary images. `calib.images` may use `calib.boards`, not the reverse.
"""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from arraygeom.moved import OldModules, moved_name

_BOARDS = ["bundle", "collect", "corners", "covariance", "coverage", "detect", "intrinsics", "observability"]
_BOARDS += ["photos", "poses", "report", "run"]
_MOVED = {f"calib.{name}": f"calib.boards.{name}" for name in _BOARDS}
_MOVED |= {
    f"calib.{name}": f"calib.images.{name}" for name in ("doctor", "lenses", "matches", "photometric", "residuals")
}
_MOVED |= {
    "calib.calibrate": "calib.boards.rig",
    "calib.rehearsal": "calib.boards.simulation",
    "calib.mistakes": "calib.images.remedies",
    "calib.patches": "calib.images.patch_matching",
    "calib.refine": "calib.images.refinement",
    "calib.start": "calib.images.from_images",
    "calib.unknowns": "calib.images.parameters",
}
sys.meta_path.insert(0, OldModules(_MOVED, {"calib.start.start": "calib.images.from_images.rig_from_images"}))


def _lazy(package: str, modules: Mapping[str, str], old: Mapping[str, str] | None = None) -> Callable[[str], Any]:
    """A package's `__getattr__` that imports functions from modules on first use: OpenCV and matplotlib load slowly.

    `old`: addresses of names that it had before, for one release.
    """

    def get(name: str) -> Any:
        if name not in modules:
            return moved_name(package, name, (old or {}).get(name))
        return getattr(import_module(f"{package}.{modules[name]}"), name)

    return get
