"""Calibration from images of a board: from its specification to a rig with covariance and report.

`board`, `known_points`, `target`, `printing` (boards) -> `photos`, `detect`, `corners`, `collect` (detections) ->
`intrinsics` (one camera) -> `poses`, `start` (initial rig) -> `camera_parameters`, `bundle`, `jackknife`,
`observability`, `shape` (adjustment) -> `rig` (calibration) -> `validation`, `lens_comparison`, `coverage`,
`covariance`, `adequacy`, `report`. `run` does all of it from files to files, `watch` guides while images are taken,
`simulation` renders the images that a planned rig would take.
"""

from .. import _lazy

__all__ = ["calibrate", "calibrate_photos", "collect_folder", "parse_board", "simulate_photos", "write_board"]

__getattr__ = _lazy(
    __name__,
    {
        "calibrate": "rig",
        "calibrate_photos": "run",
        "collect_folder": "collect",
        "parse_board": "target",
        "simulate_photos": "simulation",
        "write_board": "run",
    },
)
