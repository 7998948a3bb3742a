"""Images recorded through distorting lenses, and undistorted as `pat fuse` does."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from arraygeom import Camera, Distortion, pixel_grid, resampled
from arraygeom.distortion import BROWN_CONRADY
from arraygeom.sampling import Sampled

STRONGEST = 0.3
"""Largest |k1| of a random lens."""
STRETCHED = 0.4
"""Largest relative change of radial scale, in the corner farthest from the axis."""
LOST = 0.1
"""Largest share of the height or width that an undistorted beta lacks on each side."""


def through_lenses(
    images: Float[Tensor, "b c h w"],
    cameras: Camera,
    recorded: Callable[[Tensor], Tensor],
    g: Generator,
    *,
    lost: float = 0.0,
) -> Sampled:
    """Distort images by random lenses, pass them to `recorded`, and undistort the result.

    Args:
        images: images in 0..1.
        cameras: pinhole cameras, batched (b).
        recorded: simulates the recording of a batch of images; called once.
        g: random generator of the lenses.
        lost: largest share of height or width that the lens loses on each side.

    Returns:
        Images (b, c, h, w) at the pinholes, possibly above 1, and masks `valid` (b, h, w); where a lens saw
        nothing, the edge repeats and `valid` is False.
    """
    pinholes = [cameras[i].to("cpu", torch.float64) for i in range(len(images))]
    lenses = [lens_over(pinhole, g, lost) for pinhole in pinholes]
    distorted = [
        resampled(p, pinhole, lens, extended=True).values
        for p, pinhole, lens in zip(images.cpu(), pinholes, lenses)
    ]
    captured = recorded(torch.cat(distorted).clamp(0, 1).to(images.device)).cpu()
    back = [resampled(p, lens, view, extended=True) for p, lens, view in zip(captured, lenses, pinholes)]
    values, valid = (torch.cat(parts) for parts in zip(*back))
    return Sampled(values.clamp(min=0).to(images), valid.to(images.device))


def lens_over(pinhole: Camera, g: Generator, lost: float = 0.0) -> Camera:
    """Draw a random lens, with as many pixels as a pinhole camera, that covers its view except for lost
    borders.

    Args:
        pinhole: pinhole camera, float64 on the CPU.
        lost: largest share of height or width to lose on each side.

    Returns:
        The camera with a Brown-Conrady lens (k1 alone), its K such that the lens's image fills the pixels.
    """
    x = border(pinhole)
    rays, _ = pinhole.rays(x)
    widest = float(rays[..., :2].square().sum(-1).max())
    k1 = (2 * float(torch.rand((), generator=g)) - 1) * min(STRONGEST, STRETCHED / (3 * widest))
    lens = pinhole.replace(distortion=Distortion(BROWN_CONRADY, pinhole.K.new_tensor([k1, 0, 0, 0])))
    distorted, _ = lens.distort(x)
    low, high = distorted.amin(0) - 0.5, distorted.amax(0) + 0.5
    cut = lost * torch.rand(2, 2, generator=g, dtype=torch.float64) * (high - low)
    low, high = low + cut[0], high - cut[1]
    return lens.transformed(filling(low, high, pinhole.hw), pinhole.hw)


def border(camera: Camera) -> Float[Tensor, "n 2"]:
    """Return the pixels (x, y), float64, on the border of a camera's image; corners appear twice."""
    x = pixel_grid(camera.hw, dtype=torch.float64)
    return torch.cat([x[0], x[-1], x[:, 0], x[:, -1]])


def filling(low: Float[Tensor, "2"], high: Float[Tensor, "2"], hw: tuple[int, int]) -> Float[Tensor, "3 3"]:
    """Make the map of pixels from the area between two corners to a whole image.

    Args:
        low: top left corner (x, y) of the area, which goes to (-0.5, -0.5).
        high: bottom right corner (x, y) of the area, which goes to (w - 0.5, h - 0.5).
        hw: (height, width) of the image.

    Returns:
        Matrix (3, 3), float64.
    """
    scale = torch.tensor([hw[1], hw[0]], dtype=torch.float64) / (high - low)
    A = torch.eye(3, dtype=torch.float64)
    A[0, 0], A[1, 1] = scale
    A[:2, 2] = -scale * low - 0.5
    return A
