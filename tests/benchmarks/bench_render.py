"""Measures rendering by Blender through the farm: `python -m tests.benchmarks.bench_render [--scenes 20]`.

Scenes of two views of 512x384 with the fast preset, and some of the same scenes without its speed settings (full
light, the denoiser at its default), in one run: scenes an hour, seconds and seconds of a core a scene, and the
memory of a worker after its first and its last scene (`--recycle` keeps one worker for so many). The seconds of a
core are what to compare where the machine does other work, too.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch
import yaml

from arraygeom import Camera, Pose, Rig, intrinsics
from pat.farm.folders import JobFolder
from pat.farm.job import RenderConfig
from pat.farm.run import render
from pat.farm.worker import FACTS

SETTINGS: dict[str, dict[str, Any]] = {
    "fast preset": {},
    "without speed settings": {"denoise": "accurate", "fast_light": False, "bounces": 4},
}


def rig() -> Rig:
    """Two cameras of 512x384, 10 cm apart."""
    hw = (384, 512)
    right = Pose(torch.eye(3, dtype=torch.float64), torch.tensor([-0.1, 0, 0], dtype=torch.float64))
    poses = {"left": Pose.identity(), "right": right}
    cameras = {name: Camera(K=intrinsics(450.0, hw), cam_from_world=pose, hw=hw) for name, pose in poses.items()}
    return Rig(cameras, depth=(2.0, 20.0))


def measure(root: Path, name: str, scenes: int, workers: int, recycle: int) -> dict[str, Any]:
    """Render scenes; what it took."""
    rig().save(root / "rig.yaml")
    blender = {"generator": "abstract", "preset": "fast", "settings": SETTINGS[name]}
    config = {"rig": "rig.yaml", "backend": "blender", "blender": blender, "limits": {"recycle": recycle}}
    (root / "render.yaml").write_text(yaml.safe_dump(config))
    out, begin = root / name.replace(" ", "-"), time.monotonic()
    summary = render(RenderConfig.load(root / "render.yaml"), scenes=scenes, out=out, workers=workers)
    seconds = time.monotonic() - begin
    facts = [json.loads((JobFolder(out).scene(i) / FACTS).read_text()) for i in JobFolder(out).done()]
    memory = [f["memory_mb"] for f in facts]
    return {
        "settings": name,
        "scenes": len(facts),
        "scenes/hour": round(3600 * len(facts) / seconds),
        "s/scene": round(median(f["seconds"] for f in facts), 1),
        "core s/scene": round(median(f["cpu_seconds"] for f in facts), 1),
        "scenes/hour of 2 cores by core s": round(2 * 3600 / (sum(f["cpu_seconds"] for f in facts) / len(facts))),
        "MB first": memory[0],
        "MB most": max(memory),
        "MB last": memory[-1],
        "refused": summary.refusals,
    }


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--slow-scenes", type=int, default=2, help="how many of them without the speed settings")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--recycle", type=int, default=25)
    given = parser.parse_args()
    print(f"{given.workers} workers, {os.cpu_count()} cores, load before: {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder:
        for name, scenes in zip(SETTINGS, (given.scenes, given.slow_scenes)):
            if scenes:
                row = measure(Path(folder), name, scenes, given.workers, given.recycle)
                print("\n".join(f"{key:32} {value}" for key, value in row.items()), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
