"""Scenes of layers: textured planes at random depths and slants with random outlines, seen by any cameras.

A layer is a plane in the world with a painter: a camera with K = I that looks at it squarely from distance 1, so
that the painter's picture is the plane itself in metres. The plane's homography from each view to the painter
gives, at any pixel, the place on the plane and (as its third entry) the inverse depth: pictures, depth and
occlusion are exact, and no geometry is approximated. All surfaces are opaque and diffuse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from arraygeom.homography import plane_homography

from .outlines import outlines
from .photos import PhotoBank
from .rigs import HW, RigBatch, RigDistribution, View, log_uniform, rotation, uniform

_FAINT = 1 / 256
_MAX_OVERSAMPLING = 4


@dataclass(frozen=True)
class ArrayBatch:
    """Pictures and truth, one entry a camera, alpha first.

    `images` 0..1 (sRGB as the photographs have it); `depth` in metres along each camera's own axis at the
    pixels' centres; K, R and t are `cam_from_world`; `depth_range` holds bounds (near, far) of alpha's depths.
    """

    images: list[Float[Tensor, "b 3 _ _"]]
    depth: list[Float[Tensor, "b _ _"]]
    K: list[Float[Tensor, "b 3 3"]]
    R: list[Float[Tensor, "b 3 3"]]
    t: list[Float[Tensor, "b 3"]]
    hw: list[HW]
    depth_range: Float[Tensor, "b 2"]


@dataclass(frozen=True)
class Layers:
    """The layers of a batch of scenes. The first of each covers everything."""

    plane_from_world: tuple[Float[Tensor, "b l 3 3"], Float[Tensor, "b l 3"]]
    present: Bool[Tensor, "b l"]
    solid: Bool[Tensor, "b l"]
    outline: Int[Tensor, "b l"]
    outline_from_plane: Float[Tensor, "b l 3 3"]
    texture: Int[Tensor, "b l"]
    texel_from_plane: Float[Tensor, "b l 3 3"]
    colour: Float[Tensor, "b l 3 4"]


class LayeredScenes:
    """A source of training samples.

    `layers` bounds the number of planes in a scene, both ends included. All randomness comes from the generator
    given to `sample` (on the CPU, whatever the device) and from `seed`, which makes the outlines.
    """

    def __init__(
        self,
        photos: PhotoBank,
        rigs: RigDistribution,
        *,
        hw: HW,
        layers: tuple[int, int] = (4, 9),
        seed: int = 0,
        device: torch.device | str = "cpu",
    ):
        self.photos = photos.to(device)
        self.rigs = rigs
        self.hw = hw
        self.layers = layers
        self.device = torch.device(device)
        self.outlines = outlines(256, seed).to(device)

    def sample(self, batch: int, generator: Generator) -> ArrayBatch:
        """Random scenes seen by random rigs."""
        return self.render(self.rigs.sample(batch, self.hw, generator), generator)

    @torch.no_grad()
    def render(self, rigs: RigBatch, generator: Generator, *, oversampling: int = 1) -> ArrayBatch:
        """Random scenes seen by given rigs, whose first view is alpha and the world frame.

        A view with fewer pixels a radian than alpha is rendered at about alpha's and averaged down by area, as a
        coarser sensor would; `oversampling` asks for more than that.
        """
        layers = draw_layers(rigs, self.layers, self.photos, len(self.outlines), generator)
        factors = [oversampling * _oversampling(rigs.views[0], v) for v in rigs.views]
        images, depth = zip(*(self._seen(layers, v, f) for v, f in zip(rigs.views, factors)))
        bounds = torch.stack(depth[0].flatten(1).aminmax(dim=1), -1)
        K, R, t = ([getattr(v, k).float().to(self.device) for v in rigs.views] for k in "KRt")
        return ArrayBatch(list(images), list(depth), K, R, t, [v.hw for v in rigs.views], bounds)

    def _seen(self, layers: Layers, view: View, factor: int) -> tuple[Tensor, Tensor]:
        """Picture, and depth at the pixels' centres of the surface that covers most of each pixel."""
        front = self._front(layers, view)
        depth = (1 / front.inverse_depth).view(-1, *view.hw)
        if factor == 1:
            return self._shade(layers, view, front), depth
        fine = view.resized((view.hw[0] * factor, view.hw[1] * factor))
        return avg_pool2d(self._shade(layers, fine, self._front(layers, fine)), factor), depth

    def _front(self, layers: Layers, view: View) -> _Front:
        homogeneous, opacity = self._cover(layers, view)
        inverse_depth = torch.where(opacity > _FAINT, homogeneous, 0.0)
        q1, first = inverse_depth.max(1)
        a1 = opacity.gather(1, first[:, None])[:, 0]
        q2, second = inverse_depth.scatter(1, first[:, None], 0.0).max(1)
        a1 = torch.where(q2 > 0, a1, 1.0)
        return _Front(first, second, a1, torch.where(a1 >= 0.5, q1, q2))

    def _cover(self, layers: Layers, view: View) -> tuple[Tensor, Tensor]:
        """Inverse depth and opacity (B, L, N) of every layer at every pixel."""
        B, L = layers.present.shape
        H = layers.outline_from_plane @ plane_from_view(layers, view)
        homogeneous = self._pixels(view.hw) @ H.float().to(self.device).mT
        q = homogeneous[..., 2].contiguous()
        in_front = (q > 1e-6) & layers.present.to(self.device)[..., None]
        q.masked_fill_(~in_front, 1.0)
        position = (homogeneous[..., :2] / q[..., None]).clamp_(-1, 1).view(B * L, *view.hw, 2)
        shapes = self.outlines[layers.outline.flatten().to(self.device)]
        distance = grid_sample(shapes, position, padding_mode="border", align_corners=False).view(B, L, -1)
        opacity = (distance / _steps(distance.view(B, L, *view.hw)).flatten(2) + 0.5).clamp_(0, 1)
        opacity = torch.where(layers.solid.to(self.device)[..., None], 1.0, opacity)
        return q, opacity * in_front

    def _shade(self, layers: Layers, view: View, front: _Front) -> Tensor:
        """The picture (B, 3, h, w): the two foremost layers of each pixel, mixed by the opacity of the first."""
        H = (layers.texel_from_plane @ plane_from_view(layers, view)).float().to(self.device)
        colour = self._colours(layers, H, view.hw, front.first, torch.ones_like(front.opacity, dtype=torch.bool))
        edge = front.opacity < 1 - _FAINT
        behind = self._colours(layers, H, view.hw, front.second, edge)
        colour[:, edge] = torch.lerp(behind, colour[:, edge], front.opacity[edge])
        return colour.view(3, -1, *view.hw).movedim(0, 1).contiguous()

    def _colours(self, layers: Layers, H: Tensor, hw: HW, layer: Tensor, where: Tensor) -> Tensor:
        """Colours (3, B, N), or (3, n) at those pixels `where` is True if not everywhere."""
        B, L = layers.present.shape
        flat = layer + L * torch.arange(B, device=self.device)[:, None]
        pixel = torch.arange(hw[0] * hw[1], device=self.device).expand_as(flat)
        parts = zip(flat[where].split(_CHUNK), pixel[where].split(_CHUNK))
        texture = layers.texture.flatten().to(self.device)
        paint = layers.colour.float().flatten(0, 1).to(self.device)
        done = [self._painted(H.flatten(0, 1)[i], texture[i], paint[i], p, hw[1]) for i, p in parts]
        colour = torch.cat(done, 1) if done else H.new_zeros(3, 0)
        return colour.view(3, B, -1) if len(colour[0]) == where.numel() else colour

    def _painted(self, H: Tensor, texture: Tensor, paint: Tensor, pixel: Tensor, width: int) -> Tensor:
        px, py = (pixel % width).float(), torch.div(pixel, width, rounding_mode="floor").float()
        m = H.flatten(1).unbind(1)
        q = m[6] * px + m[7] * py + m[8]
        u = (m[0] * px + m[1] * py + m[2]) / q
        v = (m[3] * px + m[4] * py + m[5]) / q
        steps = [((m[i] - u * m[6 + i]) ** 2 + (m[3 + i] - v * m[6 + i]) ** 2) for i in (0, 1)]
        level = 0.5 * torch.log2(torch.maximum(*steps) / q**2 + 1e-12)
        r, g, b = self.photos.lookup(texture, torch.stack([u, v], -1), level)
        p = paint.unbind(2)
        return (p[0] * r[:, None] + p[1] * g[:, None] + p[2] * b[:, None] + p[3]).mT.clamp(0, 1)

    def _pixels(self, hw: HW) -> Tensor:
        y, x = torch.meshgrid(*(torch.arange(n, device=self.device).float() for n in hw), indexing="ij")
        return torch.stack([x, y, torch.ones_like(x)], -1).flatten(0, 1)


