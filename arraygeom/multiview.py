"""Relations between views: rays in the world, depth warps, plane sweeps, consistent depth maps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Real
from torch import Tensor

from .camera import Camera, Projected
from .checks import check_plane
from .epipolar import beside
from .pair import Pair
from .pixels import floating, pixel_grid
from .pose import Pose
from .rig import Rig
from .sampling import Interpolation, Sampled, sample


class WorldRays(NamedTuple):
    """Rays of pixels in the world.

    Attributes:
        origin: start, metres in the world.
        direction: unit direction in the world; zero where not valid.
        valid: True for pixels that have a ray, as `Camera.rays` says.
    """

    origin: Float[Tensor, "*n 3"]
    direction: Float[Tensor, "*n 3"]
    valid: Bool[Tensor, "*n"]

    @property
    def plucker(self) -> Float[Tensor, "*n 6"]:
        """Pluecker coordinates (direction, origin x direction): the same for every point of the ray."""
        return torch.cat([self.direction, torch.linalg.cross(self.origin, self.direction)], -1)


def world_rays(camera: Camera, x: Real[Tensor, "*n 2"] | None = None) -> WorldRays:
    """Compute the rays of pixels in the world, through any lens.

    >>> pose = Pose(torch.eye(3), torch.tensor([0.0, -1, 0]))
    >>> camera = Camera(K=torch.eye(3), cam_from_world=pose, hw=(4, 6))
    >>> world_rays(camera, torch.tensor([0.0, 0.0])).plucker.tolist()
    [0.0, 0.0, 1.0, 1.0, 0.0, -0.0]

    Args:
        x: pixels; None for all of the image, (*b, H, W).

    Raises:
        ValueError: for pixels without the axes of a batch of cameras.
    """
    batch = camera.batch_shape
    if x is None:
        x = pixel_grid(camera.hw, dtype=camera.K.dtype, device=camera.K.device)
        x = x.expand(*batch, *x.shape)
    local, valid = camera.rays(x)
    back = Pose(camera.R.mT, torch.zeros_like(camera.t))
    direction = back.apply(torch.where(valid[..., None], local / local.norm(dim=-1, keepdim=True), 0.0))
    origin = beside(camera.centre, direction.ndim, 1).expand_as(direction)
    if not camera.central:
        origin = camera.cam_from_world.inverse().apply(camera.ray_origins(x))
    return WorldRays(origin.to(direction), direction, valid)


def warp(
    pair: Pair,
    image: Float[Tensor, "b c h w"],
    depth: Float[Tensor, "b *d ha wa"],
    *,
    interpolation: Interpolation = "bilinear",
) -> Sampled:
    """Warp beta's image to alpha, given the depth (metres) of alpha's pixels; through any lenses.

    A batch of pairs (B) takes images and depths of B, or of 1 for the same in each. Occlusion is not
    detected.

    Returns:
        Values (B, C, *d, Ha, Wa), 0 where not valid, and validity (B, *d, Ha, Wa): depth is finite and
        positive, alpha has a ray less than 90 degrees off axis, and beta's lens and image show the point.
        Differentiable in image, depth and cameras.

    Raises:
        ValueError: for an image or depth of another size than its camera's, and as `Pair.beta_from_alpha` and
            `sample` raise it. Batches of unequal length, neither of 1, give ValueError or RuntimeError.
        NotImplementedError: as `sample`.
    """
    for what, plane, view in (("image", image, pair.beta), ("depth", depth, pair.alpha)):
        check_plane(f"the {what} given", plane, view.hw)
    projected = _in_beta(pair, depth)
    batch = max(len(image), len(projected.x))
    values, inside = sample(image.expand(batch, *image.shape[1:]), projected.x, interpolation=interpolation)
    valid = inside & projected.valid
    return Sampled(torch.where(valid[:, None], values, 0.0), valid)


def plane_sweep(pair: Pair, image: Float[Tensor, "b c h w"], depths: Float[Tensor, " d"]) -> Sampled:
    """Warp beta's image to alpha by the planes z = depth in alpha's frame.

    For any cameras, through lenses too, where planes are no homographies.

    Args:
        depths: metres, one or more; planes that are not at a finite, positive depth give nothing valid.

    Returns:
        Values (B, C, D, Ha, Wa) and validity (B, D, Ha, Wa), as of `warp`.

    Raises:
        RuntimeError: for no depths; the errors of `warp` pass.
    """
    planes = depths[:, None, None, None].expand(-1, len(image), *pair.alpha.hw)
    swept = [warp(pair, image, plane) for plane in planes]
    return Sampled(torch.stack([s.values for s in swept], 2), torch.stack([s.valid for s in swept], 1))


def _in_beta(pair: Pair, depth: Tensor, x: Tensor | None = None) -> Projected:
    """Projection into beta of alpha's pixels (all, or x (*n, 2)) at depths (*b, *d, *n)."""
    alpha, beta = pair.cameras
    depth = floating(depth)
    x = pixel_grid(alpha.hw, dtype=depth.dtype, device=depth.device) if x is None else x
    x = x.reshape(*[1] * (depth.ndim + 1 - x.ndim), *x.shape)
    rays, valid = alpha.rays(x)
    ahead = rays[..., 2] > 0
    rays = rays / torch.where(ahead, rays[..., 2], 1.0)[..., None]
    has_depth = depth.isfinite() & (depth > 0) & valid & ahead
    X = rays * torch.where(has_depth, depth, 1.0)[..., None]
    if not alpha.central:
        start = alpha.ray_origins(x)
        X = X + start - rays * start[..., 2:]
    projected = beta.project_local(pair.beta_from_alpha.apply(X))
    return projected._replace(valid=projected.valid & has_depth & beta.contains(projected.x))


