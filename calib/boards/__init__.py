"""Calibration from images of a board: from the board's specification to a rig with covariance and report.

Reading order: `board`, `target` (boards, from text and to print), `photos`, `corners`, `detect` (detections),
`deformation`, `bundle` (unknowns and equations), `intrinsics`, `poses` (initial values), `uncertainty`,
`solve` (the fit), `validation` (held-out frames, notes), `rig` (calibration), `adequacy`, `report`. `run`
goes from files to files, or guides while images are taken; `simulation` renders the images of a planned rig;
`rig_diff` compares two calibrations.
"""

from typing import Literal

from .. import _lazy

Lens = Literal[
    "brown-conrady",
    "rational",
    "thin-prism",
    "tilted",
    "kannala-brandt",
    "omni",
    "double-sphere",
    "extended-unified",
    "scaramuzza",
    "thin-prism-fisheye",
    "none",
]
"""Lens models that a camera can be calibrated with."""

__all__ = ["calibrate", "calibrate_photos", "collect_folder", "parse_board", "simulate_photos", "write_board"]

__getattr__ = _lazy(
    __name__,
    {
        "calibrate": "rig",
        "calibrate_photos": "run",
        "collect_folder": "detect",
        "parse_board": "target",
        "simulate_photos": "simulation",
        "write_board": "target",
    },
)


def __dir__() -> list[str]:
    return __all__