_CHUNK = 1 << 16


@dataclass(frozen=True)
class _Front:
    """At each pixel the two foremost layers, the opacity of the first, and the inverse depth of the main one."""

    first: Tensor
    second: Tensor
    opacity: Tensor
    inverse_depth: Tensor


def plane_from_view(layers: Layers, view: View) -> Float[Tensor, "b l 3 3"]:
    """The homography H with H (x, 1) = (u, v, 1) / z: pixels to metres on the planes, and inverse depth."""
    R, t = layers.plane_from_world
    R_view = view.R[:, None] @ R.mT
    t_view = view.t[:, None] - (R_view @ t[..., None])[..., 0]
    square = torch.eye(3, dtype=R.dtype)
    H = plane_homography(square, view.K[:, None], R_view, t_view, normal=square[2], d=-torch.ones((), dtype=R.dtype))
    return torch.linalg.inv(H)


def _steps(distance: Tensor) -> Tensor:
    """How much a distance changes from a pixel to the next, so that edges get one pixel wide from any angle."""
    x = torch.nn.functional.pad(distance.diff(dim=-1).abs(), (1, 1))
    y = torch.nn.functional.pad(distance.diff(dim=-2).abs(), (0, 0, 1, 1))
    x, y = torch.maximum(x[..., 1:], x[..., :-1]), torch.maximum(y[..., 1:, :], y[..., :-1, :])
    return x.square_().addcmul_(y, y).sqrt_().clamp_(min=1e-6)


