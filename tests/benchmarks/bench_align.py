"""Time and memory of `pat align` beside `pat fuse`: `python -m tests.benchmarks.bench_align`.

The sample array enlarged: alpha of 1280x800 with four betas, and of 12 megapixels with one beta within 4 GiB.
Each command in a process of its own; seconds are of the processor, memory is the largest resident.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from arraygeom import Rig
from experiments.peaks import watch_peak
from pat.evaluation.tables import markdown_table
from tests.benchmarks.job_parts import scene

CASES = {"1280x800, 4 betas": (1280, 800, 4, None), "4032x3024, 1 beta": (4032, 3024, 1, "4GiB")}


def measured(command: str, folder: Path, limit: str | None) -> list[str]:
    """Seconds of the processor and of the clock, and GiB."""
    names = Rig.load(folder / "rig.yaml").names
    images = [word for name in names for word in ("--image", f"{name}={folder / f'{name}.png'}")]
    cap = [] if limit is None else ["--max-memory", limit]
    words = [
        sys.executable,
        "-m",
        "pat",
        command,
        str(folder / "rig.yaml"),
        *images,
        "--out",
        str(folder / command),
    ]
    begin = time.monotonic()
    process = subprocess.Popen([*words, "--alpha", names[0], *cap], stdout=subprocess.DEVNULL)
    most = watch_peak(process.pid)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"pat {command} failed (wait status {status})")
    return [
        f"{used.ru_utime + used.ru_stime:.0f}",
        f"{time.monotonic() - begin:.0f}",
        f"{most() / 2**30:.2f}",
    ]


def main() -> None:
    """Print the table, of all cases or of those whose titles begin with a word that is given."""
    rows = []
    chosen = {title: case for title, case in CASES.items() if title.startswith(tuple(sys.argv[1:] or [""]))}
    for title, (width, height, betas, limit) in chosen.items():
        with TemporaryDirectory() as folder:
            scene(Path(folder), width, height, betas)
            for command in ("fuse", "align"):
                rows.append(
                    [title, f"pat {command}", limit or "none", *measured(command, Path(folder), limit)]
                )
                print(rows[-1], file=sys.stderr)
    print(markdown_table(["alpha", "command", "limit", "s, processor", "s", "GiB"], rows), end="")


if __name__ == "__main__":
    main()