class ConsistentDepth(NamedTuple):
    """Depth map confirmed by other views.

    Attributes:
        depth: mean of alpha's depth and the agreeing views' in alpha's frame, metres; 0 where not valid.
        views: number of agreeing other views.
        valid: True where alpha has a depth and enough views agree.
    """

    depth: Float[Tensor, "h w"]
    views: Int[Tensor, "h w"]
    valid: Bool[Tensor, "h w"]


def consistent_depth(
    rig: Rig,
    depths: Mapping[str, Float[Tensor, "h w"]],
    alpha: str,
    *,
    views: int = 1,
    pixels: float = 1.0,
    relative: float = 0.01,
) -> ConsistentDepth:
    """Combine alpha's depth map with other cameras' where these agree with it, through any lenses.

    A view agrees if alpha's point, at the depth of the view's own map there, returns to within `pixels` of
    its place in alpha and `relative` of its depth (Yao et al. 2018, MVSNet). Differentiable in all numbers.

    Args:
        depths: depth maps in metres, by camera; values that are not finite and positive are unknown.
        views: least number of agreeing other views; 0 for none: all of alpha's known depths are valid.
        pixels: largest distance in alpha, pixels.
        relative: largest difference of depth, as a share of alpha's.

    Raises:
        ValueError: if alpha has no map, the rig lacks a camera, a map has another size than its camera, one
            of two cameras is not calibrated, or for a batch of rigs.
    """
    if rig.batch_shape:
        raise ValueError(f"a batch of rigs {tuple(rig.batch_shape)}: give one of them, as rig[0]")
    if rig.require(alpha) not in depths:
        raise ValueError(f"there is no depth map of '{alpha}', only of {', '.join(depths)}")
    for name, depth in depths.items():
        check_plane(f"the depth map of '{name}'", depth, rig[name].hw)
    alpha_depth = floating(depths[alpha])
    x = pixel_grid(rig[alpha].hw, dtype=alpha_depth.dtype, device=alpha_depth.device)
    total, count = alpha_depth, torch.ones_like(alpha_depth)
    for name, other in depths.items():
        if name == alpha:
            continue
        there = _in_beta(rig.pair(alpha, name), alpha_depth)
        filled = torch.where(other.isfinite(), other, 0.0)
        sampled, inside = sample(filled[None, None].to(alpha_depth), there.x[None])
        back = _in_beta(rig.pair(name, alpha), sampled[0, 0], there.x)
        agrees = there.valid & inside[0] & back.valid
        agrees = (
            agrees
            & ((back.x - x).square().sum(-1) < pixels**2)
            & ((back.depth - alpha_depth).abs() < relative * alpha_depth)
        )
        total, count = total + torch.where(agrees, back.depth, 0.0), count + agrees
    valid = (count > views) & alpha_depth.isfinite() & (alpha_depth > 0)
    return ConsistentDepth(torch.where(valid, total / count, 0.0), (count - 1).long(), valid)
