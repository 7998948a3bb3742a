"""Makes the sample array in pat/app/sample: `python -m experiments.scenes.make_sample`; needs Blender."""

from __future__ import annotations

import math
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from arraygeom import Camera, Pose, Rig, Sensor, intrinsics, rotation_from_vector
from arraygeom.pair import depth_range
from pat.app.cli.parser import script
from pat.app.sample_array import ALPHA, BETA, SAMPLE
from pat.lab.synthesis.blender import RenderSettings, render
from pat.media.colour import luminance, srgb_from_linear
from pat.media.images import write_image
from pat.sensors import Clip, Noise, Quantise, record

from .still_life import still_life

HW = (400, 640)


def sample_cameras() -> dict[str, Camera]:
    """A mono alpha and, 12 cm to its right and a little above, a wider colour camera, rotated and toed in."""
    rotation = rotation_from_vector(torch.tensor([0.6, -1.5, 2.0], dtype=torch.float64) * math.pi / 180)
    centre = torch.tensor([0.12, -0.03, 0.01], dtype=torch.float64)
    mono = Camera(
        K=intrinsics(820.0, HW), cam_from_world=Pose.identity(), hw=HW, sensor=Sensor(response="mono")
    )
    K, pose = intrinsics((460.0, 460.0), (360, 560), (284.0, 172.0)), Pose.from_centre(rotation, centre)
    colour = Camera(K=K, cam_from_world=pose, hw=(360, 560), sensor=Sensor(response="rgb"))
    return {ALPHA: mono, BETA: colour}


def main(out: Path = SAMPLE, seed: int = 2, samples: int = 64) -> None:
    """Render a still life with the sample rig, record it, and write rig, images and ground truth.

    Highlights are clipped at white, in the ground truth too.
    """
    rig = Rig(sample_cameras(), depth=depth_range(1.4, 20.0), name="sample: mono + colour")
    generator = torch.Generator().manual_seed(seed)
    settings = RenderSettings(samples=samples, denoise="accurate", fast_light=False, bounces=4)
    with TemporaryDirectory() as folder:
        rendered = render(still_life(seed, rig), rig, Path(folder) / "scene", settings=settings)
        lights = (rendered.frame(name).rgb[None] for name in (ALPHA, BETA))
        ground_truth, beta_image = (srgb_from_linear(light).clamp(0, 1) for light in lights)
    mono = record(luminance(ground_truth), [Noise(8000, 3), Clip(), Quantise(8)], generator)
    colour = record(beta_image, [Noise(4000, 3), Clip(), Quantise(8)], generator)
    out.mkdir(parents=True, exist_ok=True)
    rig.save(out / "rig.yaml")
    for name, image in {ALPHA: mono, BETA: colour, "truth": ground_truth}.items():
        write_image(out / f"{name}.png", image[0])


if __name__ == "__main__":
    script(main)
