"""Content of a layered scene: random planes with outlines, textures and colours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor
from torch.nn.functional import normalize

from arraygeom.camera import Camera
from arraygeom.pixels import to_homogeneous
from arraygeom.pose import Pose, matvec

from ...media.colour import REC601
from .photos import PhotoBank
from .rigs import RigBatch, log_uniform, uniform

_GRAZING = 0.04
"""Sine of the angle to the view below which planes are left out."""


@dataclass(frozen=True)
class Layers:
    """Layers (b, l) of a batch of scenes, on the CPU, real numbers in float64.

    A layer is the plane Z = 1 of its own frame, on which (X, Y) are positions in metres.

    Attributes:
        plane_from_world: pose of the layer's frame.
        present: True for layers in the scene; the others are to be left out.
        solid: True for a layer that covers its whole plane; otherwise it covers the inside of an outline.
        outline: number of the outline.
        outline_from_plane: map from metres to the outline's square [-1, 1]^2.
        texture: number of the texture.
        texel_from_plane: map from metres to pixels of the full texture.
        colour: matrix by which texture colours (r, g, b, 1), 0..1, are multiplied, before clipping.
    """

    plane_from_world: Pose
    present: Bool[Tensor, "b l"]
    solid: Bool[Tensor, "b l"]
    outline: Int[Tensor, "b l"]
    outline_from_plane: Float[Tensor, "b l 3 3"]
    texture: Int[Tensor, "b l"]
    texel_from_plane: Float[Tensor, "b l 3 3"]
    colour: Float[Tensor, "b l 3 4"]


def draw_layers(
    rigs: RigBatch, count: tuple[int, int], photos: PhotoBank, shapes: int, generator: Generator
) -> Layers:
    """Draw random layers in front of the rigs' first camera, between near and far.

    Layer 0 is the background. In half of the scenes layer 1 is a ground or a ceiling, in a quarter layer 2 is
    a wall; the others have outlines. In one scene in eight all are drawn within 5 % of one depth. Layers that
    slant nearer than near are moved back, possibly beyond far.

    Args:
        rigs: rigs, one for each scene.
        count: least and greatest number of layers, 1 or more.
        photos: textures to choose from.
        shapes: number of outlines to choose from.
        generator: random generator on the CPU.

    Returns:
        Layers (b, count[1]); those beyond a scene's number, or seen at a grazing angle, are not `present`.
    """
    g = generator
    shape = len(rigs.near), count[1]
    planes = _planes(rigs, shape, g)
    number = torch.randint(count[0], count[1] + 1, (shape[0], 1), generator=g)
    R = _painters(planes.normal)
    metres_per_pixel = 1 / (planes.inverse_depth * rigs.cameras[0].K[:, :1, 0])
    texture, texel_from_plane = _texture(R, metres_per_pixel, planes.facing, photos, g)
    t = R.new_tensor([0, 0, 1]) - matvec(R, planes.ray / planes.inverse_depth[..., None])
    return Layers(
        plane_from_world=Pose(R, t),
        present=(torch.arange(shape[1]) < number) & (planes.facing > _GRAZING),
        solid=planes.solid,
        outline=torch.randint(shapes, shape, generator=g),
        outline_from_plane=_outline_from_plane(R, metres_per_pixel * planes.radius, g),
        texture=texture,
        texel_from_plane=texel_from_plane,
        colour=_paint(shape, g),
    )


class _Planes(NamedTuple):
    """Geometry of each layer (B, L): ray to its anchor, normal, sine of its angle, inverse depth, radius in
    alpha's pixels."""

    ray: Tensor
    normal: Tensor
    facing: Tensor
    inverse_depth: Tensor
    radius: Tensor
    solid: Tensor


