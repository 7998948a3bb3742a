"""Replacement of a lens whose model ends within its image by a fitted one that covers all of it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from arraygeom import Camera, Distortion, Rig
from arraygeom.distortion import BROWN_CONRADY
from arraygeom.lens_coverage import coverage, normalised
from arraygeom.pixels import coarse_grid

SAMPLES, ROUNDS = 160, 30
"""Points across the disc that a lens is fitted to, and rounds of reweighted fits."""
REACH = 1.6
"""Radius of that disc before distortion, as a multiple of the farthest pixel's distance."""


class Refit(NamedTuple):
    """Camera whose lens was replaced by one fitted to it.

    Attributes:
        camera: camera with the new lens.
        largest: largest difference to the old lens, pixels, on a coarse grid where that has rays.
        usual: 95th percentile of the difference, pixels.
    """

    camera: Camera
    largest: float
    usual: float


def refit_lens(camera: Camera) -> Refit:
    """Fit Brown-Conrady's k1 k2 p1 p2 k3, which have no pole, to the formula of one camera's lens.

    Points beyond a pole take part where the formula is smooth again.

    Returns:
        The camera with the new lens, and the differences.

    Raises:
        ValueError: for no lens, another model, a tilted sensor, a batch of K or lenses, or if no such lens
            covers the image.
    """
    lens = camera.distortion
    if not isinstance(lens, Distortion) or lens.model != BROWN_CONRADY or lens.coefficients[12:].any():
        raise ValueError("only lenses of brown-conrady, without a tilted sensor, are fitted anew")
    h, w = camera.hw
    corners = camera.K.new_tensor([[-0.5, -0.5], [w - 0.5, -0.5], [-0.5, h - 0.5], [w - 0.5, h - 0.5]])
    farthest = normalised(camera, corners).norm(dim=-1).max()
    xy = coarse_grid((SAMPLES, SAMPLES), 1).to(camera.K) * (2 * REACH / (SAMPLES - 1)) - REACH
    xy = xy.reshape(-1, 2)
    xy = xy[xy.norm(dim=-1) <= REACH] * farthest
    moved, A = _formula(lens.coefficients, xy), _terms(xy)
    inside = moved.norm(dim=-1) <= farthest * 1.05
    c, weights = camera.K.new_zeros(5), inside.to(xy)
    pixel = 1 / camera.K[:2, :2].det().abs().sqrt()
    for _ in range(ROUNDS):
        rows = (A * weights[:, None, None]).reshape(-1, 5)
        c = torch.linalg.lstsq(rows, ((moved - xy) * weights[:, None]).reshape(-1, 1)).solution[:, 0]
        off = (A @ c + xy - moved).norm(dim=-1)
        weights = inside / (1 + (off / (2 * pixel)).square())
    fitted = camera.replace(distortion=Distortion(BROWN_CONRADY, c))
    if (share := coverage(fitted).share) < 1:
        raise ValueError(f"no lens without a pole covers the image: the best one does {100 * share:.0f} %")
    pixels = coarse_grid(camera.hw, max(4, max(h, w) // 256)).to(camera.K).reshape(-1, 2)
    rays, valid = camera.rays(pixels)
    again = fitted.project_local(rays[valid])
    off = (again.x - pixels[valid]).norm(dim=-1)
    return Refit(fitted, float(off.max()), float(off.quantile(0.95)))


def refit_rig(rig: Rig) -> tuple[Rig, list[str]]:
    """Refit the lenses of a rig's calibrated cameras that end within their images (`coverage`).

    Returns:
        The rig, and a sentence on each refitted lens; none if all cover their images.

    Raises:
        ValueError: as `coverage`, and as `refit_lens` for the first that cannot be refitted.
    """
    cameras, said = dict(rig.cameras), []
    for name, camera in rig.cameras.items():
        if isinstance(camera, Camera) and (before := coverage(camera)).share < 1:
            cameras[name], largest, usual = refit_lens(camera)
            said.append(
                f"{name}: lens fitted anew, covers 100 % of its image ({100 * before.share:.0f} % before); "
                f"95 % of those pixels move by less than {usual:.2g} px, none by more than {largest:.2g}"
            )
    return rig.replace(cameras=cameras), said


def _terms(xy: Tensor) -> Tensor:
    """Displacement of points by a unit of each of k1 k2 p1 p2 k3, (n, 2, 5), in which it is linear."""
    x, y = xy.unbind(-1)
    u = xy.square().sum(-1)
    p1, p2 = torch.stack([2 * x * y, u + 2 * y * y], -1), torch.stack([u + 2 * x * x, 2 * x * y], -1)
    k1, k2, k3 = (xy * u[:, None] ** power for power in (1, 2, 3))
    return torch.stack([k1, k2, p1, p2, k3], -1)


def _formula(c: Tensor, xy: Tensor) -> Tensor:
    """Distorted points by OpenCV's formula of the first twelve coefficients, poles included."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = torch.nn.functional.pad(c, (0, 14 - len(c)))[:12]
    u = xy.square().sum(-1, keepdim=True)
    radial = (1 + u * (k1 + u * (k2 + u * k3))) / (1 + u * (k4 + u * (k5 + u * k6)))
    prism = torch.cat([s1 * u + s2 * u * u, s3 * u + s4 * u * u], -1)
    tangential = _terms(xy)[..., 2:4] @ torch.stack([p1, p2])
    return xy * radial + tangential + prism
