"""A room as cameras of any model see it: for tests of what a camera of one's own goes through."""

import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from arraygeom import Camera, Pose, Rig, intrinsics, pixel_grid, rotation_from_vector
from arraygeom.lenses import CameraModel
from pat import fuse, load_weights
from pat.support.metrics import score
from tests.arraygeom.rigs import number

ROOM = 3.0
"""Half of the room's side, metres."""
BALL = (0.3, 0.2, 2.0), 0.5
"""Centre and radius of a ball in it."""


def texture(X: Tensor) -> Tensor:
    """Colours (n, 3), 0 to 1, of points: waves of several directions and lengths."""
    g = torch.Generator().manual_seed(1)
    total = torch.zeros_like(X)
    for wave in (3.0, 6.0, 11.0, 19.0):
        k = torch.randn(6, 3, generator=g, dtype=X.dtype) * wave
        mix = torch.rand(6, 3, generator=g, dtype=X.dtype) / wave**0.5
        total = total + (X @ k.mT).sin() @ mix
    return 0.5 + 0.12 * total.clamp(-4, 4)


def seen(camera: Camera, samples: int = 3) -> tuple[Tensor, Tensor]:
    """The image (3, H, W) a camera records, `samples` squared rays a pixel, and how far along each it is."""
    grid = pixel_grid(camera.hw, dtype=torch.float64)
    steps = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
    colours, distance = [], grid[..., 0]
    for dx in steps:
        for dy in steps:
            X, d = hit(camera, grid + torch.stack([dx, dy]))
            colours.append(texture(X))
            distance = d if dx == dy == 0 else distance
    return torch.stack(colours).mean(0).movedim(-1, 0).float().clamp(0, 1), distance


def hit(camera: Camera, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return the points where pixels' rays hit the world, and their distances from the starts; 0 for pixels
    without a ray."""
    rays, valid = camera.rays(x)
    world = camera.cam_from_world.inverse()
    start = world.apply(camera.ray_origins(x))
    d = torch.where(valid[..., None], rays, rays.new_tensor([0.0, 0.0, 1.0])) @ world.R.mT
    d = d / d.norm(dim=-1, keepdim=True)
    wall = torch.where(d == 0, torch.inf, (d.sign() * ROOM - start) / torch.where(d == 0, 1.0, d)).amin(-1)
    centre, radius = d.new_tensor(BALL[0]), BALL[1]
    b = ((start - centre) * d).sum(-1)
    under = b.square() - (start - centre).square().sum(-1) + radius**2
    ball = torch.where(under > 0, -b - under.clamp(min=0).sqrt(), torch.inf)
    distance = torch.where(ball > 0, torch.minimum(wall, ball), wall)
    return start + distance[..., None] * d, torch.where(valid, distance, 0.0)


def recorded(rig: Rig) -> tuple[dict[str, Tensor], Tensor]:
    """Alpha's grey image and the others' in colour; what alpha sees in colour."""
    images = {name: seen(rig[name])[0] for name in rig.names}
    truth = images[rig.names[0]]
    grey = (truth * truth.new_tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0, keepdim=True)
    return {**images, rig.names[0]: grey}, truth


def rig_of_two(model: CameraModel, focal: float, hw: tuple[int, int], *, around: bool, wide: bool) -> Rig:
    """Two cameras in the room: beta beside alpha, or around the ball, as parallel rays need. `wide` ones see
    more than half of the space: to its corners."""
    R = rotation_from_vector(number(0.0, 0.12 if around else -0.01, 0.0))
    t = number(0.0, 0.0, 2.5) - R @ number(0.0, 0.0, 2.5) if around else number(-0.25, 0.01, 0.0)
    poses = Pose.identity(), Pose(R, t)
    cameras = [Camera(K=intrinsics(focal, hw), cam_from_world=p, hw=hw, distortion=model) for p in poses]
    return Rig(dict(zip(("alpha", "beta"), cameras)), depth=(1.3, 5.3 if wide else 3.2))


class Fused(NamedTuple):
    """Images and true depth of `rig_of_two`, the fused depth, and errors: PSNR of alpha's grey alone and of
    the image fused without a warning, and the median relative error of depth."""

    images: dict[str, Tensor]
    truth: Tensor
    depth: Tensor
    alone: float
    psnr: float
    off: float


def fused_in_the_room(rig: Rig, *, wide: bool) -> Fused:
    """Fuse by the usual weights; for `wide` cameras depth is a distance."""
    images, truth = recorded(rig)
    X, distance = hit(rig["alpha"], pixel_grid(rig["alpha"].hw, dtype=torch.float64))
    depth = distance if wide else X[..., 2]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frame = fuse(images, rig, alpha="alpha", network=load_weights("mono-colour"))
    shown = images["alpha"].expand(3, -1, -1), frame.image
    alone, psnr = (score(image.clamp(0, 1), truth).psnr for image in shown)
    off = float(((frame.depth - depth) / depth).abs().nanmedian())
    return Fused(images, truth, depth, alone, psnr, off)
