"""Cameras of any model, fused as they recorded."""

import math
import warnings

import pytest
import torch

from arraygeom import Camera, Pose, Rig, intrinsics, pixel_grid, rotation_from_vector
from arraygeom.lenses import Equirectangular, FlatPort, Orthographic, PolynomialFisheye, RollingShutter
from pat import fuse, load_weights
from pat.evaluation.metrics import score
from tests.arraygeom.rigs import number
from tests.pat.any_camera import hit, recorded

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
    model, focal = MODELS[name]
    R = rotation_from_vector(number(0.0, 0.12 if name == "orthographic" else -0.01, 0.0))
    t = (
        number(0.0, 0.0, 2.5) - R @ number(0.0, 0.0, 2.5)
        if name == "orthographic"
        else number(-0.25, 0.01, 0.0)
    )
    poses = Pose.identity(), Pose(R, t)
    cameras = [Camera(K=intrinsics(focal, HW), cam_from_world=p, hw=HW, distortion=model) for p in poses]
    wide = name in ("fisheye", "equirectangular")
    rig = Rig(dict(zip(("alpha", "beta"), cameras)), depth=(1.3, 5.3 if wide else 3.2))
    images, truth = recorded(rig)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frame = fuse(load_weights("mono-colour"), rig, images, alpha="alpha")
    alone, fused = (
        score(i.clamp(0, 1), truth).psnr for i in (images["alpha"].expand(3, -1, -1), frame.image)
    )
    assert fused > alone + 4
    X, distance = hit(cameras[0], pixel_grid(HW, dtype=torch.float64))
    wanted = distance if wide else X[..., 2]
    assert float(((frame.depth - wanted) / wanted).abs().nanmedian()) < 0.1
