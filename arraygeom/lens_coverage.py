"""Coverage of an image by its lens model."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from .camera import LensView
from .distortion import Distortion
from .pixels import coarse_grid, map_homogeneous

T = TypeVar("T")
V = TypeVar("V", bound=LensView)


class LensCoverage(NamedTuple):
    """Coverage of an image by its lens model.

    Attributes:
        share: share of the pixels of a coarse grid with a ray that projects back, 0..1; 1 for a pinhole.
        degrees: largest angle off axis of these rays; NaN for a pinhole, or without any ray.
    """

    share: float
    degrees: float


class LensKey:
    """Hashable key of a camera: equal for equal image size, K (and its dtype) and lens, whatever its pose.

    A `Distortion` counts by its numbers, another lens by identity.
    """

    def __init__(self, camera: Any) -> None:
        self.camera, lens = camera, camera.distortion
        numbers = lens.coefficients.tolist() if isinstance(lens, Distortion) else id(lens)
        self.key = str((camera.hw, camera.K.dtype, camera.K.tolist(), getattr(lens, "model", None), numbers))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, LensKey) and self.key == other.key


def once_a_lens(function: Callable[[V], T]) -> Callable[[V], T]:
    """Keep the last 256 results of a function of a camera's size, K and lens alone."""
    known: Callable[[LensKey], T] = lru_cache(maxsize=256)(lambda lens: function(lens.camera))
    return wraps(function)(lambda camera: known(LensKey(camera)))


@once_a_lens
def coverage(camera: LensView) -> LensCoverage:
    """Measure the share of one camera's pixels with a ray, and their widest angle, on a coarse grid.

    Raises:
        ValueError: for a batch of lenses or, with a lens, of K.
    """
    with torch.no_grad():
        grid = coarse_grid(camera.hw, max(8, max(camera.hw) // 128)).to(camera.K)
        if camera.distortion is None:
            return LensCoverage(1.0, float("nan"))
        points = normalised(camera, grid)
        rays, valid = camera.distortion.unproject(points)
        valid = valid & camera.distortion.project(camera.distortion.origins(points) + rays)[1]
        angles = torch.rad2deg(torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2]))[valid]
        return LensCoverage(
            float(valid.double().mean()), float(angles.max()) if len(angles) else float("nan")
        )


def normalised(camera: LensView, x: Tensor) -> Tensor:
    """Compute the normalised points (*n, 2), before K, of one camera's pixels (*n, 2), its lens left in.

    Raises:
        ValueError: for a batch of K or lenses.
    """
    if camera.K.ndim > 2 or (camera.distortion is not None and camera.distortion.batch_shape):
        raise ValueError(f"a batch of cameras {tuple(camera.batch_shape)}: give one of them, as camera[0]")
    return map_homogeneous(torch.linalg.inv(camera.K)[..., :2, :], x)
