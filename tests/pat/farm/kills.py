"""A job whose workers and whose command are killed (kill -9) again and again at random moments.

`python -m tests.pat.farm.kills --backend blender --scenes 30 --kills 10` renders tiny scenes, kills, begins again
until all are there, looks whether each is whole and none was made twice, and renders them once more on a local Dask
cluster to compare. The slow tests run the same.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from pat.farm.folders import JobFolder
from pat.farm.job import RenderConfig
from pat.farm.run import render
from pat.farm.worker import FACTS
from pat.synthesis.rendered import Rendered
from tests.pat.farm.journals import started_after_done
from tests.pat.farm.test_workshop import ROOT, children, wait_for_the_end_of

RIG = """
depth: [2, 20]
cameras:
  mono: {size: [128, 96], focal: 150}
  colour: {size: [128, 96], focal: 120, rotation: [0, 1, 0.5], translation: [-0.1, 0, 0], response: rgb}
"""
BACKENDS = {
    "layered": {"backend": "layered", "layered": {"layers": [4, 7], "oversampling": 1}},
    "blender": {"backend": "blender", "blender": {"settings": {"width": 128, "samples": 2}}},
}


class Survived(NamedTuple):
    """What a job went through: processes killed, and runs of the command until all scenes were there."""

    workers_killed: int
    commands_killed: int
    runs: int
    seconds: float


def write_config(folder: Path, backend: str) -> Path:
    """A file for tiny scenes."""
    (folder / "rig.yaml").write_text(RIG)
    path = folder / f"{backend}.yaml"
    path.write_text(yaml.safe_dump({"rig": "rig.yaml", "seed": 1, **BACKENDS[backend]}))
    return path


def killed_again_and_again(config: Path, out: Path, *, scenes: int, kills: int, seed: int = 0) -> Survived:
    """Render with two workers; in each run kill a worker and then the command, at random moments, `kills` in all.

    The moments are counted in what a scene takes, so that some are left to render however fast the machine is.
    """
    rng, command, begin = np.random.default_rng(seed), _command(config, out, scenes), time.monotonic()
    workers = commands = runs = 0
    while workers + commands < kills:
        runs += 1
        with killed_in_the_end(command) as parent:
            _wait_for_progress(out, parent, 1 + runs % 2)
            time.sleep(rng.uniform(0, _pace(out)))
            alive = children(parent.pid)
            if parent.poll() is None and alive:
                os.kill(int(rng.choice(alive)), signal.SIGKILL)
                workers += 1
            if workers + commands == kills:
                break
            time.sleep(rng.uniform(0, 2 if runs % 2 else 0.5) * _pace(out))
            commands += parent.poll() is None
        if len(JobFolder(out).done()) == scenes:
            raise ValueError(f"all {scenes} scenes were there after {workers + commands} kills: ask for more scenes")
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    return Survived(workers, commands, runs + 1, time.monotonic() - begin)


def _command(config: Path, out: Path, scenes: int) -> list[str]:
    run = [sys.executable, "-c", "from pat.cli.main import main; main()", "render", str(config), "--out", str(out)]
    return [*run, "--scenes", str(scenes), "--workers", "2"]


def _wait_for_progress(out: Path, parent: subprocess.Popen, more: int) -> None:
    wanted = len(JobFolder(out).done()) + more
    wait_until(lambda: len(JobFolder(out).done()) >= wanted or parent.poll() is not None)


def _pace(out: Path) -> float:
    """Seconds that the scenes that are there took, on average."""
    folder = JobFolder(out)
    took = [json.loads((folder.scene(i) / FACTS).read_text())["seconds"] for i in folder.done()]
    return float(np.mean(took)) if took else 0.0


@contextmanager
def killed_in_the_end(command: list[str]) -> Iterator[subprocess.Popen]:
    """A run of `pat render` that is killed (kill -9) when the block ends; its workers go with it."""
    parent = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    try:
        yield parent
    finally:
        workers = children(parent.pid)
        parent.kill()
        parent.wait()
        wait_for_the_end_of(workers)


def wait_until(condition: Callable[[], bool]) -> None:
    """Look again and again."""
    end = time.monotonic() + 500
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def faults(out: Path, scenes: int) -> list[str]:
    """What is wrong with a finished job: scenes missing, too many, half written, made twice, or given up."""
    folder = JobFolder(out)
    found = [f"made again after it was done: {i}" for i in started_after_done(out)]
    found += [f"given up: {i}" for i in folder.given_up()]
    if folder.done() != list(range(scenes)):
        found.append(f"scenes {folder.done()}")
    for i in folder.done():
        scene = Rendered(folder.scene(i))
        whole = scene.accepted and all(scene.frame(name).rgb.isfinite().all() for name in scene.rig.names)
        found += [] if whole else [f"not whole: {i}"]
    return found


def difference(one: Path, other: Path) -> float:
    """The largest difference of light between two scenes, after depths were found to be the same to 1e-5."""
    a, b = Rendered(one), Rendered(other)
    assert a.rig.names == b.rig.names
    worst = 0.0
    for name in a.rig.names:
        x, y = a.frame(name), b.frame(name)
        both = x.depth.isfinite()
        assert (both == y.depth.isfinite()).all()
        assert ((x.depth - y.depth)[both].abs() <= 1e-5 * x.depth[both]).all()
        worst = max(worst, float((x.rgb - y.rgb).abs().max()))
    return worst


def main() -> None:
    """Print what happened; exit with 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--backend", choices=BACKENDS, default="blender")
    parser.add_argument("--scenes", type=int, default=30)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    os.environ["PYTHONPATH"] = str(ROOT)
    with tempfile.TemporaryDirectory() as folder:
        config, out, again = write_config(Path(folder), given.backend), Path(folder) / "data", Path(folder) / "dask"
        print(killed_again_and_again(config, out, scenes=given.scenes, kills=given.kills, seed=given.seed), flush=True)
        wrong = faults(out, given.scenes)
        print(f"{len(JobFolder(out).done())} scenes; wrong: {wrong or 'nothing'}", flush=True)
        begin = time.monotonic()
        made = render(RenderConfig.load(config), scenes=given.scenes, out=again, workers=2, scheduler="local").made
        most = max(difference(JobFolder(out).scene(i), JobFolder(again).scene(i)) for i in range(given.scenes))
        seconds = time.monotonic() - begin
        print(f"Dask: {made} scenes in {seconds:.0f} s, light differs by {most:.2g} at most, depth by less than 1e-5")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
