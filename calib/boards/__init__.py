"""Calibration from images of a board: from its specification to a rig with covariance and report.

`board`, `target` (boards, from text and to print) -> `photos`, `corners`, `detect` (detections) -> `parameters`,
`deformation`, `bundle`, `solve` (adjustment) -> `intrinsics` (one camera) -> `poses` (initial rig) -> `rig`
(calibration) -> `validation`, `uncertainty`, `adequacy`, `figures`, `report`. `run` does all of it from files to files,
`watch` guides while images are taken, `simulation` renders the images that a planned rig would take.
"""

from .. import _lazy

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
