"""Summary of a rig in numbers: fields of view, baselines, segment lengths, depth resolution."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from .camera import Camera, LensView
from .distortion import Distortion
from .fields import Curved, Epipolar, sampling_locations
from .lens_coverage import coverage, once_a_lens
from .pair import Pair
from .pixels import coarse_grid, pixel_grid
from .rig import Rig
from .runtime.text import angle
from .segments import Segments


class CameraSummary(NamedTuple):
    """Summary of one camera; None where calibration or a depth range is missing.

    Attributes:
        name: name of the camera.
        wh: image size (width, height).
        field_of_view: angles (across, down), degrees; NaN as `field_of_view` says.
        focal: focal lengths (x, y), pixels.
        footprint: width that a pixel in the middle covers at the near and the far bound, thousandths of the
            rig's unit (millimetres); infinite at infinity, unless rays are parallel.
        lens: name of the lens model; None for a pinhole, and a view without one.
        coefficients: coefficients of a `Distortion`; empty for other models, and without a lens.
        covered: share of the image whose pixels have a ray, on a coarse grid; 1 without a lens.
    """

    name: str
    wh: tuple[int, int]
    field_of_view: tuple[float, float] | None
    focal: tuple[float, float] | None
    footprint: tuple[float, float] | None
    lens: str | None
    coefficients: tuple[float, ...]
    covered: float


class PairSummary(NamedTuple):
    """Summary of alpha and one beta.

    Attributes:
        alpha: name of alpha.
        beta: name of beta.
        baseline: distance of the optical centres, in the rig's unit.
        rotation: angle between the orientations, degrees.
        seen: share of alpha's pixels, of some evenly spread, with a segment in beta; None without a depth
            range.
        length: (median, largest) length of these segments, pixels of beta; None without any.
        depth_step: change of depth at (near, far) that moves a point by one pixel of beta, in the rig's unit:
            the median of alpha's pixels whose point beta sees, NaN if it sees none, infinite for an infinite
            bound; None without depth range or baseline.
    """

    alpha: str
    beta: str
    baseline: float
    rotation: float
    seen: float | None
    length: tuple[float, float] | None
    depth_step: tuple[float, float] | None


NEXT = 1 + 1e-6
"""Factor from a depth to the next, for numerical changes."""
ALONG = 257
"""Points from the middle of an image to an edge, by which its lens's end is found."""
MOST_BETAS = 50
"""Largest number of betas for one alpha."""
MOST_PIXELS = 1 << 18
"""Largest number of alpha's pixels for which segments are computed; a sixteenth of them through lenses."""


def summarise_cameras(rig: Rig, most: int | None = None) -> list[CameraSummary]:
    """Summarise each camera, in the rig's order; the first ones alone if `most` says how many."""
    return [_camera(name, rig) for name in rig.names[:most]]


def summarise_pairs(rig: Rig, alpha: str | None = None) -> list[PairSummary]:
    """Summarise each ordered pair of calibrated cameras, or one alpha with its `MOST_BETAS` nearest betas.

    Args:
        rig: a single rig.
        alpha: name of the one alpha; None for all.

    Returns:
        Summaries; none if alpha is not calibrated.

    Raises:
        ValueError: for an unknown alpha, and as `Pair.beta_from_alpha`.
    """
    cameras = {n: c for n, c in rig.cameras.items() if isinstance(c, Camera)}
    if alpha is None:
        return [_pair(a, b, rig.pair(a, b)) for a in cameras for b in cameras if a != b]
    if rig.require(alpha) not in cameras:
        return []
    centres = {n: c.centre.detach() for n, c in cameras.items()}
    nearest = sorted(centres.keys() - {alpha}, key=lambda n: (float((centres[n] - centres[alpha]).norm()), n))
    return [_pair(alpha, b, rig.pair(alpha, b)) for b in nearest[:MOST_BETAS]]


