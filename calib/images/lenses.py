"""Lenses of uncalibrated cameras, which distort epipolar lines so that F alone does not fit.

Such a lens has OpenCV's first four terms about the image's centre, with r in units of half the longer side of
the image; F relates undistorted pixels. `refinement` fits both together to matched points (Fitzgibbon 2001
has one radial term, as a quotient).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, Distortion, LensView, Rig, apply_homography, fit_homography, intrinsics
from arraygeom.pixels import coarse_grid

TERMS = 4


def with_lenses(rig: Rig) -> Rig:
    """Return the rig in which linked views without K (plain `View`s) have a lens without distortion.

    They become `LensView`s with a `brown-conrady` of zeros, a focal length of half the longer side and the
    centre in the middle; the same rig if there are none.
    """
    for name in dict.fromkeys(name for pair in rig.links for name in pair):
        if not isinstance(view := rig[name], LensView):
            K = intrinsics(max(view.hw) / 2, view.hw)
            lens = LensView(hw=view.hw, sensor=view.sensor, K=K, distortion=_no_distortion())
            rig = rig.with_camera(name, lens)
    return rig


def _no_distortion() -> Distortion:
    return Distortion("brown-conrady", torch.zeros(TERMS, dtype=torch.float64))


def with_lens_of(camera: Camera, view: LensView) -> Camera:
    """Return a pinhole camera with the lens of a view of the same centre, its terms converted to the camera's
    unit."""
    assert isinstance(view.distortion, Distortion)
    factor = float(camera.K[0, 0] / view.K[0, 0])
    powers = factor ** view.distortion.coefficients.new_tensor([2, 4, 1, 1])
    lens = Distortion(view.distortion.model, view.distortion.coefficients * powers)
    return camera.replace(distortion=lens)


def describe_lenses(rig: Rig) -> str:
    """Return a sentence on the lenses of uncalibrated views; empty if there are none."""
    distorted = [
        f"{name} by up to {float(largest_distortion(view)):.1f} px"
        for name, view in rig.cameras.items()
        if isinstance(view, LensView) and view.distortion is not None and not isinstance(view, Camera)
    ]
    return f"F does not fit without lens distortion: {', '.join(distorted)}" if distorted else ""


def largest_distortion(view: LensView) -> Float[Tensor, ""]:
    """Compute the largest distortion of a lens beyond that of the nearest homography, pixels (float64)."""
    x = coarse_grid(view.hw).reshape(-1, 2)
    undistorted, valid = view.to(torch.float64).undistort(x)
    x, undistorted = x[valid], undistorted[valid]
    return (apply_homography(fit_homography(x, undistorted), x).x - undistorted).norm(dim=-1).max()
