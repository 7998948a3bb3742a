"""Camera models: maps between directions and points of the image plane, one file for each family.

A model of your own is a subclass of `CameraModel`; see "A camera of your own" in docs/rigs.md.
"""

from .angular import Equirectangular, PolynomialFisheye
from .model import CAMERA_MODELS, CameraModel, beside_points
from .not_central import FlatPort, Orthographic, RollingShutter
from .splined import Splined

__all__ = [
    "CAMERA_MODELS",
    "CameraModel",
    "Equirectangular",
    "FlatPort",
    "Orthographic",
    "PolynomialFisheye",
    "RollingShutter",
    "Splined",
    "beside_points",
]
