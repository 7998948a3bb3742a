"""A small moving scene seen by a fast mono camera and a slow colour one: what sequences are tested on."""

from __future__ import annotations

import torch

from arraygeom import Rig, Sensor, pixel_grid, sample
from pat.media.colour import luminance
from tests.arraygeom.rigs import parallel_rig

HW, FOCAL, BASELINE = (96, 160), 160.0, 0.1
FAR, NEAR = 4.0, 2.0
SPEED = 300.0
"""Speed of the square, pixels of alpha a second."""
RATE, SLOW = 120.0, 20.0


def texture(seed: int, hw: tuple[int, int] = (256, 512)) -> torch.Tensor:
    """Blobs of a few pixels in many colours."""
    g = torch.Generator().manual_seed(seed)
    rough = torch.rand(1, 3, hw[0] // 6, hw[1] // 6, generator=g)
    fine = torch.rand(1, 1, hw[0] // 2, hw[1] // 2, generator=g) * 0.3 - 0.15
    large, small = (
        torch.nn.functional.interpolate(x, hw, mode="bicubic", align_corners=False)[0] for x in (rough, fine)
    )
    return (0.1 + 0.8 * large + small).clamp(0, 1)


WALL, SQUARE = texture(0), texture(1, (48, 48))


def seen(time: float, position: float) -> torch.Tensor:
    """The image (3, H, W) of a camera `position` metres to the right of alpha."""
    x = pixel_grid(HW)
    wall = x + x.new_tensor([FOCAL * position / FAR + 150, 60])
    square = x + x.new_tensor([FOCAL * position / NEAR - 25 - SPEED * time, -24])
    back, front = (sample(t[None], p[None]) for t, p in ((WALL, wall), (SQUARE, square)))
    return torch.where(front.valid, front.values, back.values)[0]


def rig(offset: float = 0.0) -> Rig:
    """Alpha, and beta whose first frame is `offset` seconds after alpha's."""
    fast, slow = Sensor(response="mono", frame_rate=RATE), Sensor("rgb", frame_rate=SLOW, time_offset=offset)
    rig = parallel_rig(FOCAL, HW, {"fast": (), "slow": (BASELINE,)}, (1.5, 6.0), sensor=fast)
    return rig.with_camera("slow", rig["slow"].replace(sensor=slow))


def recording(count: int, offset: float = 0.0) -> tuple[dict[str, list[torch.Tensor]], list[torch.Tensor]]:
    """Frames of both cameras, and alpha's in true colour."""
    ground_truth = [seen(i / RATE, 0.0) for i in range(count)]
    g = torch.Generator().manual_seed(3)

    def noisy(image: torch.Tensor) -> torch.Tensor:
        return (image + 0.01 * torch.randn(image.shape, generator=g)).clamp(0, 1)

    slow = [noisy(seen(offset + j / SLOW, BASELINE)) for j in range(int((count / RATE - offset) * SLOW) + 1)]
    return {"fast": [noisy(luminance(t)) for t in ground_truth], "slow": slow}, ground_truth