def _oversampling(alpha: View, view: View) -> int:
    ratio = float((alpha.K[:, 0, 0] / view.K[:, 0, 0]).median())
    return min(max(round(ratio), 1), _MAX_OVERSAMPLING)


def draw_layers(rigs: RigBatch, count: tuple[int, int], photos: PhotoBank, shapes: int, generator: Generator) -> Layers:
    """Random layers in front of the first view of the rigs, between the rigs' near and far depths.

    Layer 0 is the background. In half of the scenes layer 1 is a ground (or a ceiling), in a quarter layer 2 is a
    wall; the others are things with outlines. In one scene in eight all lie within 5 % of one depth.
    """
    g = generator
    B, L = len(rigs.near), count[1]
    alpha = rigs.views[0]
    ray = _anchors(alpha, L, g)
    normal = _normals(B, L, g)
    q = _inverse_depths(rigs, L, g)
    ground, wall = _roles(B, L, g)
    ray[ground] = _ground_anchor(alpha)[ground.any(1)]
    normal[ground] = _unit(torch.tensor([0.0, 1, 0]) + 0.05 * _randn((int(ground.sum()), 3), g))
    normal[wall] = _unit(torch.tensor([1.0, 0, 0.4]) + 0.2 * _randn((int(wall.sum()), 3), g))
    facing = (normal * ray).sum(-1) / ray.norm(dim=-1)
    normal = normal * torch.where(facing < 0, -1.0, 1.0)[..., None]
    number = torch.randint(count[0], count[1] + 1, (B, 1), generator=g)
    present = (torch.arange(L) < number) & (facing.abs() > 0.04)
    solid = ground | wall
    solid[:, 0] = True
    pixels = torch.where(solid, 1.3 * alpha.hw[1], alpha.hw[0] * log_uniform((0.2, 2.5), (B, L), g))
    q = _not_nearer(rigs, q, normal, ray, pixels / 2)
    anchor = ray / q[..., None]
    R, t = _painters(normal, anchor)
    metres_per_pixel = 1 / (q * alpha.K[:, :1, 0])
    return Layers(
        (R, t),
        present,
        solid,
        torch.randint(shapes, (B, L), generator=g),
        _outline_from_plane(R, metres_per_pixel * pixels / 2, g),
        *_texture(R, metres_per_pixel, facing.abs(), photos, g),
        _paint(B, L, g),
    )


