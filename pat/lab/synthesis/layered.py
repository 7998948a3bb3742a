"""Layered scenes: textured planes at random depths and slants with random outlines, seen by any cameras.

A layer is a plane in the world with a painter: a camera with K = I that faces it from distance 1, so that the
painter's image is the plane itself in metres. The plane's homography from each view to the painter gives, at
any pixel, the position on the plane and (as its third entry) the inverse depth: images, depth and occlusion
are exact, and no geometry is approximated. All surfaces are opaque and diffuse.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d

from arraygeom import Camera, Pose, pixel_grid, plane_homography, sample
from arraygeom.pixels import HW, to_homogeneous
from arraygeom.runtime.chunks import chunked

from .layers import Layers, draw_layers
from .outlines import outlines
from .photos import PhotoBank
from .rig_distribution import RigDistribution
from .rigs import RigBatch, random_rigs

_FAINT = 1 / 256
_MAX_OVERSAMPLING = 4
_CHUNK = 1 << 16
"""Pixels painted at once."""


@dataclass(frozen=True)
class ArrayBatch:
    """Batch of array images with ground truth; lists have one entry for each camera, alpha first.

    Attributes:
        images: images 0..1, sRGB.
        depth: metres along each camera's own axis at the pixels' centres; infinite where nothing is hit, NaN
            where unknown.
        cameras: cameras, batched (b), with alpha's frame as the world.
        depth_range: (near, far) of alpha's depths, metres; far may be infinite.
        index: number of the visible layer, from 1, 0 where none is; an empty list for scenes of no layers.
    """

    images: list[Float[Tensor, "b 3 _ _"]]
    depth: list[Float[Tensor, "b _ _"]]
    cameras: list[Camera]
    depth_range: Float[Tensor, "b 2"]
    index: list[Int[Tensor, "b _ _"]] = field(default_factory=list)


class LayeredScenes:
    """Source of random layered scenes for training.

    All randomness comes from the generator (on the CPU) given to `sample` or `render`, and from `seed`.

    Args:
        photos: textures.
        rigs: distribution of the random rigs.
        hw: (height, width) of alpha's images in `sample`.
        layers: least and greatest number of planes, 1 or more.
        seed: seed of the outlines.
        device: device of the images.
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
        """Render random scenes seen by random rigs.

        Returns:
            A batch of `batch` scenes, without gradient.
        """
        return self.render(random_rigs(self.rigs, batch, self.hw, generator), generator)

    @torch.no_grad()
    def render(self, rigs: RigBatch, generator: Generator, *, oversampling: int = 1) -> ArrayBatch:
        """Render random scenes seen by given rigs, whose first camera is alpha and the world frame.

        A view with fewer pixels a radian than alpha is rendered at about alpha's resolution (up to 4 times)
        and its image averaged by area, as a coarser sensor would. Lens models are ignored.

        Args:
            rigs: rigs of float64 on the CPU, alpha at the world's origin.
            generator: random generator on the CPU.
            oversampling: factor of further samples in a pixel along each axis.

        Returns:
            A batch without gradient, a scene for each rig, of its sizes, on this source's device, float32.
        """
        layers = draw_layers(rigs, self.layers, self.photos, len(self.outlines), generator)
        factors = [oversampling * _oversampling(rigs.cameras[0], v) for v in rigs.cameras]
        images, depth, index = zip(*(self._seen(layers, v, f) for v, f in zip(rigs.cameras, factors)))
        bounds = torch.stack(depth[0].flatten(1).aminmax(dim=1), -1)
        cameras = [c.to(device=self.device, dtype=torch.float32) for c in rigs.cameras]
        return ArrayBatch(list(images), list(depth), cameras, bounds, list(index))

    def _seen(self, layers: Layers, camera: Camera, factor: int) -> tuple[Tensor, Tensor, Tensor]:
        """Image; depth at the pixels' centres; index of the surface that covers most of each pixel."""
        front = self._front(layers, camera)
        number = torch.where(front.inverse_depth > 0, front.main + 1, 0)
        depth, index = (v.view(-1, *camera.hw) for v in (1 / front.inverse_depth, number))
        if factor == 1:
            return self._shade(layers, camera, front), depth, index
        fine = camera.resize((camera.hw[0] * factor, camera.hw[1] * factor))
        return avg_pool2d(self._shade(layers, fine, self._front(layers, fine)), factor), depth, index

    def _front(self, layers: Layers, camera: Camera) -> _Front:
        homogeneous, opacity = self._cover(layers, camera)
        inverse_depth = torch.where(opacity > _FAINT, homogeneous, 0.0)
        q1, first = inverse_depth.max(1)
        a1 = opacity.gather(1, first[:, None])[:, 0]
        q2, second = inverse_depth.scatter(1, first[:, None], 0.0).max(1)
        a1 = torch.where(q2 > 0, a1, 1.0)
        most = a1 >= 0.5
        return _Front(first, second, a1, torch.where(most, q1, q2), torch.where(most, first, second))

    def _cover(self, layers: Layers, camera: Camera) -> tuple[Tensor, Tensor]:
        """Inverse depth and opacity (B, L, N) of every layer at every pixel."""
        B, L = layers.present.shape
        H = layers.outline_from_plane @ plane_from_camera(layers, camera)
        pixels = to_homogeneous(pixel_grid(camera.hw, device=self.device)).flatten(0, 1)
        homogeneous = pixels @ H.float().to(self.device).mT
        q = homogeneous[..., 2].contiguous()
        in_front = (q > 1e-6) & layers.present.to(self.device)[..., None]
        q.masked_fill_(~in_front, 1.0)
        shapes = self.outlines[layers.outline.flatten().to(self.device)]
        position = (homogeneous[..., :2] / q[..., None]).clamp_(-1, 1).view(B * L, *camera.hw, 2)
        position = position.add_(1).mul_(shapes.shape[-1] / 2).sub_(0.5)
        distance = sample(shapes, position).values.view(B, L, -1)
        opacity = (distance / _steps(distance.view(B, L, *camera.hw)).flatten(2) + 0.5).clamp_(0, 1)
        opacity = torch.where(layers.solid.to(self.device)[..., None], 1.0, opacity)
        return q, opacity * in_front

    def _shade(self, layers: Layers, camera: Camera, front: _Front) -> Tensor:
        """Image (B, 3, h, w): each pixel's two foremost layers, mixed by the opacity of the first."""
        H = (layers.texel_from_plane @ plane_from_camera(layers, camera)).float().to(self.device)
        everywhere = torch.ones_like(front.opacity, dtype=torch.bool)
        colour = self._colours(layers, H, camera.hw, front.first, everywhere)
        edge = front.opacity < 1 - _FAINT
        behind = self._colours(layers, H, camera.hw, front.second, edge)
        colour[:, edge] = torch.lerp(behind, colour[:, edge], front.opacity[edge])
        return colour.view(3, -1, *camera.hw).movedim(0, 1).contiguous()

    def _colours(self, layers: Layers, H: Tensor, hw: HW, layer: Tensor, where: Tensor) -> Tensor:
        """Colours (3, B, N), or (3, n) for the n pixels where `where` is True if these are not all."""
        B, L = layers.present.shape
        flat = layer + L * torch.arange(B, device=self.device)[:, None]
        pixel = torch.arange(hw[0] * hw[1], device=self.device).expand_as(flat)
        texture = layers.texture.flatten().to(self.device)
        paint = layers.colour.float().flatten(0, 1).to(self.device)

        def painted(i: Tensor, pixel: Tensor) -> Tensor:
            return self._painted(H.flatten(0, 1)[i], texture[i], paint[i], pixel, hw[1])

        colour = chunked(painted, flat[where], pixel[where], rows=_CHUNK, axis=-1)
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