def _camera(name: str, rig: Rig) -> CameraSummary:
    camera = rig[name]
    h, w = camera.hw
    lens = camera.distortion if isinstance(camera, LensView) else None
    c = tuple(lens.coefficients.tolist()) if isinstance(lens, Distortion) else ()
    covered = coverage(camera).share if isinstance(camera, LensView) else 1.0
    of_lens = (None if lens is None else lens.model, c, covered)
    if not isinstance(camera, Camera):
        return CameraSummary(name, (w, h), None, None, None, *of_lens)
    focal = (float(camera.K[0, :2].norm()), float(camera.K[1, :2].norm()))
    footprint = None
    if rig.depth is not None:
        bounds = (1.0, 1.0) if camera.parallel else rig.depth
        near, far = (float(1000 * d / math.sqrt(focal[0] * focal[1])) for d in bounds)
        footprint = near, far
    return CameraSummary(name, (w, h), field_of_view(camera), focal, footprint, *of_lens)


@once_a_lens
def field_of_view(camera: Camera) -> tuple[float, float]:
    """Compute the angles of view of one camera: from the middle's ray to opposite edges' middles, added up.

    Returns:
        Angles (across, down) in degrees, through the lens; of an edge outside the lens model's range to where
        that ends, NaN if the middle is outside too.
    """
    h, w = camera.hw
    middle = camera.K.new_tensor([(w - 1) / 2, (h - 1) / 2])
    ends = middle + camera.K.new_tensor([[-w / 2, 0], [w / 2, 0], [0, -h / 2], [0, h / 2]])
    parts = torch.linspace(0, 1, ALONG).to(camera.K)[:, None, None]
    rays, valid = camera.rays(middle + parts * (ends - middle))
    halves = torch.where(valid, _angles(rays, rays[:1, :1]), 0.0).amax(0)
    left, right, top, bottom = torch.where(valid[0], halves, torch.nan).tolist()
    return left + right, top + bottom


def _angles(a: Float[Tensor, "*n 3"], b: Float[Tensor, "1 1 3"]) -> Float[Tensor, "*n"]:
    cross = torch.linalg.cross(a, b.expand_as(a)).norm(dim=-1)
    return torch.rad2deg(torch.atan2(cross, (a * b).sum(-1)))


def _pair(alpha: str, beta: str, pair: Pair) -> PairSummary:
    pose = pair.beta_from_alpha
    rotation = math.degrees(float(angle(pose.R)))
    visible_share, length = _segments(pair) if pair.depth is not None else (None, None)
    baseline = float(pose.centre.norm())
    return PairSummary(alpha, beta, baseline, rotation, visible_share, length, _depth_step(pair, baseline))


def _segments(pair: Pair) -> tuple[float, tuple[float, float] | None]:
    """Share of alpha's pixels with a segment, and (median, largest) length, on each fourth or fewer."""
    h, w = pair.alpha.hw
    field, most = (Curved(64), MOST_PIXELS // 16) if pair.has_lens else (Epipolar(), MOST_PIXELS)
    step = max(4, math.ceil(math.sqrt(h * w / most)))
    x = pixel_grid((-(-h // step), -(-w // step))) * step
    locations = sampling_locations(field, pair, x)
    if isinstance(locations, Segments):
        valid, length = locations.valid, locations.length
    else:
        counts = locations.mask[..., 1:] & locations.mask[..., :-1]
        valid = locations.mask.any(-1)
        length = (locations.xy.diff(dim=-2).norm(dim=-1) * counts).sum(-1)
    if not valid.any():
        return 0.0, None
    return float(valid.float().mean()), (float(length[valid].median()), float(length[valid].max()))


def _depth_step(pair: Pair, baseline: float) -> tuple[float, float] | None:
    """Depth step of a pair; None without depth range or baseline."""
    if pair.depth is None or baseline == 0:
        return None
    spacing = max(16, math.ceil(math.sqrt(math.prod(pair.alpha.hw) / MOST_PIXELS)))
    x = coarse_grid(pair.alpha.hw, spacing).reshape(-1, 2)
    alpha, beta = (camera.to(torch.float64) for camera in pair.cameras)

    def at(depth: float) -> float:
        if math.isinf(depth):
            return math.inf
        here, there = (
            beta.project(alpha.unproject(x, torch.full_like(x[..., 0], d))) for d in (depth, depth * NEXT)
        )
        seen = here.valid & there.valid & beta.contains(here.x)
        moved = (there.x - here.x).detach().norm(dim=-1)[seen]
        return float(depth * (NEXT - 1) / moved.median()) if len(moved) else math.nan

    near, far = (at(float(bound)) for bound in pair.depth)
    return near, far
