"""Rigs and ordinary images: diagnosis, refinement and uncalibrated rigs, by points matched between cameras.

`matches` and `patch_matching` match points; `residuals` measures them; `hypotheses`, `evidence` and `doctor`
find the usual mistakes; `parameters`, `least_squares`, `depth_change`, `lenses` and
`refinement` improve a rig; `from_images` makes a rig from images alone; `rig_check` tests whether a rig fits
images at all.
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