def _randn(shape: tuple[int, ...], g: Generator) -> Tensor:
    return torch.randn(shape, generator=g, dtype=torch.float64)


def _unit(v: Tensor) -> Tensor:
    return v / v.norm(dim=-1, keepdim=True)


def _rays(view: View, pixel: Tensor) -> Tensor:
    """(x, y, 1) in the camera's frame of pixels (B, L, 2)."""
    homogeneous = torch.cat([pixel, torch.ones_like(pixel[..., :1])], -1)
    return homogeneous @ torch.linalg.inv(view.K).mT


def _anchors(alpha: View, L: int, g: Generator) -> Tensor:
    """Rays through the layers' middles, up to 15 % of the picture outside it."""
    h, w = alpha.hw
    size = torch.tensor([w, h], dtype=torch.float64)
    return _rays(alpha, uniform((-0.15, 1.15), (len(alpha.K), L, 2), g) * size)


def _ground_anchor(alpha: View) -> Tensor:
    """The ray through the middle of the bottom or the top row, whichever is farther from the horizon."""
    h, w = alpha.hw
    rows = torch.tensor([0.0, h - 1.0], dtype=torch.float64)
    row = rows[(rows - alpha.K[:, 1, 2, None]).abs().argmax(1)]
    return _rays(alpha, torch.stack([torch.full_like(row, w / 2), row], -1)[:, None])[:, 0]


def _normals(B: int, L: int, g: Generator) -> Tensor:
    """Unit normals: half of the things nearly face the camera, the others slant by up to 60 degrees."""
    slant = torch.where(
        torch.rand(B, L, generator=g) < 0.5, uniform((0.001, 0.15), (B, L), g), uniform((0.1, 1.0), (B, L), g)
    )
    slant[:, 0] *= 0.4
    angle = uniform((0, 2 * math.pi), (B, L), g)
    return torch.stack([slant.sin() * angle.cos(), slant.sin() * angle.sin(), slant.cos()], -1)


def _inverse_depths(rigs: RigBatch, L: int, g: Generator) -> Tensor:
    """At the anchors: even in disparity or in the logarithm of depth, background farthest, one scene in eight flat."""
    B = len(rigs.near)
    low, high = 1 / rigs.far[:, None], 1 / rigs.near[:, None]
    where = uniform((0, 1), (B, L), g)
    even = torch.lerp(low, high, where)
    logarithmic = low * (high / low) ** where
    q = torch.where(torch.rand(B, 1, generator=g) < 0.6, even, logarithmic)
    flat = torch.rand(B, 1, generator=g) < 0.125
    q = torch.where(flat, q[:, :1] * (1 + 0.05 * where), q)
    q[:, 0] = torch.where(flat[:, 0], q[:, 0], low[:, 0])
    return q


def _not_nearer(rigs: RigBatch, q: Tensor, normal: Tensor, ray: Tensor, radius: Tensor) -> Tensor:
    """Inverse depths at the anchors, lowered where the slant would bring the plane nearer than `near`.

    The inverse depth of a plane grows by q |normal_xy| / (normal . ray) over one focal length of the picture;
    `radius` is how far the layer reaches, in alpha's pixels.
    """
    slope = normal[..., :2].norm(dim=-1) / (normal * ray).sum(-1).clamp(min=1e-3)
    grown = 1 + slope * radius / rigs.views[0].K[:, :1, 0]
    return torch.minimum(q, 1 / (rigs.near[:, None] * grown))


def _roles(B: int, L: int, g: Generator) -> tuple[Tensor, Tensor]:
    """Which layer is the ground and which a wall."""
    ground, wall = torch.zeros(2, B, L, dtype=torch.bool)
    ground[:, 1] = torch.rand(B, generator=g) < 0.5
    wall[:, 2] = torch.rand(B, generator=g) < 0.25
    return ground, wall