@dataclass(frozen=True)
class _Front:
    """The two foremost layers at each pixel, the first one's opacity, the main one and its inverse depth."""

    first: Tensor
    second: Tensor
    opacity: Tensor
    inverse_depth: Tensor
    main: Tensor


def plane_from_camera(layers: Layers, camera: Camera) -> Float[Tensor, "b l 3 3"]:
    """Compute the homographies from pixels to the layers' planes: H (x, 1) = (u, v, 1) / z.

    Args:
        layers: layers (b, l) of a batch of scenes.
        camera: cameras, batched (b), float64.

    Returns:
        H (b, l, 3, 3), float64: u, v in metres on the plane, z its depth along the camera's axis.
    """
    planes = layers.plane_from_world
    camera_from_world = Pose(camera.R[:, None].expand_as(planes.R), camera.t[:, None].expand_as(planes.t))
    pose = camera_from_world @ planes.inverse()
    eye = torch.eye(3, dtype=camera.K.dtype)
    H = plane_homography(eye, camera.K[:, None], pose.R, pose.t, normal=eye[2], d=-eye[0, 0])
    return torch.linalg.inv(H)


def _steps(distance: Tensor) -> Tensor:
    """Change of a distance from pixel to pixel, so that edges are one pixel wide from any angle."""
    x = torch.nn.functional.pad(distance.diff(dim=-1).abs(), (1, 1))
    y = torch.nn.functional.pad(distance.diff(dim=-2).abs(), (0, 0, 1, 1))
    x, y = torch.maximum(x[..., 1:], x[..., :-1]), torch.maximum(y[..., 1:, :], y[..., :-1, :])
    return x.square_().addcmul_(y, y).sqrt_().clamp_(min=1e-6)


def _oversampling(alpha: Camera, camera: Camera) -> int:
    return min(max(round(float((alpha.K[:, 0, 0] / camera.K[:, 0, 0]).median())), 1), _MAX_OVERSAMPLING)
