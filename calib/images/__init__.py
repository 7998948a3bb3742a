"""Rigs and ordinary images: diagnosis, refinement, and uncalibrated rigs, by points matched between cameras.

`matches`, `patch_matching` (matched points) -> `residuals` -> `hypotheses`, `evidence`, `doctor` (the usual
mistakes) and `parameters`, `least_squares`, `depth_change`, `lenses`, `photometric`, `refinement` (a better
rig) -> `from_images` (a rig from images alone) and `rig_check` (whether a rig fits images at all).
"""

from .. import _lazy

__all__ = ["diagnose", "match_cameras", "misfit_warning", "refine", "rig_from_images"]

__getattr__ = _lazy(
    __name__,
    {
        "diagnose": "doctor",
        "match_cameras": "matches",
        "misfit_warning": "rig_check",
        "refine": "refinement",
        "rig_from_images": "from_images",
    },
)


def __dir__() -> list[str]:
    return __all__
