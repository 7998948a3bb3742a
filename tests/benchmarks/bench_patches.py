"""Measures reading rendered scenes: `python -m tests.benchmarks.bench_patches`.

One layered scene of the paper's size (two views of 2048x1536) is rendered, then cut into the paper's 49
patches and recorded by the default chains. Seconds of a core for a patch, to compare with those of a training
step.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import torch

from arraygeom import Camera, Pose, Rig, Sensor, intrinsics
from experiments.patches.dataset import ScenePatches
from experiments.patches.grid import PatchGrid, cut
from pat.farm.backends import LayeredSettings
from pat.synthesis.check import CheckLimits


def rig() -> Rig:
    """Two cameras of the paper's size, 10 cm apart."""
    hw = (1536, 2048)
    poses = {"mono": 0.0, "colour": -0.1}
    cameras = {
        name: Camera(
            K=intrinsics(1800.0, hw),
            cam_from_world=Pose(
                torch.eye(3, dtype=torch.float64), torch.tensor([x, 0, 0], dtype=torch.float64)
            ),
            hw=hw,
            sensor=Sensor(response="mono" if name == "mono" else "rgb"),
        )
        for name, x in poses.items()
    }
    return Rig(cameras, depth=(2.0, 20.0))


def main() -> None:
    """Print the figures."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scenes" / "000000"
        LayeredSettings(oversampling=1).renderer(rig(), CheckLimits()).render(0, scene)
        size = sum(f.stat().st_size for f in scene.iterdir()) / 1e6
        begin = time.process_time()
        cut(scene, PatchGrid(), alpha="mono")
        cutting = time.process_time() - begin
        data = ScenePatches(folder)
        data[0]
        begin = time.process_time()
        for i in range(len(data)):
            data[i]
        recording = time.process_time() - begin
    count = PatchGrid().count
    print(
        f"a scene takes {size:.1f} MB of disk; "
        f"reading it and cutting its {count} patches {cutting:.2f} s of a core"
    )
    print(
        f"a patch: {1000 * cutting / count:.1f} ms to read and cut, "
        f"{1000 * recording / count:.1f} ms to record"
    )


if __name__ == "__main__":
    main()
