"""Lens and shutter: blur, defocus by depth, motion, vignetting."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom.camera import Camera
from arraygeom.pixels import pixel_grid
from arraygeom.sampling import sample
from pat.sensors import Step
from pat.sensors.steps import convolved

from .chain import LitStep, OpticalImage


@dataclass(frozen=True)
class DiscBlur(Step):
    """Uniform defocus by a round aperture: the mean over a disc, radius in pixels, its rim a pixel soft."""

    radius: float | Tensor

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        return convolved(image, disc_kernel(self.radius, image))


@dataclass(frozen=True)
class Defocus(LitStep):
    """Defocus by depth: a thin lens of `lens` mm at f / `f_number`, focused at `focus` metres.

    A point at depth z becomes a disc of diameter f_pixels (lens / f_number / 1000) |1 / focus - 1 / z| pixels
    (an ellipse where fx and fy differ), or a Gaussian with the same variance. Every pixel scatters its light,
    and nearer pixels occlude farther ones; what the sharp image lacks behind an edge is filled from around
    it. Needs depth and a camera. Differentiable in the image, and in depth through the size of the blur.
    """

    focus: float
    f_number: float
    lens: float
    shape: Literal["disc", "gaussian"] = "disc"

    def __post_init__(self) -> None:
        for name in ("focus", "f_number", "lens"):
            if not getattr(self, name) > 0:
                raise ValueError(f"defocus: {name} must be positive, got {getattr(self, name):g}")

    def expose(self, light: OpticalImage, generator: Generator) -> OpticalImage:
        if light.depth is None or light.camera is None:
            raise ValueError(
                "defocus needs the depth of every pixel and the camera: give record() `depth` and `camera`"
            )
        fx, fy = (light.camera.K[..., i, :2].norm(dim=-1) for i in (0, 1))
        diameter = circle_of_confusion(light.depth, self.focus, self.f_number, self.lens, fx.to(light.depth))
        return replace(light, image=self._diffused(light.image, diameter / 2, float((fy / fx).mean())))

    def _diffused(self, image: Tensor, radius: Tensor, aspect: float) -> Tensor:
        """Bins of signed radii (near: positive), from the farthest to the nearest, each over those before."""
        levels = _levels(float(radius.detach().min()), float(radius.detach().max()))
        bins = torch.bucketize(radius.detach(), radius.new_tensor(levels[1:-1]), right=True)
        seen, cover = torch.zeros_like(image), torch.zeros_like(image[:, :1])
        for i in bins.unique().tolist():
            share = ((radius - levels[i]) / (levels[i + 1] - levels[i]))[:, None]
            inside = (bins == i)[:, None].to(image)
            light = torch.cat([image, torch.ones_like(cover)], 1)
            near, far = (self._kernel(abs(levels[i + k]), aspect, image) for k in (1, 0))
            scattered = convolved(inside * share * light, near) + convolved(inside * (1 - share) * light, far)
            colour, opacity = scattered[:, :-1], scattered[:, -1:]
            seen, cover = colour + (1 - opacity) * seen, opacity + (1 - opacity) * cover
        return seen / cover.clamp(min=1e-6)

    def _kernel(self, radius: float, aspect: float, like: Tensor) -> Tensor:
        if self.shape == "disc":
            return disc_kernel(radius, like, aspect)
        return gaussian_kernel(radius / 2, like, aspect)


def circle_of_confusion(
    depth: Float[Tensor, "b h w"], focus: float, f_number: float, lens: float, focal: Float[Tensor, "*b"]
) -> Float[Tensor, "b h w"]:
    """Signed diameters in pixels, positive for what is nearer than `focus` (metres); `focal` is fx in pixels.

    `lens` is the focal length in millimetres: lens / f_number is the aperture.

    >>> z = torch.full((1, 1, 1), 1.0)
    >>> circle_of_confusion(z, 2.0, 2.0, 50.0, torch.tensor([800.0])).item()
    10.0
    """
    return focal.reshape(-1, 1, 1) * (1e-3 * lens / f_number) * (1 / depth - 1 / focus)


def _levels(low: float, high: float) -> list[float]:
    """Signed radii covering [low, high]: half a pixel apart near zero, an eighth of themselves beyond."""
    radii = [0.0]
    while radii[-1] <= max(-low, high):
        radii.append(max(radii[-1] + 0.5, radii[-1] * 1.125))
    both = [-r for r in reversed(radii[1:])] + radii
    first = max(i for i, r in enumerate(both) if r <= low)
    last = min(i for i, r in enumerate(both) if r > high)
    return both[first : last + 1]


@dataclass(frozen=True)
class MotionBlur(Step):
    """The mean over the time the shutter is open, `shutter` seconds, about the moment of the sharp image.

    Everything moves with `velocity` (x, y) in pixels a second. The border is replicated.
    """

    shutter: float
    velocity: tuple[float, float]

    def __post_init__(self) -> None:
        if self.shutter < 0:
            raise ValueError(f"motion blur: shutter is a time in seconds, got {self.shutter:g}")

    def apply(self, image: Float[Tensor, "b c h w"], generator: Generator) -> Float[Tensor, "b c h w"]:
        path = self.shutter * image.new_tensor(self.velocity)
        steps = max(math.ceil(2 * float(path.norm())), 1)
        times = (torch.arange(steps, dtype=path.dtype) + 0.5) / steps - 0.5
        grid = pixel_grid((image.shape[-2], image.shape[-1]), dtype=path.dtype, device=path.device)
        frames = [sample(image, (grid - t * path)[None], extended=True).values for t in times.tolist()]
        return torch.stack(frames).mean(0)


@dataclass(frozen=True)
class Vignetting(LitStep):
    """Less light in the corners: gain 1 + a r^2 + b r^4 + c r^6, r = 1 half a diagonal from the centre.

    The centre is the camera's principal point if the camera is given to `record`, else the image's middle,
    and the diagonal is that of the image. `natural` multiplies by cos^4 of the ray's angle, which needs the
    camera.
    """

    falloff: tuple[float, ...] = ()
    natural: bool = False

    def expose(self, light: OpticalImage, generator: Generator) -> OpticalImage:
        grid = pixel_grid(light.hw, dtype=light.image.dtype, device=light.image.device)
        gain = self._falloff(grid, light)
        if self.natural:
            gain = gain * _cos4(grid, light.camera)
        return replace(light, image=light.image * gain.reshape(-1, 1, *light.hw))

    def _falloff(self, grid: Tensor, light: OpticalImage) -> Tensor:
        h, w = light.hw
        middle = grid.new_tensor([[(w - 1) / 2, (h - 1) / 2]])
        centre = middle if light.camera is None else light.camera.K[..., :2, 2].to(grid).reshape(-1, 2)
        r2 = (grid - centre[:, None, None]).square().sum(-1) / ((h * h + w * w) / 4)
        return 1 + sum((a * r2**k for k, a in enumerate(self.falloff, 1)), torch.zeros_like(r2))


def _cos4(grid: Tensor, camera: Camera | None) -> Tensor:
    if camera is None:
        raise ValueError("natural vignetting needs the rays: give record() the camera")
    rays, _ = camera.to(grid).rays(grid.expand(*camera.K.shape[:-2], *grid.shape))
    return (rays[..., 2] / rays.norm(dim=-1)) ** 4


def disc_kernel(radius: float | Tensor, like: Tensor, aspect: float = 1.0) -> Tensor:
    """A disc with a rim one pixel soft, `aspect` times as high as wide; its sum is 1."""
    x, y = _kernel_grid(float(torch.as_tensor(radius).detach()) + 0.5, aspect, like)
    kernel = (radius + 0.5 - torch.hypot(x, y)).clamp(0, 1)
    return kernel / kernel.sum()


def gaussian_kernel(sigma: float, like: Tensor, aspect: float = 1.0) -> Tensor:
    """A Gaussian, `aspect` times as high as wide; its sum is 1."""
    x, y = _kernel_grid(4 * sigma, aspect, like)
    kernel = torch.exp(-0.5 * (x * x + y * y) / max(sigma, 1e-3) ** 2)
    return kernel / kernel.sum()


def _kernel_grid(disparity: float, aspect: float, like: Tensor) -> tuple[Tensor, Tensor]:
    nx, ny = math.ceil(disparity), math.ceil(disparity * aspect)
    x = torch.arange(-nx, nx + 1, dtype=like.dtype, device=like.device)
    y = torch.arange(-ny, ny + 1, dtype=like.dtype, device=like.device)
    return x[None], y[:, None] / aspect
