"""Random rigs for training: baselines, focal lengths, rotations and resolutions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom import Camera, Pose, rotation_from_vector
from arraygeom.pixels import HW

from .rig_distribution import Range, RigDistribution

T = TypeVar("T")


@dataclass(frozen=True)
class RigBatch:
    """Batch of rigs.

    Attributes:
        cameras: cameras, alpha first, each batched (b).
        near: near bound of scenes from alpha, metres.
        far: far bound of scenes from alpha, metres.
    """

    cameras: list[Camera]
    near: Float[Tensor, " b"]
    far: Float[Tensor, " b"]


def in_frame_of(alpha: Camera, camera: Camera) -> Camera:
    """Return the camera with alpha's frame as the world."""
    return camera.replace(cam_from_world=camera.cam_from_world @ alpha.cam_from_world.inverse())


def random_rigs(rigs: RigDistribution, batch: int, hw: HW, generator: Generator) -> RigBatch:
    """Draw a batch of rigs of pinholes; alpha's frame is the world.

    Args:
        rigs: distribution to draw from.
        batch: number of rigs.
        hw: (height, width) of alpha's images.
        generator: random generator on the CPU.

    Returns:
        The rigs, float64 on the CPU.
    """
    near = log_uniform(rigs.near, (batch,), generator)
    far = near * log_uniform(rigs.depth_ratio, (batch,), generator)
    alpha = _alpha(rigs, batch, hw, generator)
    beta = _rectified_beta if rigs.mode == "rectified" else _general_beta
    return RigBatch([alpha] + [beta(rigs, alpha, near, far, generator) for _ in range(rigs.betas)], near, far)


def _alpha(rigs: RigDistribution, batch: int, hw: HW, g: Generator) -> Camera:
    h, w = hw
    width = w * log_uniform(rigs.frame, (batch,), g)
    height = torch.clamp(0.7 * width, min=h)
    corner = uniform((0, 1), (batch, 2), g) * (torch.stack([width, height], -1) - torch.tensor([w, h]))
    K = torch.eye(3, dtype=torch.float64).repeat(batch, 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = width * log_uniform(rigs.focal, (batch,), g)
    K[:, :2, 2] = torch.stack([width, height], -1) / 2 - corner - 0.5
    world = Pose(torch.eye(3).double().expand(batch, 3, 3), torch.zeros(batch, 3).double())
    return Camera(K=K, cam_from_world=world, hw=hw)


def _baseline(rigs: RigDistribution, alpha: Camera, near: Tensor, g: Generator) -> Tensor:
    return log_uniform(rigs.parallax, near.shape, g) * near / alpha.K[:, 0, 0]


def _rectified_beta(rigs: RigDistribution, alpha: Camera, near: Tensor, far: Tensor, g: Generator) -> Camera:
    drawn = torch.randint(2, near.shape, generator=g) * 2 - 1
    side = {"left": torch.ones_like(drawn), "right": -torch.ones_like(drawn), "either": drawn}[rigs.alpha]
    t = torch.zeros_like(alpha.t)
    t[:, 0] = -side * _baseline(rigs, alpha, near, g)
    hw = scaled(alpha.hw, one_of(rigs.resolutions, g))
    return alpha.replace(cam_from_world=Pose(alpha.R, t)).resize(hw)


def _general_beta(rigs: RigDistribution, alpha: Camera, near: Tensor, far: Tensor, g: Generator) -> Camera:
    """Beta placed anywhere around alpha; its principal point centres what alpha sees."""
    batch, resolution = len(near), one_of(rigs.resolutions, g)
    hw = scaled(alpha.hw, resolution)
    centre = _baseline(rigs, alpha, near, g)[:, None] * _direction(batch, g)
    depth = 1 / torch.lerp(1 / far, 1 / near, uniform((0, 1), (batch,), g))
    target = _middle_ray(alpha) * depth[:, None]
    rotation = uniform(rigs.toe_in, (batch, 1), g) * _rotation_towards(target - centre, target)
    wobble = math.radians(rigs.rotation) * torch.randn(batch, 3, generator=g, dtype=torch.float64) / 2
    R = rotation_from_vector(wobble) @ rotation_from_vector(rotation)
    t = -(R @ centre[..., None])[..., 0]
    K = alpha.K.clone()
    K[:, 0, 0] *= resolution * log_uniform(rigs.focal_ratio, (batch,), g)
    K[:, 1, 1] = K[:, 0, 0]
    target_in_beta = (R @ target[..., None])[..., 0] + t
    size = torch.tensor([hw[1], hw[0]], dtype=torch.float64)
    middle = (size - 1) / 2 + uniform((-rigs.decentring, rigs.decentring), (batch, 2), g) * size
    K[:, :2, 2] = middle - K[:, :1, 0] * target_in_beta[:, :2] / target_in_beta[:, 2:]
    return Camera(K=K, cam_from_world=Pose(R, t), hw=hw)


def scaled(hw: HW, s: float) -> HW:
    """Return a (height, width) multiplied by `s`, rounded."""
    return round(hw[0] * s), round(hw[1] * s)


def one_of(items: Sequence[T], generator: Generator) -> T:
    """Draw one of several items, all equally likely."""
    return items[below(len(items), generator)]


def below(count: int, generator: Generator) -> int:
    """Draw a whole number from 0 to `count` - 1."""
    return int(torch.randint(count, (), generator=generator))


def uniform(bounds: Range, shape: tuple[int, ...], generator: Generator) -> Tensor:
    """Draw float64 values evenly between bounds (low, high).

    Returns:
        Tensor of the given shape, on the CPU.
    """
    low, high = bounds
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def log_uniform(bounds: Range, shape: tuple[int, ...], generator: Generator) -> Tensor:
    """Draw float64 values evenly in their logarithm between positive bounds (low, high).

    Returns:
        Tensor of the given shape, on the CPU.
    """
    return uniform((math.log(bounds[0]), math.log(bounds[1])), shape, generator).exp()


def _direction(batch: int, g: Generator) -> Tensor:
    """Unit vectors, mostly across the optical axis."""
    v = torch.randn(batch, 3, generator=g, dtype=torch.float64) * torch.tensor([1, 0.7, 0.25])
    return v / v.norm(dim=-1, keepdim=True)


def _middle_ray(camera: Camera) -> Tensor:
    h, w = camera.hw
    middle = torch.tensor([(w - 1) / 2, (h - 1) / 2, 1], dtype=torch.float64)
    return (torch.linalg.inv(camera.K) @ middle[:, None])[..., 0]


def _rotation_towards(direction: Tensor, old: Tensor) -> Tensor:
    """Rotation vector from `direction` to `old`, so that beta sees the point as alpha does."""
    a, b = (v / v.norm(dim=-1, keepdim=True) for v in (direction, old))
    axis = torch.linalg.cross(a, b)
    sine = axis.norm(dim=-1, keepdim=True)
    return axis * torch.atan2(sine, (a * b).sum(-1, keepdim=True)) / sine.clamp(min=1e-12)
