"""Damaged files of every kind, each in a process with 4 GiB and 10 s; for docs/reports/fuzzing.md.

    python -m tests.fuzz.run [--only rig] [--share 0.1] [--out docs/reports/fuzzing.md]

Faults are kept in out/fuzz, with what was printed beside them; exit status 1 if there are any, but for wrong
pixels in formats in which nobody can see them: these are counted alone.
"""

from __future__ import annotations

import contextlib
import io
import os
import random
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch

from docs.update_readme import write_block
from pat.app.cli.parser import script

from .cases import KINDS, UNKNOWABLE, Check, Seed, damaged, placed
from .sandbox import Outcome, ended

FAULTS = Path("out/fuzz")


class Case(NamedTuple):
    seed: Seed
    number: int
    outcome: Outcome


@dataclass
class Fuzz:
    """Damage files, and see that each is read or refused in one line."""

    only: str | None = None
    """One kind of file."""
    share: float = 1.0
    """Share of the cases that are done."""
    first: int = 0
    """The number of the first damage: other numbers are other damage."""
    out: Path | None = None
    """A document whose block `fuzzing` the table replaces."""

    def run(self) -> int:
        torch.set_num_threads(1)
        if self.out is not None and not self.out.is_file():
            raise SystemExit(f"{self.out}: no such document, of which a block is to be replaced")
        shutil.rmtree(FAULTS, ignore_errors=True)
        rows, begin = [], time.monotonic()
        for kind in KINDS if self.only is None else [self.only]:
            rows += table_rows(kind, faults_of(kind, round(KINDS[kind][2] * self.share), self.first))
        head = "| kind | format | cases | read | refused | faults | slowest | largest |"
        text = "\n".join([head, "|---|---|---:|---:|---:|---:|---:|---:|", *rows])
        print(f"{text}\n{(time.monotonic() - begin) / 60:.0f} minutes")
        if self.out is not None:
            write_block(self.out, "fuzzing", text)
        return int(FAULTS.exists())


def faults_of(kind: str, cases: int, first: int = 0) -> list[Case]:
    """All cases of a kind, in turn over its good files; faults are kept."""
    make_seeds, check, _ = KINDS[kind]
    done = []
    with tempfile.TemporaryDirectory() as folder:
        seeds = list(make_seeds(Path(folder) / "seeds"))
        warm_up(seeds, check, Path(folder))
        for i in range(cases):
            seed, number = seeds[i % len(seeds)], first + i // len(seeds)
            path = damaged(seed, number, Path(folder))
            log = Path(folder) / "log.txt"
            outcome = ended(lambda path=path, number=number: check(path, random.Random(number)), log)
            done.append(Case(seed, number, outcome))
            if len(done) % 500 == 0:
                print(f"{kind}: {len(done)} of {cases}", file=sys.stderr)
            if outcome.verdict not in ("read", "refused") and seed.format not in UNKNOWABLE:
                keep(done[-1], Path(folder) / "case", log)
    return done


def warm_up(seeds: list[Seed], check: Check, folder: Path) -> None:
    """Ask for undamaged files in this process, so that what is imported late is there before it forks."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        for i, seed in enumerate(seeds):
            check(placed(seed, folder / "case")[1], random.Random(i))


def keep(case: Case, home: Path, log: Path) -> None:
    """Copy a fault's files and what was printed to `FAULTS`."""
    seed = case.seed
    name = f"{seed.kind}-{seed.format}-{seed.file.name}-{case.number}".replace(" ", "_").replace("/", "_")
    print(f"fault: {name}: {case.outcome.verdict}: {case.outcome.message[:200]}", file=sys.stderr)
    shutil.copytree(home, FAULTS / name, symlinks=True, ignore=_no_files, dirs_exist_ok=True)
    shutil.copy(log, FAULTS / name / "log.txt")


def _no_files(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if not os.path.isfile(os.path.join(folder, name))]


def table_rows(kind: str, cases: list[Case]) -> list[str]:
    """A row for each format, in Markdown."""
    by_format: dict[str, list[Outcome]] = defaultdict(list)
    for case in cases:
        by_format[case.seed.format].append(case.outcome)
    rows = []
    for format, found in by_format.items():
        counts = [sum(o.verdict == v for o in found) for v in ("read", "refused")]
        worst = f"{max(o.seconds for o in found):.1f} s | {max(o.peak for o in found) / 2**20:.0f} MiB"
        figures = len(found), *counts, len(found) - sum(counts)
        rows.append(f"| {kind} | {format} | {' | '.join(map(str, figures))} | {worst} |")
    return rows


if __name__ == "__main__":
    sys.exit(script(Fuzz).run())
