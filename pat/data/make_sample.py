"""Makes the sample array that ships in pat/data/sample: `python -m pat.data.make_sample`.

Its textures are patterns and images that scikit-image ships, free to use (astronaut: NASA; chelsea, coffee and
rocket: CC0).
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
import tyro
from skimage import io
from skimage.data import data_dir

from arraygeom import Camera, Pose, Rig, Sensor, intrinsics, rotation_from_vector
from arraygeom.rig import depth_range
from pat.data.sample_array import ALPHA, BETA, SAMPLE
from pat.media.colour import luminance
from pat.media.images import write_image
from pat.sensors import Clip, Noise, Quantise, record

from ..synthesis.layered import LayeredScenes
from ..synthesis.patterns import patterns
from ..synthesis.photos import PhotoBank
from ..synthesis.rig_distribution import RigDistribution
from ..synthesis.rigs import RigBatch

HW = (400, 640)
IMAGE_SUFFIXES = ("astronaut.png", "chelsea.png", "coffee.png", "rocket.jpg")


def sample_cameras() -> dict[str, Camera]:
    """A mono alpha and, 12 cm to its right and a little above, a wider colour camera, rotated and toed in."""
    rotation = rotation_from_vector(torch.tensor([0.6, -1.5, 2.0], dtype=torch.float64) * math.pi / 180)
    centre = torch.tensor([0.12, -0.03, 0.01], dtype=torch.float64)
    mono = Camera(K=intrinsics(820.0, HW), cam_from_world=Pose.identity(), hw=HW, sensor=Sensor(response="mono"))
    colour = Camera(
        K=intrinsics((460.0, 460.0), (360, 560), (284.0, 172.0)),
        cam_from_world=Pose.from_centre(rotation, centre),
        hw=(360, 560),
        sensor=Sensor(response="rgb"),
    )
    return {ALPHA: mono, BETA: colour}


def photographs() -> list[np.ndarray]:
    """The textures (H, W, 3), uint8."""
    return [io.imread(Path(data_dir) / name)[..., :3] for name in IMAGE_SUFFIXES]


def main(out: Path = SAMPLE, seed: int = 2) -> None:
    """Render a layered scene with the sample rig, record it, and write rig, images and ground truth."""
    cameras = sample_cameras()
    rig = Rig(cameras, depth=depth_range(1.4, 20.0), name="sample: mono + colour")
    generator = torch.Generator().manual_seed(seed)
    images = photographs()
    bank = PhotoBank(images + patterns(np.random.default_rng(seed), 4), photos=len(images))
    scenes = LayeredScenes(bank, RigDistribution(), hw=HW, layers=(9, 12), seed=seed)
    near, far = (torch.tensor([d], dtype=torch.float64) for d in (1.6, 16.0))
    views = scenes.render(RigBatch([_batched(c) for c in cameras.values()], near, far), generator, oversampling=2)
    ground_truth, seen = views.images
    mono = record(luminance(ground_truth), [Noise(8000, 3), Clip(), Quantise(8)], generator).image
    colour = record(seen, [Noise(4000, 3), Clip(), Quantise(8)], generator).image
    out.mkdir(parents=True, exist_ok=True)
    rig.save(out / "rig.yaml")
    for name, image in {ALPHA: mono, BETA: colour, "truth": ground_truth}.items():
        write_image(out / f"{name}.png", image[0])


def _batched(camera: Camera) -> Camera:
    pose = Pose(camera.R[None], camera.t[None])
    return camera.replace(K=camera.K[None], cam_from_world=pose)


if __name__ == "__main__":
    tyro.cli(main)
