"""Cameras of any model, fused as they recorded."""

import math

import pytest

from arraygeom.lenses import Equirectangular, FlatPort, Orthographic, PolynomialFisheye, RollingShutter
from tests.arraygeom.rigs import number
from tests.pat.any_camera import fused_in_the_room, rig_of_two

HW = (160, 208)
PORT = {"distance": 0.05, "thickness": 0.01, "glass": 1.52, "water": 1.333}
MOTION = {"velocity": number(0.5, 0.1, 0.2), "rotation": number(0.1, 0.3, 0.2), "readout": number(0.05)}
MODELS = {
    "fisheye": (PolynomialFisheye(number(0.02, -0.03, 0.005), number(1.9)), 60.0),
    "equirectangular": (Equirectangular(), HW[1] / (2 * math.pi)),
    "orthographic": (Orthographic(), 65.0),
    "rolling shutter": (RollingShutter(**MOTION), 180.0),
    "port": (FlatPort(**{n: number(v) for n, v in PORT.items()}), 180.0),
}
SLOW = [
    pytest.param(n, marks=pytest.mark.slow) for n in ("fisheye", "equirectangular", "rolling shutter", "port")
]


@pytest.mark.parametrize("name", ["orthographic", *SLOW])
def test_a_camera_of_any_model_is_fused(name):
    wide = name in ("fisheye", "equirectangular")
    rig = rig_of_two(*MODELS[name], HW, around=name == "orthographic", wide=wide)
    found = fused_in_the_room(rig, wide=wide)
    assert found.psnr > found.alone + 4
    assert found.off < 0.1
