"""Sensitivity of the fusion to each tuned number: pairs fused with it halved and doubled."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pat.fusion.fuse import FuseSettings
from pat.lab.data.pairs import middlebury_pairs
from pat.lab.evaluation.protocols import rectified_fusion
from pat.lab.evaluation.tables import markdown_table
from pat.networks.weights import load_weights
from pat.support.settings import SettingEntry, all_settings

from .halves import of_half
from .stages import STAGE_CONDITIONS, scored

ROOMS = ("pat.matching", "pat.networks", "pat.fusion")
PAIRS = ("Bowling1", "Cloth4", "Flowerpots", "Midd1")
"""Ends of the names of the pairs that are fused, of the tune half."""
LOW_LIGHT, CORRECTIONS = ("200 electrons",), ("rows off 3 px", "alpha = .2/.4/.4")
STATES = {
    "ColourTransferSettings": ("x2", "x4", "alpha = .2/.4/.4", "4000 electrons, not stated"),
    "BM3DSettings": (*LOW_LIGHT, "50 electrons, of alpha alone"),
    "NonLocalMeansSettings": LOW_LIGHT,
    "LowLightSettings": LOW_LIGHT,
    "AlignmentSettings": CORRECTIONS,
    "PrePassSettings": CORRECTIONS,
}
"""Conditions of `stages.STAGE_CONDITIONS` in which they are, by algorithm; others by `USUAL`."""
USUAL = ("x2", "alpha = .2/.4/.4")
SAID = "half or twice as much does as well"
"""End of the reason of a number that matters little."""
COMPILED_IN = ("CensusSettings", "BM3DSettings")
"""Algorithms whose loops have settings compiled into them."""
FACTORS = (0.5, 2.0)
WORKER = """
import sys
from functools import partial
from pat.support import settings
middlebury, why, factor, *states = sys.argv[1:]
made, met = {kind: getattr(settings, kind) for kind in ("tuned", "size")}, []
def changed(value):
    if isinstance(value, tuple):
        return tuple(map(changed, value))
    return max(round(value * float(factor)), 1) if isinstance(value, int) else value * float(factor)
def changing(kind, value, reason):
    met.append(reason)
    return made[kind](changed(value) if reason == why else value, reason)
for kind in made:
    setattr(settings, kind, partial(changing, kind))
from experiments.evaluation.sensitivity import print_scores
assert met.count(why) == bool(why), met
print_scores(middlebury, states)
"""
"""Program that changes a setting, named by its reason, before any room is imported; whole numbers stay whole,
1 or more."""


class Change(NamedTuple):
    """Scores with a number changed, less those with it as it is.

    Attributes:
        psnr: mean of PSNR (dB), by condition.
        within: share of true disparities within a pixel, by condition.
    """

    psnr: Mapping[str, float]
    within: Mapping[str, float]


def scores_with(
    middlebury: Path, entry: SettingEntry | None, factor: float, states: Sequence[str]
) -> dict[str, list[float]]:
    """Fuse the pairs in a process of its own, with a setting changed before any room is imported.

    Args:
        middlebury: folder of Middlebury's pairs.
        entry: setting to change; None for none.
        factor: factor of its numbers.
        states: conditions of `stages.STAGE_CONDITIONS`.

    Returns:
        By condition, mean PSNR (dB) and mean share of disparities within a pixel.

    Raises:
        RuntimeError: with the last lines of the process, if it fails.
    """
    why, algorithm = ("", "") if entry is None else (entry.why, entry.algorithm)
    with tempfile.TemporaryDirectory() as folder:
        compiled = {"NUMBA_CACHE_DIR": folder} if algorithm in COMPILED_IN else {}
        words = [sys.executable, "-W", "ignore", "-c", WORKER, str(middlebury), why, str(factor), *states]
        environment = {**os.environ, **compiled}
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{entry}: {done.stderr[-2000:]}")
    return dict(json.loads(done.stdout.splitlines()[-1]))


def measured(
    middlebury: Path, entries: Sequence[SettingEntry]
) -> Iterator[tuple[SettingEntry, list[Change]]]:
    """Yield each tuned setting with the changes by `FACTORS`."""
    every = sorted({*USUAL, *(state for states in STATES.values() for state in states)})
    reference = scores_with(middlebury, None, 1.0, every)
    for entry in entries:
        changes, states = [], STATES.get(entry.algorithm, USUAL)
        for factor in FACTORS:
            found = scores_with(middlebury, entry, factor, states)
            psnr, within = ({name: found[name][i] - reference[name][i] for name in states} for i in range(2))
            changes.append(Change(psnr, within))
        yield entry, changes


def tuned_entries() -> list[SettingEntry]:
    """The settings of the fusion that were tuned, and those that are said to matter little (`SAID`)."""
    entries = all_settings(*ROOMS)
    return [entry for entry in entries if entry.kind == "tuned" or entry.why.lower().endswith(SAID)]


def sensitivity_markdown(rows: Iterable[tuple[SettingEntry, Sequence[Change]]]) -> str:
    """A table: a line a setting; for each factor the change of PSNR and of depth that is largest."""
    lines = []
    for entry, changes in rows:
        cells = []
        for change in changes:
            name = max(change.psnr, key=lambda name: abs(change.psnr[name]))
            depth = max(change.within.values(), key=abs)
            cells.append(f"{change.psnr[name]:+.2f} ({name}) / {depth:+.1%}")
        lines.append([f"{entry.algorithm.removesuffix('Settings')}.{entry.name} = {entry.value}", *cells])
    heads = [f"times {factor:g}" for factor in FACTORS]
    return markdown_table(["setting", *heads], lines)


def print_scores(middlebury: str, states: Sequence[str]) -> None:
    """Print the scores of the pairs in these conditions as JSON."""
    pairs = [p for p in of_half(middlebury_pairs(Path(middlebury)), "tune") if p.name.endswith(PAIRS)]
    found = {}
    for name in states:
        condition = STAGE_CONDITIONS[name]
        method = rectified_fusion(load_weights("mono-colour"), settings=FuseSettings(noise=condition.noise))
        scores = np.array([scored(method, pair, condition.recorded(pair)) for pair in pairs])
        found[name] = [float(scores[:, 0].mean()), float(np.nanmean(scores[:, 2]))]
    print(json.dumps(found))
