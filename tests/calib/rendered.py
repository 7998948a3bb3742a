"""Rendered photographs of a ChArUco board by an array whose parameters are all known.

    python -m tests.calib.rendered --out out/boards

renders them (some minutes on one core; needs `make synthesis`), as a folder of PNG images for each camera
with the true rig beside them. Four cameras of different sizes, focal lengths and lenses stand 0.2 m apart and
look at about 2 m. The board is at 0.9 to 2.6 m, tilted by up to 40 degrees, so that every camera has it near,
at its corners and in its middle.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch

from arraygeom import Camera, Pose, Rig, rotation_from_vector
from arraygeom.sensor import Sensor
from tests.calib.board_scenes import camera, tensor
from tests.pat.lab.synthesis.boards import Sheet, board_scene

SHEET = Sheet(squares=(12, 9), square=0.06, marker=0.045, margin=0.03)
BOARD = "charuco:12x9:60mm:45mm:5x5_250"
DEPTHS = 0.9, 2.6
TILT = 40.0
LEAST_SEEN = 0.25
POSES = 12


def rig() -> Rig:
    """Four unlike cameras, the first at the world's origin."""
    return Rig(
        {
            "mono": camera(1200.0, (768, 1024), lens=(-0.12, 0.03, 0.0005, -0.0003, 0.0)),
            "colour": camera(
                (900.0, 903.0),
                (600, 800),
                (0.2, 0.02, 0.0),
                (0.5, -4.0, 0.8),
                (-0.2, 0.06, -0.0006, 0.0004, 0.0),
            ),
            "nir": camera(
                750.0, (600, 800), (-0.15, 0.0, 0.03), (-1.0, 3.0, -0.4), (-0.25, 0.08, 0.0, 0.0, 0.0)
            ),
            "wide": camera(
                540.0, (576, 768), (0.03, -0.2, 0.01), (-4.0, 0.0, 2.0), (-0.2, 0.05, 0.0, 0.0, 0.0)
            ),
        }
    )


def board_poses(cameras: Rig, count: int = POSES, *, seed: int = 0) -> list[Pose]:
    """`world_from_board`: before each camera in turn, at a random position, visible to the others too."""
    random = np.random.default_rng(seed)
    found: list[Pose] = []
    while len(found) < count:
        pose = _pose(cameras[cameras.names[len(found) % len(cameras.names)]], random)
        if all(_seen(cameras[name], pose) >= LEAST_SEEN for name in cameras.names):
            found.append(pose)
    return found


def _seen(view: Camera, pose: Pose) -> float:
    """The share of the board's corners in the image."""
    x, _, valid = view.project(pose.apply(torch.from_numpy(SHEET.inner_corners)))
    return float((valid & view.contains(x)).double().mean())


def _pose(view: Camera, random: np.random.Generator) -> Pose:
    """A board that would fill 0.45 to 1.05 of the image's width, its middle in the image's middle 60 %."""
    h, w = view.hw
    columns, rows = SHEET.squares
    depth = float(np.clip(view.K[0, 0] * SHEET.wh[0] / (w * random.uniform(0.45, 1.05)), *DEPTHS))
    x = tensor(random.uniform(0.2, 0.8) * w, random.uniform(0.2, 0.8) * h)
    middle = view.unproject(x[None], tensor(depth))[0]
    turn = np.radians([*random.uniform(-TILT, TILT, 2), random.uniform(-30, 30)])
    R = view.R.T @ rotation_from_vector(tensor(*turn))
    return Pose(R, middle - R @ tensor(columns * SHEET.square / 2, rows * SHEET.square / 2, 0.0))


def photograph(out: Path, *, count: int = POSES, samples: int = 8) -> None:
    """The images, `out/<camera>/<frame>.png` (8 bits), and `out/true.yaml`."""
    from pat.lab.synthesis.blender import RenderSettings, render
    from pat.media.colour import REC709, luminance, srgb_image
    from pat.media.images import write_image

    cameras = rig()
    slow = {name: c.replace(sensor=Sensor(frame_rate=1.0)) for name, c in cameras.cameras.items()}
    settings = RenderSettings(
        samples=samples, denoise="none", fast_light=False, bounces=0, threads=1, duration=float(count)
    )
    with tempfile.TemporaryDirectory() as scratch:
        scene = board_scene(board_poses(cameras, count), SHEET, Path(scratch) / "board.png")
        done = render(scene, Rig(slow), Path(scratch) / "rendered", settings=settings)
        for name in cameras.names:
            for number in range(done.frames(name)):
                light = luminance(done.frame(name, number).rgb, REC709)
                write_image(out / name / f"{number:03d}.png", srgb_image(light))
    cameras.save(out / "true.yaml")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/boards"))
    parser.add_argument("--count", type=int, default=POSES)
    options = parser.parse_args()
    photograph(options.out, count=options.count)


if __name__ == "__main__":
    main()
