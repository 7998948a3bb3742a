"""From Python as from the command line, beside other processes or not: seconds a frame once imported.

    python -m tests.benchmarks.bench_python [--busy 3] [--frames 4] [--against FOLDER]

A notebook imports torch first, without `OMP_WAIT_POLICY`; the command sets it to PASSIVE. `--against`
measures another checkout in turn with this one. Other processes are loops of Python's, as many as `--busy`.
The table goes to tests/benchmarks/RESULTS_python.md.
"""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import product
from pathlib import Path
from statistics import median

from pat.app.cli.parser import script
from pat.lab.evaluation.tables import markdown_row, markdown_table

FRAME = """
import time, warnings
import torch
from pat import fuse, load_weights
from pat.app.sample_array import load_sample
warnings.simplefilter("ignore")
sample, network = load_sample(), load_weights("mono-colour")
rig, images = sample.rig, {{}}
for name, image in sample.images.items():
    image = torch.nn.functional.interpolate(image[None], scale_factor={scale}, mode="bicubic")[0]
    images[name] = image.clamp(0, 1)
    rig = rig.resize(name, tuple(images[name].shape[1:]))
for i in range({frames} + 1):
    begin = time.monotonic()
    fuse(images, rig, alpha="mono", network=network)
    print(time.monotonic() - begin, flush=True)
"""
SIZES = {"640x400": 1, "1280x800": 2}
RESULTS = Path(__file__).with_name("RESULTS_python.md")
POLICIES = {"import torch; from pat import fuse": {}, "as the command": {"OMP_WAIT_POLICY": "PASSIVE"}}

COLUMNS = [
    *("two threads", "processes beside", "load before"),
    *(f"{name}, seconds a frame" for name in POLICIES),
    "ratio",
]


def main(busy: int = 3, frames: int = 4, against: Path | None = None) -> None:
    """Print the table: medians after the first frame, in turn, and their ratio."""
    checkouts = {"": Path.cwd()} | ({"before: ": against} if against else {})
    rows = []
    for count in (0, busy):
        others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
        try:
            for (size, scale), (label, folder) in product(SIZES.items(), checkouts.items()):
                load = f"{os.getloadavg()[0]:.0f}"
                script = FRAME.format(frames=frames, scale=scale)
                took = [seconds(folder, policy, script) for policy in POLICIES.values()]
                figures = [*(f"{t:.2f}" for t in took), f"{took[0] / took[1]:.2f}"]
                rows.append([label + size, str(count), load, *figures])
                print(markdown_row(rows[-1]), flush=True)
        finally:
            for process in others:
                process.kill()
    RESULTS.write_text(markdown_table(COLUMNS, rows))


def seconds(folder: Path, policy: dict[str, str], script: str) -> float:
    """The median of a process's frames, the first left out."""
    plain = {k: v for k, v in os.environ.items() if not k.startswith("OMP_")}
    environment = {**plain, **policy, "PYTHONPATH": str(folder)}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    return median(map(float, done.stdout.split()[1:]))


if __name__ == "__main__":
    script(main)