def _planes(rigs: RigBatch, shape: tuple[int, int], g: Generator) -> _Planes:
    """Draw planes in front of alpha; in some scenes one is a ground, one a wall."""
    alpha = rigs.cameras[0]
    wh = torch.tensor(alpha.hw[::-1], dtype=torch.float64)
    ray = _rays(alpha, uniform((-0.15, 1.15), (*shape, 2), g) * wh)  # up to 15 % of the image outside it
    normal = _normals(shape, g)
    ground, wall = torch.zeros(2, *shape, dtype=torch.bool)
    ground[:, 1:2] = torch.rand(shape[0], 1, generator=g) < 0.5
    wall[:, 2:3] = torch.rand(shape[0], 1, generator=g) < 0.25
    ray[ground] = _ground_anchor(alpha)[ground.any(1)]
    normal[ground] = _tilted((0.0, 1.0, 0.0), 0.05, int(ground.sum()), g)
    normal[wall] = _tilted((1.0, 0.0, 0.4), 0.2, int(wall.sum()), g)
    facing = (normal * ray).sum(-1) / ray.norm(dim=-1)
    normal = normal * torch.where(facing < 0, -1.0, 1.0)[..., None]
    solid = ground | wall
    solid[:, 0] = True
    radius = torch.where(solid, 0.65 * alpha.hw[1], alpha.hw[0] * log_uniform((0.15, 1.25), shape, g))
    q = _not_nearer(rigs, _inverse_depths(rigs, shape, g), normal, ray, radius)
    return _Planes(ray, normal, facing.abs(), q, radius, solid)


def _randn(shape: tuple[int, ...], g: Generator) -> Tensor:
    return torch.randn(shape, generator=g, dtype=torch.float64)


def _tilted(normal: tuple[float, float, float], by: float, count: int, g: Generator) -> Tensor:
    return normalize(torch.tensor(normal, dtype=torch.float64) + by * _randn((count, 3), g), dim=-1)


def _rays(camera: Camera, pixel: Tensor) -> Tensor:
    """Directions (x, y, 1) in the camera's frame of pixels (B, L, 2)."""
    return to_homogeneous(pixel) @ torch.linalg.inv(camera.K).mT


def _ground_anchor(alpha: Camera) -> Tensor:
    """Ray through the middle of the bottom or the top row, whichever is farther from the horizon."""
    h, w = alpha.hw
    rows = torch.tensor([0.0, h - 1.0], dtype=torch.float64)
    row = rows[(rows - alpha.K[:, 1, 2, None]).abs().argmax(1)]
    return _rays(alpha, torch.stack([torch.full_like(row, w / 2), row], -1)[:, None])[:, 0]


def _normals(shape: tuple[int, int], g: Generator) -> Tensor:
    """Unit normals: half of the layers nearly face the camera, the others slant by up to 60 degrees."""
    facing = torch.rand(shape, generator=g) < 0.5
    slant = torch.where(facing, uniform((0.001, 0.15), shape, g), uniform((0.1, 1.0), shape, g))
    slant[:, 0] *= 0.4
    angle = uniform((0, 2 * math.pi), shape, g)
    return torch.stack([slant.sin() * angle.cos(), slant.sin() * angle.sin(), slant.cos()], -1)


def _inverse_depths(rigs: RigBatch, shape: tuple[int, int], g: Generator) -> Tensor:
    """Inverse depths at the anchors: even in disparity or log depth, background farthest, one scene in eight
    flat."""
    B = shape[0]
    low, high = 1 / rigs.far[:, None], 1 / rigs.near[:, None]
    where = uniform((0, 1), shape, g)
    even = torch.lerp(low, high, where)
    q = torch.where(torch.rand(B, 1, generator=g) < 0.6, even, (low * (high / low) ** where))
    flat = torch.rand(B, 1, generator=g) < 0.125
    q = torch.where(flat, q[:, :1] * (1 + 0.05 * where), q)
    q[:, 0] = torch.where(flat[:, 0], q[:, 0], low[:, 0])
    return q


def _not_nearer(rigs: RigBatch, q: Tensor, normal: Tensor, ray: Tensor, radius: Tensor) -> Tensor:
    """Inverse depths at the anchors, lowered where the slant would bring the plane nearer than `near`.

    The inverse depth of a plane grows by q |normal_xy| / (normal . ray) over one focal length of the image;
    `radius` is the layer's radius in alpha's pixels.
    """
    slope = normal[..., :2].norm(dim=-1) / (normal * ray).sum(-1).clamp(min=1e-3)
    return torch.minimum(q, 1 / (rigs.near[:, None] * (1 + slope * radius / rigs.cameras[0].K[:, :1, 0])))