def _painters(normal: Tensor, anchor: Tensor) -> tuple[Tensor, Tensor]:
    """`plane_from_world`: e2 points where the plane recedes fastest, the anchor is at (0, 0, 1)."""
    forward = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    e2 = _unit(forward - normal[..., 2:] * normal)
    R = torch.stack([torch.linalg.cross(e2, normal), e2, normal], -2)
    return R, forward - (R @ anchor[..., None])[..., 0]


def _upright(R: Tensor) -> Tensor:
    """The angle by which e1 is turned in the picture."""
    return torch.atan2(R[..., 0, 1], R[..., 0, 0])


def _affine(angle: Tensor, sx: Tensor, sy: Tensor) -> Tensor:
    """Scale, then turn: a 3x3 matrix without shift."""
    axis = torch.zeros(*angle.shape, 3, dtype=torch.float64)
    axis[..., 2] = angle
    return rotation(axis) * torch.stack([sx, sy, torch.ones_like(sx)], -1)[..., None, :]


def _outline_from_plane(R: Tensor, radius: Tensor, g: Generator) -> Tensor:
    """Outlines of about this radius in metres, upright but for some."""
    aspect = log_uniform((0.7, 1.4), radius.shape, g)
    return _affine(_upright(R) + 0.3 * _randn(radius.shape, g), aspect / radius, 1 / (aspect * radius))


def _texture(R: Tensor, metres_per_pixel: Tensor, facing: Tensor, photos: PhotoBank, g: Generator):
    """Which texture, and texels from metres: 0.5 to 3 texels a pixel of alpha at the anchor.

    Along the slant textures are stretched as much as the view compresses them, so that they stay sharp.
    """
    shape = metres_per_pixel.shape
    photo = torch.randint(photos.photos, shape, generator=g)
    other = torch.randint(len(photos), shape, generator=g)
    texture = torch.where(torch.rand(shape, generator=g) < 0.5, photo, other)
    s = log_uniform((0.5, 3.0), shape, g) / metres_per_pixel
    turn = torch.where(torch.rand(shape, generator=g) < 0.8, 0.1, 3.0) * _randn(shape, g)
    A = _affine(_upright(R) + turn, s * (torch.randint(2, shape, generator=g) * 2 - 1), s * facing.clamp(min=0.1))
    A[..., :2, 2] = uniform((0, 1), (*shape, 2), g) * photos.wh.cpu()[texture, 0]
    return texture, A


_YCC_FROM_RGB = torch.tensor(
    [[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]], dtype=torch.float64
)


def _paint(B: int, L: int, g: Generator) -> Tensor:
    """Affine colour maps (B, L, 3, 4) of the textures: contrast, brightness, hue, saturation and tint.

    Half of the layers keep their hue; one in eight is nearly plain. Luminance does not tell the hue of the rest.
    """
    natural = torch.rand(B, L, generator=g) < 0.5
    plain = torch.rand(B, L, generator=g) < 0.125
    hue = torch.where(natural, 0.1 * _randn((B, L), g), uniform((-math.pi, math.pi), (B, L), g))
    contrast = torch.where(plain, uniform((0, 0.15), (B, L), g), uniform((0.7, 1.2), (B, L), g))
    saturation = contrast * uniform((0.3, 1.25), (B, L), g)
    tint = torch.where(natural & ~plain, 0.02, 0.07)[..., None] * _randn((B, L, 2), g)
    middle = torch.where(plain, uniform((0.1, 0.9), (B, L), g), uniform((0.35, 0.65), (B, L), g))
    ycc = torch.zeros(B, L, 3, 4, dtype=torch.float64)
    ycc[..., 0, 0], ycc[..., 0, 3] = contrast, middle - 0.5 * contrast
    ycc[..., 1, 1] = ycc[..., 2, 2] = saturation * hue.cos()
    ycc[..., 1, 2], ycc[..., 2, 1] = -saturation * hue.sin(), saturation * hue.sin()
    ycc[..., 1:, 3] = tint
    ycc[..., :3] = ycc[..., :3] @ _YCC_FROM_RGB
    return torch.linalg.inv(_YCC_FROM_RGB) @ ycc
