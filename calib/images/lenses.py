"""Lenses of cameras that nobody has calibrated: what F alone cannot fit where they bend lines.

Such a lens has OpenCV's first four terms about the image's middle, r counting in halves of the image's longer side;
F relates what is straight. `refine` fits both together to matched points (Fitzgibbon 2001 has one radial term, as a
quotient).
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from arraygeom import Camera, Distortion, LensView, Rig, View, apply_homography, fit_homography, intrinsics
from arraygeom.pixels import coarse_grid

TERMS = 4


def with_lenses(rig: Rig, names: Iterable[str]) -> Rig:
    """The rig with a lens, which does not bend yet, for those of the views that are linked and have none."""
    linked = {name for pair in rig.links for name in pair}
    for name in names:
        view = rig[name]
        if name in linked and not isinstance(view, LensView):
            rig = rig.with_camera(name, _flat(view))
    return rig


def _flat(view: View) -> LensView:
    lens = Distortion("brown-conrady", torch.zeros(TERMS, dtype=torch.float64))
    K = intrinsics(max(view.hw) / 2, view.hw)
    return LensView(hw=view.hw, sensor=view.sensor, K=K, distortion=lens)


def uncalibrated_lenses(rig: Rig) -> dict[str, LensView]:
    """The views that are not calibrated and have a lens all the same."""
    views = {name: view for name, view in rig.cameras.items() if isinstance(view, LensView)}
    return {name: v for name, v in views.items() if v.distortion is not None and not isinstance(v, Camera)}


def spoken_lenses(rig: Rig) -> str:
    """A sentence on the lenses of views that are not calibrated; empty if there are none."""
    lenses = uncalibrated_lenses(rig)
    distorted = ", ".join(f"{name} by up to {float(bending(view)):.1f} px" for name, view in lenses.items())
    return f"lenses bend lines; without them F does not fit: {distorted}" if lenses else ""


def bending(view: LensView) -> Float[Tensor, ""]:
    """By how much the lens bends at most: pixels, beyond what the homography does that is nearest to it."""
    x = coarse_grid(view.hw).reshape(-1, 2)
    straight, valid = view.to(torch.float64).undistort(x)
    x, straight = x[valid], straight[valid]
    return (apply_homography(fit_homography(x, straight), x).x - straight).norm(dim=-1).max()
