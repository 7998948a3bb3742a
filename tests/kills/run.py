"""Commands killed at random, inside writes, with workers and schedulers; for docs/reports/kills.md.

    python -m tests.kills.run [--only fuse] [--share 0.5] [--out docs/reports/kills.md]

Exit status 1 if anything was lost, torn, left over, or not the same in the end.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from docs.update_readme import write_block
from pat.app.cli.parser import script

from .jobs import all_jobs
from .killing import Job, Killed, killed, reference, scheduler_killed

COUNTS: dict[str, dict[str, int]] = {
    "conversion": {"moment": 3, "write": 3, "cut": 3},
    "fuse": {"moment": 6, "write": 6, "cut": 3},
    "batch": {"moment": 6, "write": 6, "cut": 3, "scheduler": 4},
    "batch, two workers": {"moment": 3, "worker": 4},
    "sequence": {"moment": 4, "write": 4, "cut": 2},
    "training": {"moment": 6, "write": 6, "cut": 3},
    "calibration": {"moment": 4, "write": 4, "cut": 2},
    "rendering": {"moment": 4, "worker": 4, "write": 4},
    "rendering by Blender": {"moment": 3, "worker": 3, "write": 3},
}
"""How often each job is killed in each way."""
COLUMNS = {
    "moment": "at a moment",
    "write": "inside a write",
    "cut": "at a byte",
    "worker": "a worker",
    "scheduler": "Dask's scheduler",
}


@dataclass
class Kills:
    """Kill commands and see that nothing is lost."""

    only: str | None = None
    """One job."""
    share: float = 1.0
    """Share of the kills that are done."""
    seed: int = 0
    """Seed of the moments of the kills."""
    out: Path | None = None
    """A document whose block `kills` the table replaces; with `only`, its row."""

    def run(self) -> int:
        torch.set_num_threads(1)
        if self.out is not None and not self.out.is_file():
            raise SystemExit(f"{self.out}: no such document, of which a block is to be replaced")
        begin, rows, faults = time.monotonic(), {}, []
        with tempfile.TemporaryDirectory() as folder:
            for job in all_jobs(Path(folder)):
                if self.only in (None, job.name):
                    found = self._kill(job, Path(folder))
                    faults += [fault for one in found.values() for fault in one.faults]
                    rows[job.name] = row(job.name, found)
                    print(rows[job.name], *faults, sep="\n", file=sys.stderr, flush=True)
        print("\n".join([table(rows), *faults, f"{(time.monotonic() - begin) / 60:.0f} minutes"]))
        if self.out is not None:
            kept = rows_of(self.out.read_text()) if self.only else {}
            write_block(self.out, "kills", table(kept | rows))
        return int(bool(faults))

    def _kill(self, job: Job, folder: Path) -> dict[str, Killed]:
        right = reference(job, folder)
        found = {}
        for way, count in COUNTS[job.name].items():
            kills = max(round(count * self.share), 1)
            if way == "scheduler":
                found[way] = scheduler_killed(job, right, folder, kills=kills, seed=self.seed)
            else:
                found[way] = killed(job, right, folder, way=way, kills=kills, seed=self.seed)
        return found


def table(rows: dict[str, str]) -> str:
    """Rows by job, in Markdown."""
    head = [
        f"| job | {' | '.join(COLUMNS.values())} | compared | faults |",
        f"|---|{'---:|' * (len(COLUMNS) + 2)}",
    ]
    return "\n".join([*head, *(rows[name] for name in COUNTS if name in rows)])


def rows_of(document: str) -> dict[str, str]:
    """The rows of a table that a document holds, by job."""
    return {name: line for name in COUNTS for line in document.splitlines() if line.startswith(f"| {name} |")}


def row(name: str, found: dict[str, Killed]) -> str:
    """A row of the table: kills in each way, how often the end was compared, faults."""
    counts = [str(found[way].kills) if way in found else "" for way in COLUMNS]
    ends, faults = sum(one.finished for one in found.values()), sum(len(one.faults) for one in found.values())
    return f"| {name} | {' | '.join(counts)} | {ends} | {faults} |"


if __name__ == "__main__":
    sys.exit(script(Kills).run())
