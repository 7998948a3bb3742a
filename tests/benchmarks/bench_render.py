"""Measures rendering by Blender through the farm: `python -m tests.benchmarks.bench_render`, some 12 minutes.

Scenes of two views of 512x384 with the fast preset, and the first of the same scenes without its speed
settings (full light, the denoiser at its default), by two workers in one run: scenes an hour, seconds and
seconds of a core a scene, and the memory of each worker from scene to scene, none of them being replaced.
Prints tables and writes them to tests/benchmarks/RENDERING.md. Seconds of a core are what to compare where
the machine does other work, too.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import torch
import tyro
import yaml

from arraygeom import Camera, Pose, Rig, intrinsics
from arraygeom.atomic import write_text
from pat.evaluation.tables import markdown_row
from pat.farm.job import FACTS, RenderConfig, render
from pat.synthesis.blender import RenderSettings
from pat.synthesis.blender import render as render_scene
from pat.synthesis.generators import abstract
from tests.benchmarks.printed import head

RESULTS = Path(__file__).with_name("RENDERING.md")
SETTINGS: dict[str, dict[str, Any]] = {
    "fast preset": {},
    "without speed settings": {"denoise": "accurate", "fast_light": False, "bounces": 4},
}


def rig() -> Rig:
    """Two cameras of 512x384, 10 cm apart."""
    hw = (384, 512)
    right = Pose(torch.eye(3, dtype=torch.float64), torch.tensor([-0.1, 0, 0], dtype=torch.float64))
    poses = {"left": Pose.identity(), "right": right}
    cameras = {
        name: Camera(K=intrinsics(450.0, hw), cam_from_world=pose, hw=hw) for name, pose in poses.items()
    }
    return Rig(cameras, depth=(2.0, 20.0))


def made(root: Path, name: str, scenes: int, workers: int) -> tuple[list[dict[str, Any]], float, int]:
    """Render scenes: what each worker says of each, seconds in all, and seeds that the check refused."""
    rig().save(root / "rig.yaml")
    blender = {"generator": "abstract", "preset": "fast", "settings": SETTINGS[name]}
    config = {"rig": "rig.yaml", "backend": "blender", "blender": blender}
    (root / "render.yaml").write_text(yaml.safe_dump(config))
    out, begin = root / name.replace(" ", "-"), time.monotonic()
    render(RenderConfig.load(root / "render.yaml"), scenes=scenes, out=out, workers=workers)
    seconds = time.monotonic() - begin
    facts = [json.loads(path.read_text()) for path in sorted(out.glob(f"scenes/*/{FACTS}"))]
    return facts, seconds, sum(f["attempt"] for f in facts)


def speed(name: str, facts: list[dict[str, Any]], seconds: float | None, workers: int) -> str:
    """A row: scenes, scenes an hour by the clock (if it was theirs) and by their own seconds, and those."""
    each, cores = (mean(f[key] for f in facts) for key in ("seconds", "cpu_seconds"))
    whole = f"{3600 * len(facts) / seconds:.0f}" if seconds else ""
    return markdown_row(
        [name, len(facts), whole, f"{3600 * workers / each:.0f}", f"{each:.2f}", f"{cores:.2f}"]
    )


def memory(facts: list[dict[str, Any]]) -> list[str]:
    """A row for each worker: MB after some scenes, what a scene adds by a straight line from the 5th on."""
    rows = []
    for process in sorted({f["process"] for f in facts}):
        used = [f["memory_mb"] for f in facts if f["process"] == process]
        slope = float(np.polyfit(np.arange(len(used))[4:], used[4:], 1)[0]) if len(used) > 6 else float("nan")
        after = [f"{used[min(i, len(used)) - 1]:.0f}" for i in (1, 5, 10, 25, len(used))]
        rows.append(markdown_row([len(used), *after, f"{max(used):.0f}", f"{slope:+.2f}"]))
    return rows


def report(scenes: int, slow_scenes: int, workers: int) -> str:
    """The tables."""
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        (fast, slow), (fast_seconds, slow_seconds), (refused, _) = zip(
            *(made(Path(folder), name, n, workers) for name, n in zip(SETTINGS, (scenes, slow_scenes)))
        )
    names = list(SETTINGS)
    lines = [
        f"`python -m tests.benchmarks.bench_render`: {workers} workers on {os.cpu_count()} cores, "
        f"load before {load:.1f}; two views of 512x384; {refused} seeds were refused by the check and "
        "cost time, too.",
        "",
        head(" | scenes | an hour, all counted | an hour, by s a scene | s a scene | core s a scene"),
        speed(names[0], fast, fast_seconds, workers),
        speed(f"{names[0]}, the scenes of the next row", fast[: len(slow)], None, workers),
        speed(names[1], slow, slow_seconds, workers),
        "",
        "MB of each worker after its scenes, none replaced:",
        "",
        head("scenes | 1st | 5th | 10th | 25th | last | most | a scene adds", align="r"),
    ]
    return "\n".join([*lines, *memory(fast), ""])


def papers_scene() -> str:
    """One scene with the paper's preset on all cores."""
    settings, begin = RenderSettings.preset("paper"), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        done = render_scene(abstract(1, rig()), rig(), Path(folder) / "scene", settings=settings)
        sizes = ", ".join(f"{c.hw[1]}x{c.hw[0]}" for c in done.rig.cameras.values())
        verdict = "accepted" if done.accepted else f"refused: {done.about['check']['reasons']}"
    return f"paper preset, {sizes}: {time.monotonic() - begin:.0f} s on {os.cpu_count()} cores, {verdict}"


def main(
    scenes: int = 100,
    slow_scenes: int = 4,
    workers: int = 2,
    out: Path = RESULTS,
    paper: bool = False,
) -> None:
    """Print the tables and keep them.

    Args:
        slow_scenes: How many of them without the speed settings.
        paper: Only one scene with the paper's preset, 15 minutes.
    """
    if paper:
        return print(papers_scene())
    found = report(scenes, slow_scenes, workers)
    print(found)
    write_text(out, f"# Rendering\n\n{found}")


if __name__ == "__main__":
    tyro.cli(main)