def _painters(normal: Tensor) -> Tensor:
    """Rotations `plane_from_world` with rows e1, e2, normal; e2 points where the plane recedes fastest."""
    e2 = normalize(torch.tensor([0.0, 0, 1], dtype=torch.float64) - normal[..., 2:] * normal, dim=-1)
    return torch.stack([torch.linalg.cross(e2, normal), e2, normal], -2)


def _upright(R: Tensor) -> Tensor:
    """Angle of e1 in the image."""
    return torch.atan2(R[..., 0, 1], R[..., 0, 0])


def _affine(angle: Tensor, sx: Tensor, sy: Tensor) -> Tensor:
    """Matrix (3 x 3) that scales, then rotates, without shift."""
    A = torch.eye(3, dtype=torch.float64).repeat(*angle.shape, 1, 1)
    c, s = angle.cos(), angle.sin()
    A[..., :2, :2] = torch.stack([c * sx, -s * sy, s * sx, c * sy], -1).unflatten(-1, (2, 2))
    return A


def _outline_from_plane(R: Tensor, radius: Tensor, g: Generator) -> Tensor:
    """Maps to outlines of about this radius in metres, mostly upright."""
    aspect = log_uniform((0.7, 1.4), radius.shape, g)
    return _affine(_upright(R) + 0.3 * _randn(radius.shape, g), aspect / radius, 1 / (aspect * radius))


def _texture(
    R: Tensor, metres_per_pixel: Tensor, facing: Tensor, photos: PhotoBank, g: Generator
) -> tuple[Tensor, Tensor]:
    """Texture numbers, and maps from metres to texels: 0.5 to 3 texels for each pixel of alpha at the anchor.

    Along the slant textures are stretched as much as the view compresses them, so that they stay sharp.
    """
    shape = metres_per_pixel.shape
    photo = torch.randint(photos.photos, shape, generator=g)
    other = torch.randint(len(photos), shape, generator=g)
    texture = torch.where(torch.rand(shape, generator=g) < 0.5, photo, other)
    s = log_uniform((0.5, 3.0), shape, g) / metres_per_pixel
    angle = torch.where(torch.rand(shape, generator=g) < 0.8, 0.1, 3.0) * _randn(shape, g)
    mirror = torch.randint(2, shape, generator=g) * 2 - 1
    A = _affine(_upright(R) + angle, s * mirror, s * facing.clamp(min=0.1))
    A[..., :2, 2] = uniform((0, 1), (*shape, 2), g) * photos.wh.cpu()[texture, 0]
    return texture, A


_YCC_FROM_RGB = torch.tensor(
    [list(REC601), [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]], dtype=torch.float64
)


def _paint(shape: tuple[int, int], g: Generator) -> Tensor:
    """Affine colour maps (B, L, 3, 4) of the textures: contrast, brightness, hue, saturation and tint.

    Half of the layers keep their hue; one in eight is nearly plain. The hue of the rest is independent of
    luminance.
    """
    natural = torch.rand(shape, generator=g) < 0.5
    plain = torch.rand(shape, generator=g) < 0.125
    hue = torch.where(natural, 0.1 * _randn(shape, g), uniform((-math.pi, math.pi), shape, g))
    contrast = torch.where(plain, uniform((0, 0.15), shape, g), uniform((0.7, 1.2), shape, g))
    saturation = contrast * uniform((0.3, 1.25), shape, g)
    tint = torch.where(natural & ~plain, 0.02, 0.07)[..., None] * _randn((*shape, 2), g)
    middle = torch.where(plain, uniform((0.1, 0.9), shape, g), uniform((0.35, 0.65), shape, g))
    ycc = torch.zeros(*shape, 3, 4, dtype=torch.float64)
    ycc[..., 0, 0], ycc[..., 0, 3] = contrast, middle - 0.5 * contrast
    ycc[..., 1, 1] = ycc[..., 2, 2] = saturation * hue.cos()
    ycc[..., 1, 2], ycc[..., 2, 1] = -saturation * hue.sin(), saturation * hue.sin()
    ycc[..., 1:, 3] = tint
    ycc[..., :3] = ycc[..., :3] @ _YCC_FROM_RGB
    return torch.linalg.inv(_YCC_FROM_RGB) @ ycc
