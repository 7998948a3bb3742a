"""From Python as from the command line, beside other processes or not: seconds of a frame once all is imported.

    python -m tests.benchmarks.bench_python [--busy 3] [--frames 4] [--against FOLDER]

A notebook imports torch first, without `OMP_WAIT_POLICY`; the command sets it to PASSIVE. `--against` measures another
checkout in turn with this one. Other processes are loops of Python's, as many as `--busy`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import tyro

from pat.evaluation.tables import markdown_table

FRAME = """
import time, warnings
import torch
from pat import fuse, load_weights
from pat.data.sample_array import load_sample
warnings.simplefilter("ignore")
sample, network = load_sample(), load_weights("mono-colour")
for i in range({frames} + 1):
    begin = time.monotonic()
    fuse(network, sample.rig, sample.images, alpha="mono")
    print(time.monotonic() - begin, flush=True)
"""
POLICIES = {"import torch; from pat import fuse": {}, "as the command": {"OMP_WAIT_POLICY": "PASSIVE"}}


@dataclass
class Bench:
    """Measure and print the table."""

    busy: int = 3
    frames: int = 4
    against: Path | None = None

    def run(self) -> None:
        """The medians after the first frame, in turn."""
        checkouts = {"": Path.cwd()} | ({"before: ": self.against} if self.against else {})
        rows = []
        for busy in (0, self.busy):
            others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
            try:
                for label, folder in checkouts.items():
                    for name, policy in POLICIES.items():
                        rows.append([label + name, str(busy), f"{self.seconds(folder, policy):.2f}"])
            finally:
                for process in others:
                    process.kill()
        print(markdown_table(["640x400, two threads", "other processes", "seconds a frame"], rows))

    def seconds(self, folder: Path, policy: dict[str, str]) -> float:
        """The median of a process's frames, the first left out."""
        plain = {k: v for k, v in os.environ.items() if not k.startswith("OMP_")}
        environment = {**plain, **policy, "PYTHONPATH": str(folder)}
        command = [sys.executable, "-c", FRAME.format(frames=self.frames)]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
        return median(map(float, done.stdout.split()[1:]))


if __name__ == "__main__":
    tyro.cli(Bench).run()
